"""Runs ``imr-torch design``."""

from argparse import Namespace

from imr_torch.campaign import Optimal, camera_variants, forecast_shots, stopping_rule
from imr_torch.campaign.forecast import check_target
from imr_torch.cli.common import (
    belief_cautions,
    exact_medium,
    prior_of,
    report_result,
    with_medium,
)
from imr_torch.design import (
    DesignSpace,
    ExpectedInformationGain,
    Laplace,
    Plan,
    choose_sequence,
    design_document,
    load_designs,
    search_design,
)
from imr_torch.errors import InputDataError
from imr_torch.files import Document
from imr_torch.observe import Nuisance
from imr_torch.simulate import coarser

_MEASURED = Nuisance(
    max_radius=0.01, time_zero=0.01, rest_radius=0.03
)  # of curves filmed in a laboratory


def space_of(args: Namespace) -> DesignSpace:
    """The design space that the options name."""
    if vars(args).get("settable"):
        return load_designs(args.settable)
    try:
        return DesignSpace(args.we_range, args.rinf_range)
    except InputDataError as error:
        said = str(error).replace("DesignSpace.weber", "--we-range")
        raise InputDataError(
            said.replace("DesignSpace.rest_radius", "--rinf-range")
        ) from None


def plan_of(args: Namespace) -> Plan:
    """How experiments will be observed: a reference case as published, a gel of one's own as
    laboratories measure.
    """
    if args.case:
        return Plan(repeats=args.repeats or 100)
    return Plan(repeats=args.repeats or 10, nuisance=_MEASURED)


def run_command(args: Namespace) -> None:
    """Search and report."""
    space = space_of(args)
    simulator, prior, medium = with_medium(args, prior_of(args))
    print(medium.report())
    rule = stopping_rule(*filter(None, [args.until]))
    if rule:
        check_target(rule, prior)
    bubbles = coarser(simulator)
    plan = plan_of(args)
    surroundings = simulator.conditions.surroundings
    document: Document = {}
    if rule:
        chosen = choose_sequence(
            prior, bubbles, args.shots, plan=plan, space=space, seed=args.seed
        )
        ways = {"one design repeated": (chosen[:1].expand_as(chosen), plan)}
        ways |= {what: (chosen, other) for what, other in camera_variants(plan).items()}
        rows = [
            {"what": what}
            | forecast_shots(prior, designs, bubbles, other, rule, seed=args.seed).to_dict()
            for what, (designs, other) in ways.items()
        ]
        sequence = [design_document(design, surroundings) for design in chosen]
        document["forecast"] = {
            "until": args.until,
            "most": args.shots,
            "rows": rows,
            "designs": sequence,
        }
    acquisition = ExpectedInformationGain(
        prior, bubbles, Laplace(args.draws), target=args.target, plan=plan, space=space
    )
    search = search_design(
        acquisition,
        seed=args.seed,
        q=args.q,
        evaluations=args.evaluations,
        initial=min(Optimal.initial, args.evaluations),
        batch=Optimal.batch,
        progress=args.terminal.plan_stages(),
    )
    first, *further = (
        step.to_dict(surroundings)
        | {"eig": step.recommendation.mean, "eig_sd": step.recommendation.sd}
        for step in (*search.earlier, search)
    )
    document |= {"joint_eig": search.joint, "further": further} if further else {}
    document |= {
        "cautions": belief_cautions(args),
        "medium_unstated": exact_medium(args, prior),
    }
    report_result(args, first | document)
