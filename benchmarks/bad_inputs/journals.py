"""Folders of campaigns whose journals were changed."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bad_inputs.beliefs import at, leaves, replaced
from benchmarks.bad_inputs.case import MODELS, QUICK, Case, good
from imr_torch.campaign import Journal
from tests.journals import rewritten


def journals(whole: Path) -> Iterator[Case]:
    """Folders of campaigns; ``whole`` is a good one."""
    words = [
        "--policy",
        "space-filling",
        "--repeats",
        "1",
        "--out",
        "{here}/gel",
        "--resume",
    ]
    base = ("campaign", *MODELS, *words, *QUICK)
    lines = (whole / "journal.jsonl").read_bytes().splitlines(keepends=True)

    def case(
        name: str,
        change: Callable[[Path], object],
        about: str = "journal",
        arguments: tuple[str, ...] = base,
        **more: Any,
    ) -> Case:
        def make(here: Path) -> None:
            shutil.copytree(whole, here / "gel")
            good(here)
            change(here / "gel")

        return Case("journal", name, arguments, about, make, **more)

    def content(name: str, new: bytes) -> Callable[[Path], object]:
        return lambda gel: (gel / name).write_bytes(new)

    for number in range(len(lines)):
        if number + 1 < len(lines):  # lines removed at the end are not noticed
            others = lines[:number] + lines[number + 1 :]
            yield case(
                f"without line {number + 1}", content("journal.jsonl", b"".join(others))
            )
        yield case(
            f"line {number + 1} twice",
            content("journal.jsonl", b"".join(lines[: number + 1] + lines[number:])),
        )
        edited = lines[number].replace(b'"event"', b'"Event"', 1)
        yield case(
            f"line {number + 1} edited",
            content(
                "journal.jsonl", b"".join([*lines[:number], edited, *lines[number + 1 :]])
            ),
        )
        for text in (
            b"5\n",
            b"null\n",
            b"{}\n",
            b"[]\n",
            b'"x"\n',
            b"{\n",
            b"\n",
            b"\0\0\0\n",
            b'{"event": 5}\n',
            b"[" * 50_000 + b"\n",
            '{"event": "ärger"}\n'.encode(),
            b"\xff\xfe\n",
        ):
            yield case(
                f"line {number + 1} {text[:16]!r}",
                content(
                    "journal.jsonl", b"".join([*lines[:number], text, *lines[number + 1 :]])
                ),
            )
    yield case("lines reversed", content("journal.jsonl", b"".join(reversed(lines))))
    yield case("empty journal", content("journal.jsonl", b""))
    yield case("no journal", lambda gel: (gel / "journal.jsonl").unlink())
    yield case(
        "journal a folder",
        lambda gel: ((gel / "journal.jsonl").unlink(), (gel / "journal.jsonl").mkdir()),
        status=(1, 2),
    )
    curve = next(whole.glob("experiment_*.npz")).name
    yield case("curve removed", lambda gel: (gel / curve).unlink(), about=curve)
    yield case("curve empty", content(curve, b""), about=curve)
    yield case("curve cut", content(curve, (whole / curve).read_bytes()[:100]), about=curve)
    yield case(
        "curve another",
        lambda gel: np.savez(gel / curve, times=[0.0], radius=[[1.0]]),
        about=curve,
    )
    yield case(
        "not resumed",
        lambda gel: None,
        "--resume",
        tuple(x for x in base if x != "--resume"),
    )
    yield case("another seed", lambda gel: None, arguments=(*base, "--seed", "3"))
    yield case(
        "another model",
        lambda gel: None,
        arguments=tuple(x.replace("nhkv", "newtonian") for x in base),
    )
    yield case("told again", lambda gel: None, arguments=(*base, "--tell", "gel.csv"))
    for number in ("0", "-1", "99"):
        yield case(
            f"forget {number}",
            lambda gel: None,
            f"experiment {number}",
            (*base, "--forget", number),
        )
    events = Journal(whole).events
    for number, event in enumerate(events):
        for path in leaves(event):
            if path[0] == "event" or (
                number == 0 and path[0] in ("prior", "settings", "note", "simulator")
            ):
                continue
            for value in (None, "x", [], -7):
                old = at(event, path)
                if (
                    value == old
                    or old is None
                    or (value is None and "log_probabilities" in path)
                    or path[-1] in ("seconds", "label", "file")
                    or (value == -7 and isinstance(old, int | float))
                ):
                    continue
                new = [
                    *events[:number],
                    replaced(event, path, value),
                    *events[number + 1 :],
                ]
                soft = path[0] in (
                    "certificates",
                    "gaussian_answer",
                    "gain",
                    "gain_sd",
                    "reason",
                    "search",
                    "evidence",
                    "noise",
                    "trust",
                    "count",
                    "seconds",
                )
                yield case(
                    f"line {number + 1} {'.'.join(map(str, path))} = {value!r}, checksums right",
                    lambda gel, new=new: rewritten(gel, new),
                    damaged=soft,
                )
