"""Results for plot and compare."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.bad_inputs.case import Case


def results(result: Path) -> Iterator[Case]:
    """Results for plot and compare."""
    document = json.loads(result.read_text())

    def case(command: str, name: str, content: Any, **more: Any) -> Case:
        text = content if isinstance(content, str | bytes) else json.dumps(content)
        data = text if isinstance(text, bytes) else text.encode()

        def make(here: Path) -> None:
            (here / "a.json").write_bytes(data)
            shutil.copy(result, here / "b.json")

        page = () if name == "each" else ("--html", "{here}/page.html")
        files = (
            ("a.json", "--out", "{here}/figures", *page)
            if command == "plot"
            else ("a.json", "b.json")
        )
        return Case(
            "result",
            f"{command} {name}",
            (command, *files, "--quiet"),
            "a.json",
            make,
            **more,
        )

    for command in ("plot", "compare"):
        for name, text in {
            "empty": b"",
            "list": b"[]",
            "null": b"null",
            "cut": json.dumps(document).encode()[:5000],
            "bytes": b"\xff\xfe\x00",
            "deep": b"[" * 50_000,
            "object": b"{}",
            "schema a text": b'{"schema": "x"}',
            "names twice": b'{"schema": 1, "schema": 2}',
        }.items():
            yield case(command, name, text)
        for key in (
            ("belief", "models")
            if command == "compare"
            else ("belief", "models", "curves", "model_probabilities", "prior", "schema")
        ):
            yield case(
                command, f"without {key}", {k: v for k, v in document.items() if k != key}
            )
            for value in (None, 5, "x", []):
                yield case(command, f"{key} {value!r}", document | {key: value})
        yield case(command, "each", {"schema": document["schema"], "each": {"a": 5}})
    yield case(
        "plot", "version 99", document | {"schema": document["schema"] | {"version": 99}}
    )
    yield case(
        "plot",
        "version a text",
        document | {"schema": document["schema"] | {"version": "1"}},
    )
    curve = document["curves"][0]
    for key in curve:
        if key in ("We", "R_inf*", "R_inf_m", "source", "time_of_max_s"):
            continue
        yield case(
            "plot",
            f"curve without {key}",
            document | {"curves": [{k: v for k, v in curve.items() if k != key}]},
        )
        yield case(
            "plot", f"curve {key} null", document | {"curves": [curve | {key: None}]}
        )
    yield case(
        "plot",
        "curve measured of two lengths",
        document
        | {"curves": [curve | {"measured": curve["measured"] | {"R_star": [1.0]}}]},
    )
    for option, about in (
        ("--format=", "--format"),
        ("--format=gif", "--format is 'gif'; expected some of png, pdf, svg"),
        ("--out={here}/b.json", "--out"),
        ("--html={here}", "--html"),
    ):
        make = lambda here: shutil.copy(result, here / "b.json")  # noqa: E731
        yield Case(
            "result", f"plot {option}", ("plot", "b.json", "--quiet", option), about, make
        )
    yield Case(
        "result",
        "compare --model x",
        ("compare", "b.json", "b.json", "--quiet", "--model", "x"),
        "--model is 'x'; both results have nhkv",
        lambda here: shutil.copy(result, here / "b.json"),
    )
    yield Case(
        "result",
        "compare missing",
        ("compare", "b.json", "c.json", "--quiet"),
        "c.json",
        lambda here: shutil.copy(result, here / "b.json"),
    )
