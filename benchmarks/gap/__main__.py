"""All evidence on the gap diagnosis by one command and one version of the code, and which version
made each record.

  python -m benchmarks.gap run FOLDER [--seed 80000] [--labelled SETS] [--measured CURVES]
  python -m benchmarks.gap versions

`run` makes a record of each path in FOLDER, one after the other: sets of repeats; what is missing
as a function, of effects of the library and of others; further shots; single curves whose noise is
inferred, without an effect, with one and with gels that differ; sets of a separate program; measured
curves. Each goes on where it stopped.
At the end the hashes of the code are compared: all lines must be of one version. `versions` prints
the table of `benchmarks/RESULTS.md` that says whether a record is of the present code; a test
compares both.
"""

import argparse
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from benchmarks.records import DECIDING, hash_code, read_record, start_parser, write_table

RECORDS = Path(__file__).resolve().parents[1] / "records"


def list_commands(args: argparse.Namespace) -> Iterator[tuple[str, str, list[str]]]:
    """Record, module and arguments of each path."""
    seed = str(args.seed)
    for name, options in (
        ("repeats", ["--sets", "67"]),
        ("unknown", ["--sets", "60"]),
        ("foreign", ["--sets", "4"]),
        ("further_shots", ["--sets", "120"]),
        ("single_curves", ["--sets", "300", "--every", "2"]),
    ):
        yield name, f"gap.{name}", ["run", "OUT", *options, "--seed", seed]
    if args.labelled is not None:
        yield "labelled", "gap.repeats", ["labelled", str(args.labelled), "OUT"]
        yield (
            "single_curves_labelled",
            "gap.single_curves",
            ["labelled", str(args.labelled), "OUT", "--stated"],
        )
    if args.measured is not None:
        yield "real_gels", "real_gels", ["run", str(args.measured), "OUT"]


def write_versions(folder: Path = RECORDS) -> str:
    """Which code made each record of a folder, in Markdown."""
    present = hash_code(*DECIDING)
    rows = []
    for path in sorted(folder.glob("*.jsonl")):
        codes = {line.get("code", "not recorded") for line in read_record(path)}
        told = "yes" if codes == {present} else "no"
        rows.append((f"`{path.stem}`", ", ".join(sorted(codes)), told))
    return write_table(("record", "hash of the code", "present code"), rows)


def main() -> None:
    """Run every path, or print which code made the records."""
    parser = start_parser(__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    runs = commands.add_parser("run", help="every path, one after the other")
    runs.add_argument("folder", type=Path)
    runs.add_argument(
        "--seed", type=int, default=80000, help="sets that were not used before"
    )
    runs.add_argument("--labelled", type=Path, help="folder of sets of a separate program")
    runs.add_argument("--measured", type=Path, help="folder of measured curves")
    commands.add_parser("versions", help="which code made each record")
    args = parser.parse_args()
    if args.command == "run":
        for name, module, arguments in list_commands(args):
            out = str(args.folder / f"{name}.jsonl")
            given = [out if word == "OUT" else word for word in arguments]
            subprocess.run(
                [sys.executable, "-m", f"benchmarks.{module}", *given], check=True
            )
        print(write_versions(args.folder))
    else:
        print(write_versions())


if __name__ == "__main__":
    main()
