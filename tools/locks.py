"""Are the versions in constraints.txt a complete lock for every supported Python on every supported
system?

  python -m tools.locks [--write] [--folder DIR]

For each version of Python and each system, uv resolves the package with all of its extras under
``constraints.txt``, with binary packages alone, by the metadata of the package index. Nothing is
installed, so no other interpreter is needed. A resolution that fails, or that has to choose a
version that ``constraints.txt`` does not name, is reported, and the exit status is then 1. --write
makes ``constraints.txt`` anew: the versions that it names stay, what a resolution needs beside them
is added, and what none needs is taken out. --folder keeps each resolution as a file that ``pip
install -r`` takes. Needs the extra ``release``; takes one to three minutes, most of them waiting
for the index.
"""

import argparse
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONSTRAINTS = ROOT / "constraints.txt"
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
"""Supported versions of Python, the oldest first."""
SYSTEMS = (
    "x86_64-manylinux_2_28",
    "aarch64-manylinux_2_28",
    "windows",
    "aarch64-apple-darwin",
)
"""Systems for which PyTorch has packages, by uv's names."""
_OLDEST_MACOS = "14.0"  # for which PyTorch has packages
_AT_A_TIME = 4

Pins = dict[str, str]
"""Package -> version."""


def pins(text: str) -> Pins:
    """The versions that a file of constraints names; names as the index spells them."""
    lines = (line.partition("#")[0].partition(";")[0].strip() for line in text.splitlines())
    return {
        _spelled(name): version
        for name, found, version in (line.partition("==") for line in lines)
        if found
    }


def _spelled(name: str) -> str:
    return name.strip().lower().replace("_", "-").replace(".", "-")


def resolved(python: str, system: str) -> Pins:
    """All packages that a version of Python needs on a system, under ``constraints.txt``.

    Raises:
        RuntimeError: with what uv says, if nothing fits together or a binary package is missing.
    """
    where = (
        "--python-version",
        python,
        "--python-platform",
        system,
        "--only-binary",
        ":all:",
    )
    what = (
        "pyproject.toml",
        "--all-extras",
        "--constraint",
        str(CONSTRAINTS),
        "--no-header",
        "--no-annotate",
        "--quiet",
    )
    done = subprocess.run(
        (sys.executable, "-m", "uv", "pip", "compile", *what, *where),
        cwd=ROOT,
        env=os.environ | {"MACOSX_DEPLOYMENT_TARGET": _OLDEST_MACOS},
        capture_output=True,
        text=True,
    )
    if done.returncode != 0:
        raise RuntimeError(" ".join(done.stderr.split())[-800:])
    return pins(done.stdout)


def unpinned(found: Pins, pinned: Pins) -> list[str]:
    """Packages of a resolution whose version is not the pinned one, or that are not pinned."""
    return [
        f"{name}=={version}"
        for name, version in sorted(found.items())
        if pinned.get(name) != version
    ]


def united(resolutions: list[Pins]) -> Pins:
    """The packages of all resolutions.

    Raises:
        ValueError: if two resolutions have different versions of a package, which one file cannot
            pin.
    """
    found: Pins = {}
    for one in resolutions:
        for name, version in one.items():
            if found.setdefault(name, version) != version:
                raise ValueError(
                    f"{name}: one resolution has {found[name]}, another {version}; pin one that "
                    "fits both."
                )
    return dict(sorted(found.items()))


def problems(*, folder: Path | None = None) -> tuple[list[str], list[Pins]]:
    """What is wrong with the lock, one line a version of Python and system, and the resolutions
    that succeeded.
    """
    pinned = pins(CONSTRAINTS.read_text())
    wrong = []
    found = []
    places = list(product(PYTHONS, SYSTEMS))
    with ThreadPoolExecutor(
        _AT_A_TIME
    ) as pool:  # they wait for the index, not for the processor
        for (python, system), one in zip(places, pool.map(_tried, places), strict=True):
            if isinstance(one, RuntimeError):
                wrong.append(f"Python {python}, {system}: {one}")
                continue
            found.append(one)
            if left := unpinned(one, pinned):
                wrong.append(f"Python {python}, {system}: not pinned: {', '.join(left)}")
            if folder is not None:
                _write(folder / f"python-{python}-{system}.txt", one)
    return wrong, found


def _tried(place: tuple[str, str]) -> Pins | RuntimeError:
    try:
        return resolved(*place)
    except RuntimeError as error:
        return error


def _write(path: Path, versions: Pins) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{name}=={version}\n" for name, version in versions.items()))


def main(argv: list[str] | None = None) -> int:
    """Run the command; the exit status."""
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--write", action="store_true", help="make constraints.txt anew")
    options.add_argument(
        "--folder",
        metavar="DIR",
        type=Path,
        help="keep the lock of each Python and system here",
    )
    args = options.parse_args(argv)
    wrong, found = problems(folder=args.folder)
    if args.write and len(found) == len(PYTHONS) * len(SYSTEMS):
        versions = united(found)
        _write(CONSTRAINTS, versions)
        print(f"constraints.txt names {len(versions)} packages")
        return 0
    places = f"Python {', '.join(PYTHONS)} on {', '.join(SYSTEMS)}"
    print(
        "\n".join(wrong)
        or f"constraints.txt is a complete lock for {places}: {len(united(found))} packages"
    )
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
