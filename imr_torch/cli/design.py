"""Find the experiment that is expected to tell most: the (We, R_inf*) of largest expected information gain.

imr-torch design --case stiff-pa --out next
imr-torch design --belief posterior.json --we-range 150:600 --rinf-range 0.15:0.25
"""

import argparse
from pathlib import Path
from typing import get_args

from imr_torch.campaign import Optimal
from imr_torch.cli.common import (
    add_physics_argument,
    add_prior_arguments,
    add_workers_argument,
    parse_pair,
    prior_of,
    progress_of,
    save_figure,
    simulator_of,
    write_result,
)
from imr_torch.design import (
    POLICIES,
    DesignSearch,
    DesignSpace,
    Estimator,
    ExpectedInformationGain,
    Method,
    Plan,
    search_design,
)
from imr_torch.observe import Nuisance
from imr_torch.plot import plot_information

_PUBLISHED_REPEATS, _REPEATS = 100, 10
_MEASURED = Nuisance(max_radius=0.01, time_zero=0.01, rest_radius=0.03)  # of curves filmed in a laboratory
NAME = "design"
SUMMARY = "the most informative next experiment"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    add_space_arguments(parser)
    parser.add_argument("--policy", choices=tuple(POLICIES), default="qLogNEI", help="how designs are chosen (default qLogNEI)")
    parser.add_argument(
        "--estimator", choices=get_args(Method), default="laplace", help="of the information gain (default laplace)"
    )
    parser.add_argument("--draws", type=int, default=32, help="draws per model of each estimate (default 32)")
    parser.add_argument("--out", metavar="DIR", help="folder for the map and JSON")
    add_physics_argument(parser)
    add_workers_argument(parser)
    add_prior_arguments(parser)


def add_space_arguments(parser: argparse.ArgumentParser) -> None:
    """Options for the designs a laboratory can shoot and how it will observe them."""
    parser.add_argument("--we-range", default="100:1000", metavar="LOW:HIGH", help="Weber numbers (default 100:1000)")
    parser.add_argument("--rinf-range", default="0.14:0.30", metavar="LOW:HIGH", help="R_inf/Rmax (default 0.14:0.30)")
    parser.add_argument(
        "--repeats", type=int, help="curves per design (default 100 with --case, as in the literature, else 10)"
    )
    parser.add_argument("--evaluations", type=int, default=25, help="designs evaluated in each search (default 25)")


def space_of(args: argparse.Namespace) -> DesignSpace:
    """The design space that the options name."""
    weber, rest = parse_pair(args.we_range, "--we-range"), parse_pair(args.rinf_range, "--rinf-range")
    assert weber is not None
    assert rest is not None
    return DesignSpace(weber, rest)


def plan_of(args: argparse.Namespace) -> Plan:
    """How experiments will be observed: a reference case as published, a gel of one's own as laboratories measure."""
    if args.case:
        return Plan(repeats=_PUBLISHED_REPEATS if args.repeats is None else args.repeats)
    return Plan(repeats=_REPEATS if args.repeats is None else args.repeats, nuisance=_MEASURED)


def search_to_dict(search: DesignSearch) -> list[dict[str, float]]:
    """JSON-ready rows of all evaluated designs."""
    rows = []
    for design, gain in zip(search.designs.tolist(), search.gains, strict=True):
        row = {"We": design[0], "R_inf*": design[1], "counted": gain.counted, "drawn": gain.drawn}
        if gain.value == gain.value:
            row |= {"eig": gain.value, "sd": gain.variance**0.5, "parameters": gain.parameters, "model": gain.model}
        rows.append(row)
    return rows


def run(args: argparse.Namespace) -> None:
    """Search and report."""
    simulator, space = simulator_of(args), space_of(args)
    acquisition = ExpectedInformationGain(
        prior_of(args), simulator, plan=plan_of(args), space=space, estimator=Estimator(args.estimator, args.draws)
    )
    search = search_design(
        acquisition,
        seed=args.seed,
        evaluations=args.evaluations,
        initial=min(Optimal.initial, args.evaluations),
        batch=Optimal.batch,
        policy=POLICIES[args.policy],
        progress=progress_of(args),
    )
    best = search.recommendation
    print(f"Shoot {space.describe(best.design, simulator.conditions.surroundings)}")
    print(f"expected information gain {best.mean:.3f} +- {best.sd:.3f} nats")
    if args.out:
        print(f"wrote {save_figure(plot_information(search), Path(args.out), 'information')}")
    design = {"We": float(best.design[0]), "R_inf*": float(best.design[1])}
    write_result(args, {"design": design, "eig": best.mean, "eig_sd": best.sd, "evaluations": search_to_dict(search)})
