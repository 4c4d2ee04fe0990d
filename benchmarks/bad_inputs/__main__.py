"""Run the bad inputs from the command line, and count what came of them."""

import sys
import tempfile
from collections import Counter
from pathlib import Path

import torch

import benchmarks.bad_inputs as bad_inputs
from benchmarks.bad_inputs import Outcome, cases, prepared, tried
from benchmarks.records import start_parser


def start() -> int:
    """Run the benchmark from the command line."""
    parser = start_parser(bad_inputs.__doc__)
    parser.add_argument("--only", default="", help="cases whose name holds this")
    parser.add_argument("--kind", default="", help="cases of this kind")
    parser.add_argument(
        "--fuzz", type=int, default=40, help="damaged files of each kind (default 40)"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    found: list[Outcome] = []
    with tempfile.TemporaryDirectory() as home:
        prepared(Path(home) / "good")
        for case in cases(Path(home) / "good", args.fuzz):
            if args.only in case.name and args.kind in case.kind:
                found.append(tried(case, Path(home)))
                if found[-1].verdict != "handled":
                    last = found[-1]
                    print(
                        f"{last.verdict}: {case.kind}: {case.name} ({last.seconds:.1f} s): "
                        f"{last.said.strip()[-300:]}",
                        flush=True,
                    )
    table_ = Counter((outcome.case.kind, outcome.verdict) for outcome in found)
    verdicts = ("handled", "accepted", "traceback", "unclear", "slow")
    print(f"{'kind':10s}" + "".join(f"{name:>11s}" for name in ("tried", *verdicts)))
    for kind in [*dict.fromkeys(outcome.case.kind for outcome in found), "all"]:
        row = [
            sum(n for (k, v), n in table_.items() if kind in (k, "all") and v == name)
            for name in verdicts
        ]
        print(f"{kind:10s}" + "".join(f"{n:11d}" for n in (sum(row), *row)))
    used = sum(outcome.case.damaged and outcome.reached for outcome in found)
    print(
        f"{used} of {sum(outcome.case.damaged for outcome in found)} damaged files were used, "
        "what is left of them being valid"
    )
    print(f"slowest {max((o.seconds for o in found), default=0.0):.1f} s")
    return int(any(o.verdict != "handled" for o in found))


if __name__ == "__main__":
    sys.exit(start())
