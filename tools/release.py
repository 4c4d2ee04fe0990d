"""The release checklist: are the packages complete, do they install from nothing, and do all files
name one version?

  python -m tools.release [--draft] [--dist DIR]

In this order: version in pyproject.toml, CITATION.cff and CHANGELOG.md; wheel and sdist, built in
    isolation; their metadata
(twine) and files; pinned versions, which must be a complete lock for every supported Python and
system (tools/locks.py); a fresh environment outside the checkout with the wheel alone, where
``imr-torch --version``, ``python -m imr_torch``, the help of every subcommand and ``imr-torch demo
--short`` must run. --draft does not ask CHANGELOG.md for a heading of the version, since changes
stand under "Unreleased" until the day of the release. Needs the extra ``release`` and a package
index; takes five to eight minutes, most of them for the download of PyTorch and for the index. Exit
status 1 if a check fails.
"""

import argparse
import re
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import venv
import zipfile
from collections.abc import Callable
from pathlib import Path

from tools.locks import problems

ROOT = Path(__file__).resolve().parents[1]
IN_WHEEL = (
    "imr_torch/py.typed",
    "imr_torch/data/example_gel.csv",
    "imr_torch/data/example_gel.json",
    "imr_torch/data/effects.toml",
    "imr_torch/data/models.toml",
    "imr_torch/data/captions.toml",
    "imr_torch/data/cases.toml",
    "imr_torch/data/commands.toml",
    "imr_torch/data/forms.toml",
    "imr_torch/data/headings.toml",
    "imr_torch/data/layouts.toml",
    "imr_torch/data/media.toml",
    "imr_torch/data/parameters.toml",
    "imr_torch/data/properties.toml",
    "imr_torch/data/statuses.toml",
    "imr_torch/cli/demo.py",
)
IN_SDIST = (
    "LICENSE",
    "CITATION.cff",
    "CHANGELOG.md",
    "README.md",
    "constraints.txt",
    "Makefile",
    "tests/conftest.py",
    "tests/linear.py",
    "tutorials/01_one_bubble.py",
    "benchmarks/RESULTS.md",
    "tools/locks.py",
    "docs/conf.py",
    *IN_WHEEL,
)
FROM_DEMO = (
    "gel.html",
    "campaign.html",
    "demo.json",
    "example_gel.csv",
    "characterize/characterize.json",
    "characterize/residuals.png",
)


def version() -> str:
    """The version that pyproject.toml states."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]


def disagreements(
    stated: str, citation: str, changelog: str, *, draft: bool = False
) -> list[str]:
    """What CITATION.cff and CHANGELOG.md say against a version; empty if they agree."""
    wrong = []
    cited = re.search(r"^version: *['\"]?([^\s'\"]+)", citation, re.MULTILINE)
    if cited is None or cited[1] != stated:
        wrong.append(
            f"CITATION.cff has version {cited[1] if cited else 'none'}, pyproject.toml {stated}"
        )
    if not draft and not re.search(
        rf"^## \[{re.escape(stated)}\] - \d{{4}}-\d\d-\d\d$", changelog, re.MULTILINE
    ):
        wrong.append(f"CHANGELOG.md has no heading '## [{stated}] - YYYY-MM-DD'")
    return wrong


def missing(names: set[str], wanted: tuple[str, ...]) -> list[str]:
    """Files that an archive lacks."""
    return [f"{name} is missing" for name in wanted if name not in names]


def ran(*command: str | Path, cwd: Path | None = None) -> str:
    """What a command printed.

    Raises:
        RuntimeError: with the end of its output, if it failed.
    """
    done = subprocess.run(
        [str(x) for x in command], cwd=cwd, capture_output=True, text=True
    )
    if done.returncode != 0:
        raise RuntimeError(
            f"{' '.join(map(str, command))} ended with {done.returncode}: "
            f"{(done.stdout + done.stderr)[-1500:]}"
        )
    return done.stdout


def built(folder: Path) -> tuple[Path, Path]:
    """Wheel and sdist, the wheel built from the sdist."""
    ran(sys.executable, "-m", "build", "--outdir", folder, ROOT)
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, sdist


def metadata(*archives: Path) -> list[str]:
    """Nothing, or an exception, if twine finds the metadata faulty."""
    ran(sys.executable, "-m", "twine", "check", "--strict", *archives)
    return []


def contents(wheel: Path, sdist: Path) -> list[str]:
    """Files that wheel or sdist lack."""
    with zipfile.ZipFile(wheel) as archive:
        wrong = missing(set(archive.namelist()), IN_WHEEL)
        if not any(name.endswith("licenses/LICENSE") for name in archive.namelist()):
            wrong.append("the wheel has no LICENSE")
    with tarfile.open(sdist) as archive:
        wrong += missing({name.partition("/")[2] for name in archive.getnames()}, IN_SDIST)
    return wrong


def installed(wheel: Path, home: Path) -> list[str]:
    """What does not work of the wheel in a fresh environment, run from a folder without the
    checkout.
    """
    venv.create(home / "venv", with_pip=True)
    scripts = home / "venv" / ("Scripts" if sys.platform == "win32" else "bin")
    python = scripts / "python"
    command = scripts / "imr-torch"
    ran(python, "-m", "pip", "install", "--quiet", "-c", ROOT / "constraints.txt", wheel)
    wrong = []
    expected = f"imr-torch {version()}"
    for way in ((command,), (python, "-m", "imr_torch")):
        if (said := ran(*way, "--version", cwd=home).strip()) != expected:
            wrong.append(f"{way} --version says {said!r} in place of {expected!r}")
    script = "from imr_torch.cli.options import COMMANDS; print(*COMMANDS)"
    for name in ran(python, "-c", script, cwd=home).split():
        ran(command, name, "--help", cwd=home)
    ran(command, "demo", "--short", "--quiet", cwd=home)
    return wrong + [
        f"the demo wrote no {name}"
        for name in FROM_DEMO
        if not (home / "imr_torch_demo" / name).is_file()
    ]


def main(argv: list[str] | None = None) -> int:
    """Run the checks in turn; the exit status."""
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument(
        "--draft", action="store_true", help="the changelog need not name the version yet"
    )
    options.add_argument(
        "--dist", metavar="DIR", help="keep wheel and sdist here (default: nowhere)"
    )
    args = options.parse_args(argv)
    texts = [(ROOT / name).read_text() for name in ("CITATION.cff", "CHANGELOG.md")]
    with tempfile.TemporaryDirectory() as made:
        home = Path(made)
        dist = Path(args.dist) if args.dist else home / "dist"
        failed = _checked(
            "one version", lambda: disagreements(version(), *texts, draft=args.draft)
        )
        try:
            wheel, sdist = built(dist)
        except RuntimeError as error:
            print(f"FAILED build: {error}")
            return 1
        print(
            f"built {wheel.name} ({wheel.stat().st_size / 1e3:.0f} kB), {sdist.name} "
            f"({sdist.stat().st_size / 1e3:.0f} kB)"
        )
        failed += _checked("metadata", lambda: metadata(wheel, sdist))
        failed += _checked("files", lambda: contents(wheel, sdist))
        failed += _checked("pinned versions", lambda: problems()[0])
        failed += _checked("fresh installation", lambda: installed(wheel, home))
    print("ready" if not failed else f"{failed} check(s) failed")
    return int(failed > 0)


def _checked(name: str, check: Callable[[], list[str]]) -> int:
    """Print what a check found; 1 if it failed."""
    try:
        wrong = check()
    except RuntimeError as error:
        wrong = [str(error)]
    print(
        f"{'FAILED' if wrong else 'ok    '} {name}"
        + "".join(f"\n         {line}" for line in wrong),
        flush=True,
    )
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
