"""How often the calls of a likelihood, an information gain and its acquisition change file on their
way to the compiled engine.

  python tools/call_trace.py [--list]

Every call of a Python function of the package is followed, from the call that a user makes to the
compiled engine's first bubble. A change of file is a call whose function stands in another file
than that of the call before. Each is traced the second time it runs, when tables that are made once
are made; what the user builds beforehand (prior, simulator, plan, estimator, data) is not counted.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import torch

import imr_torch
from imr_torch.assimilate import Point, Posterior
from imr_torch.design import (
    ExpectedInformationGain,
    Laplace,
    Plan,
    expected_information_gain,
)
from imr_torch.material import PARAMETERS, reference_case
from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
from imr_torch.simulate import TransportSimulator

ROOT = Path(imr_torch.__file__).parent
ENGINE = ("simulate/compiled/run.py", "_share_out")
Call = tuple[str, str]


def calls(work: Callable[[], Any]) -> list[Call]:
    """File and name of each function of the package that is called, up to the compiled engine."""
    found: list[Call] = []

    def note(frame: FrameType, event: str, argument: Any) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(ROOT) and ENGINE not in found:
            found.append((path.relative_to(ROOT).as_posix(), frame.f_code.co_qualname))

    work()
    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(None)
    return found


def visits(found: list[Call]) -> list[tuple[str, list[str]]]:
    """The calls, those that follow each other in one file together."""
    grouped: list[tuple[str, list[str]]] = []
    for file, name in found:
        if not grouped or grouped[-1][0] != file:
            grouped.append((file, []))
        grouped[-1][1].append(name)
    return grouped


def traced() -> dict[str, list[Call]]:
    """The calls of one likelihood, of one information gain and of the acquisition that users call,
    full physics.
    """
    case = reference_case("stiff-pa")
    simulator = TransportSimulator(threads=1)
    X = torch.tensor([[900.0, 0.28]], dtype=torch.float64)
    plan = Plan()
    estimator = Laplace(draws=2)
    shot = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=1).shoot(
        X[0], seed=0
    )
    posterior = Posterior(case.prior.models[0], ExperimentBatch((shot,)), simulator)
    point = Point(
        torch.zeros(1, posterior.size, dtype=torch.float64), posterior.mean_nuisances(1)
    )
    acquisition = ExpectedInformationGain(case.prior, simulator, estimator, plan=plan)
    return {
        "likelihood": calls(lambda: posterior.log_joint(point)),
        "information gain": calls(
            lambda: expected_information_gain(
                case.prior, X, simulator, plan, estimator=estimator, seed=0
            )
        ),
        "acquisition": calls(lambda: acquisition(X[None])),
    }


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--list", action="store_true", help="print every call too")
    args = parser.parse_args()
    for name, found in traced().items():
        files = visits(found)
        print(
            f"{name}: {len(found)} calls, {len(files) - 1} changes of file over "
            f"{len({file for file, _ in files})} files"
        )
        for file, names in files if args.list else ():
            print(f"  {file}: {', '.join(names)}")


if __name__ == "__main__":
    main()
