"""Beliefs for design, with values of their JSON replaced."""

import json
from collections.abc import Iterator
from typing import Any

from benchmarks.bad_inputs.case import INF, NAN, QUICK, Case


def beliefs(belief: dict[str, Any]) -> Iterator[Case]:
    """Beliefs for design."""

    def case(name: str, content: Any) -> Case:
        text = content if isinstance(content, str) else json.dumps(content)
        return Case(
            "belief",
            name,
            ("design", "--belief", "b.json", *QUICK),
            "b.json",
            lambda here: (here / "b.json").write_text(text),
        )

    for name, text in {
        "empty": "",
        "list": "[]",
        "number": "3",
        "null": "null",
        "object": "{}",
        "cut": json.dumps(belief)[:200],
        "deep": "[" * 50_000,
        "result": '{"belief": 5}',
        "text": '"x"',
    }.items():
        yield case(name, text)
    for path in leaves(belief):
        for value in (NAN, None, "x", [], {"a": 1}, INF):
            old = at(belief, path)
            if (
                isinstance(old, str)
                and value == "x"
                and path[-1] not in ("model", "kind", "name")
            ):
                continue
            if (old is None and value is None) or (
                path[0] == "log_probabilities" and value is None
            ):  # null is none at all
                continue
            yield case(
                f"{'.'.join(map(str, path))} {value!r}", replaced(belief, path, value)
            )
    for key in belief:
        yield case(f"without {key}", {k: v for k, v in belief.items() if k != key})
        yield case(f"empty {key}", belief | {key: []})


def leaves(document: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all values of a JSON document, of lists the first alone."""
    if isinstance(document, dict) and document:
        return [
            found
            for key, value in document.items()
            for found in leaves(value, (*path, key))
        ]
    if isinstance(document, list) and document:
        return leaves(document[0], (*path, 0))
    return [path]


def at(document: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        document = document[key]
    return document


def replaced(document: Any, path: tuple[Any, ...], value: Any) -> Any:
    """A copy with another value at a path."""
    new = json.loads(json.dumps(document))
    target = at(new, path[:-1])
    target[path[-1]] = value
    return new
