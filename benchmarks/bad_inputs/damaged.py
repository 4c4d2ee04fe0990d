"""Files of every kind after random accidents: bytes removed, changed or doubled."""

import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.bad_inputs.case import FIT, MODELS, QUICK, Case


def damage(content: bytes, source: random.Random) -> bytes:
    """A file after one random accident."""
    size = len(content)
    place = source.randrange(size)
    length = source.randrange(1, 40)
    kinds: list[Callable[[], bytes]] = [
        lambda: content[:place],
        lambda: content[place:],
        lambda: content[:place] + content[place + length :],
        lambda: (
            content[:place]
            + bytes(source.randrange(256) for _ in range(length))
            + content[place + length :]
        ),
        lambda: (
            content[:place]
            + bytes([content[place] ^ (1 << source.randrange(8))])
            + content[place + 1 :]
        ),
        lambda: content[: place + length] + content[place:],
        lambda: (
            content[:place]
            + source.choice(
                [
                    b"nan",
                    b"inf",
                    b"-",
                    b"1e999",
                    b'"',
                    b"\r",
                    b"\n",
                    b"\xef\xbb\xbf",
                    b"\0",
                    b",",
                    b";",
                    b"[",
                    b"{",
                    b"null",
                    "µ".encode(),
                ]
            )
            + content[place:]
        ),
        lambda: content.replace(bytes([content[place]]), b"", 3),
        lambda: content + content,
    ]
    return source.choice(kinds)()


def damaged(folder: Path, count: int) -> Iterator[Case]:
    """``count`` accidents of each kind of file; ``folder`` holds good ones."""
    campaign = (
        "campaign",
        *MODELS,
        "--policy",
        "space-filling",
        "--repeats",
        "1",
        "--out",
        "{here}/gel",
        "--resume",
        *QUICK,
    )
    kinds: dict[str, tuple[tuple[str, ...], str, str]] = {
        "table": (FIT, "gel.csv", ""),
        "sidecar": (FIT, "gel.json", "gel"),
        "npz": (("diagnose", "set.npz", "--effects", "sound_speed", *QUICK), "set.npz", ""),
        "belief": (("design", "--belief", "belief.json", *QUICK), "belief.json", ""),
        "journal": (campaign, "gel/journal.jsonl", "journal"),
        "curve": (campaign, "gel/experiment_001.npz", "experiment_001"),
        "compare": (("compare", "fit.json", "other.json", "--quiet"), "fit.json", ""),
        "plot": (
            ("plot", "fit.json", "--out", "{here}/figures", "--format", "png", "--quiet"),
            "fit.json",
            "",
        ),
    }
    for kind, (arguments, name, about) in kinds.items():
        source = random.Random(kind)
        content = (folder / name).read_bytes()
        for number in range(count if kind != "plot" else count // 4):
            new = damage(content, source)

            def make(here: Path, name: str = name, new: bytes = new) -> None:
                shutil.copytree(folder, here, dirs_exist_ok=True)
                (here / name).write_bytes(new)

            yield Case(
                "damaged",
                f"{kind} {number}",
                arguments,
                about or Path(name).name,
                make,
                damaged=True,
            )
