"""What the options of ``imr-torch campaign`` say of choosing, learning and ending."""

from argparse import Namespace
from dataclasses import replace

from imr_torch.assimilate import NOISE_ROUNDS
from imr_torch.campaign import (
    CampaignSettings,
    DesignPolicy,
    ExactLearner,
    Learner,
    Optimal,
    Random,
    SpaceFilling,
    stopping_rule,
)
from imr_torch.cli.common import METHODS, parse_values, refuse_options
from imr_torch.cli.design import plan_of, space_of
from imr_torch.errors import InputDataError
from imr_torch.gap import CauseLearner, TellCausesApart
from imr_torch.material import Belief, ReferenceCase, even_belief, library

_CAUSE_SURE = "cause=0.9"  # when a campaign for a cause ends, if nothing else is asked for


def settings_of(args: Namespace) -> CampaignSettings:
    """What the options say of choosing, learning and ending."""
    rounds = 0 if args.case else NOISE_ROUNDS  # nobody knows the noise of a camera before
    options = METHODS["map" if args.method == "exact" else args.method]
    learner: Learner = ExactLearner(options=options, noise_rounds=rounds)
    initial = min(Optimal.initial, args.evaluations)
    policies: dict[str, DesignPolicy] = {
        "optimal": Optimal(evaluations=args.evaluations, initial=initial),
        "random": Random(),
        "space-filling": SpaceFilling(),
    }
    plan = plan_of(args)
    rules = args.stop
    if args.goal == "cause":
        learner = CauseLearner(tuple(args.effects or ()), estimate_noise=not args.case)
        rules = rules or [_CAUSE_SURE]
        policies["optimal"] = TellCausesApart(learner)
        plan = replace(plan, collapses=None) if args.case else plan
    return CampaignSettings(
        space_of(args), plan, policies[args.policy], learner, stopping_rule(*rules)
    )


def check_goal(args: Namespace) -> None:
    """Raise for options that do not suit the goal."""
    if args.goal == "gel":
        refuse_options(args, ("effects", "hide"), "has no effect without --goal cause.")
        if any(
            part.strip().startswith("cause=") for part in ",".join(args.stop).split(",")
        ):
            raise InputDataError(
                f"--stop is {' '.join(args.stop)!r}: cause= has no effect without --goal cause."
            )
        return
    if args.q != 1:
        raise InputDataError(
            f"--q is {args.q}; with --goal cause each shot depends on what the last one showed: "
            "leave --q out."
        )
    if args.method != "exact":
        raise InputDataError(
            f"--method is {args.method!r}; --goal cause learns with the exact likelihood: "
            "leave --method out."
        )
    if not args.case:
        why = "puts an effect into a simulated gel, and has no effect without --case."
        refuse_options(args, ["hide"], why)
    read_hidden(args)
    library(args.effects)


def read_hidden(args: Namespace) -> dict[str, float]:
    """Parameters of the effect that a simulated gel has, SI."""
    if args.hide is None:
        return {}
    name, given, value = args.hide.partition("=")
    if not name:
        raise InputDataError(
            f"--hide is {args.hide!r}; expected an effect, as sound_speed or sound_speed=0.9."
        )
    effect = library([name])[0]
    values = dict(zip(effect.names, effect.starts[0], strict=True))
    if given:
        values |= parse_values(f"{effect.names[0]}={value}", "--hide")
    return values


def one_model(prior: Belief, case: ReferenceCase | None) -> Belief:
    """The one model of a campaign for a cause: that of the simulated gel, or the only one named."""
    if case:
        return even_belief((prior[case.truth_model],))
    if len(prior.models) > 1:
        raise InputDataError(
            f"--models names {len(prior.models)} ({', '.join(prior.keys)}); with --goal cause "
            "name one, as nhkv."
        )
    return prior
