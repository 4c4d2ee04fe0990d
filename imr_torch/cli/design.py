"""Runs ``imr-torch design``; its help and options are in :mod:`imr_torch.cli.options.design`."""

import argparse
from collections.abc import Callable, Sequence
from typing import Any

from imr_torch.campaign import Optimal
from imr_torch.cli.common import (
    belief_cautions,
    check_counts,
    parse_pair,
    prior_of,
    progress_of,
    show_result,
    simulator_of,
    with_medium,
    write_result,
)
from imr_torch.cli.progress import DESIGN
from imr_torch.design import (
    DesignSearch,
    DesignSpace,
    ExpectedInformationGain,
    ImportanceSampling,
    InformationEstimator,
    Laplace,
    NestedMonteCarlo,
    Plan,
    PriorContrastive,
    PublishedEstimator,
    search_design,
)
from imr_torch.errors import InputDataError
from imr_torch.observe import Nuisance
from imr_torch.results import document_report
from imr_torch.results.plot import information_map
from imr_torch.simulate import coarser
from imr_torch.units import Surroundings

_PUBLISHED_REPEATS = 100
_REPEATS = 10
_MEASURED = Nuisance(
    max_radius=0.01, time_zero=0.01, rest_radius=0.03
)  # of curves filmed in a laboratory
ESTIMATORS: dict[str, Callable[[int], InformationEstimator]] = {
    "laplace": Laplace,
    "importance": ImportanceSampling,
    "nested": NestedMonteCarlo,
    "contrastive": PriorContrastive,
    "paper": PublishedEstimator,
}


def space_of(args: argparse.Namespace) -> DesignSpace:
    """The design space that the options name."""
    weber = parse_pair(args.we_range, "--we-range")
    rest = parse_pair(args.rinf_range, "--rinf-range")
    assert weber is not None
    assert rest is not None
    try:
        return DesignSpace(weber, rest)
    except InputDataError as error:
        raise InputDataError(
            f"--we-range {args.we_range} --rinf-range {args.rinf_range}: {error}"
        ) from None


def plan_of(args: argparse.Namespace) -> Plan:
    """How experiments will be observed: a reference case as published, a gel of one's own as
    laboratories measure.
    """
    if args.case:
        return Plan(repeats=_PUBLISHED_REPEATS if args.repeats is None else args.repeats)
    return Plan(repeats=_REPEATS if args.repeats is None else args.repeats, nuisance=_MEASURED)


def search_to_dict(search: DesignSearch) -> list[dict[str, float]]:
    """JSON-ready rows of all evaluated designs."""
    rows = []
    for design, gain in zip(search.designs.tolist(), search.gains, strict=True):
        row = {"We": design[0], "R_inf*": design[1], "counted": gain.counted, "drawn": gain.drawn}
        if gain.value == gain.value:
            row |= {
                "eig": gain.value,
                "sd": gain.variance**0.5,
                "parameters": gain.parameters,
                "model": gain.model,
            }
        rows.append(row)
    return rows


def run(args: argparse.Namespace) -> None:
    """Search and report."""
    check_counts(args, "q", "evaluations", "draws")
    simulator = simulator_of(args)
    space = space_of(args)
    simulator, prior, medium = with_medium(args, simulator, prior_of(args))
    print(medium.report())
    acquisition = ExpectedInformationGain(
        prior,
        coarser(simulator),
        ESTIMATORS[args.estimator](args.draws),
        target=args.target,
        plan=plan_of(args),
        space=space,
    )
    search = search_design(
        acquisition,
        seed=args.seed,
        q=args.q,
        evaluations=args.evaluations,
        initial=min(Optimal.initial, args.evaluations),
        batch=Optimal.batch,
        strategy=args.strategy,
        progress=progress_of(args, DESIGN),
    )
    steps = (*search.earlier, search)
    document = search_document(steps, simulator.conditions.surroundings)
    document["cautions"] = belief_cautions(args)
    document = write_result(args, document)  # before any figure, so that nothing is lost
    print(document_report(document))
    show_result(args, document)


def search_document(
    steps: Sequence[DesignSearch], surroundings: Surroundings | None = None
) -> dict[str, Any]:
    """JSON-ready result of the searches for one or more designs, with the map of each."""
    medium = surroundings or Surroundings()
    rows = [
        {
            "design": {
                "We": float(step.recommendation.design[0]),
                "R_inf*": float(step.recommendation.design[1]),
                "Rmax_m": float(medium.max_radius(step.recommendation.design[0])),
            },
            "eig": step.recommendation.mean,
            "eig_sd": step.recommendation.sd,
            "evaluations": search_to_dict(step),
            "map": information_map(step),
        }
        for step in steps
    ]
    return rows[0] | ({"joint_eig": steps[-1].joint, "further": rows[1:]} if len(rows) > 1 else {})
