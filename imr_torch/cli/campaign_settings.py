"""What the options of ``imr-torch campaign`` say of choosing, learning and ending."""

import argparse
import math
from collections.abc import Callable
from dataclasses import replace

import torch

from imr_torch.assimilate import NOISE_ROUNDS
from imr_torch.campaign import (
    PAPER_OPTIMAL,
    CampaignSettings,
    DesignPolicy,
    ExactLearner,
    Fixed,
    LearnPopulation,
    Optimal,
    PopulationLearner,
    Random,
    SpaceFilling,
    stopping_rule,
)
from imr_torch.cli.common import METHODS, names_of, parse_pair, parse_values
from imr_torch.cli.design import plan_of, space_of
from imr_torch.errors import InputDataError
from imr_torch.gap import CauseLearner, TellCausesApart
from imr_torch.material import PARAMETERS, Belief, ReferenceCase, library, reference_case
from imr_torch.material.belief import even_belief

_LARGEST = 2.0  # scatter of a logarithm
_CAUSE_SURE = "cause=0.9"  # when a campaign for a cause ends, if nothing else is asked for
_BASELINES: dict[str, Callable[[], DesignPolicy]] = {
    "random": Random,
    "space-filling": SpaceFilling,
}


def settings_of(args: argparse.Namespace) -> CampaignSettings:
    """What the options say of choosing, learning and ending."""
    base = CampaignSettings.paper() if args.method == "paper" else CampaignSettings()
    if args.method != "paper":
        rounds = 0 if args.case else NOISE_ROUNDS  # nobody knows the noise of a camera before
        options = METHODS["map" if args.method == "exact" else args.method]
        base = replace(base, learner=ExactLearner(options=options, noise_rounds=rounds))
    policy = _optimal(args) if args.policy == "optimal" else _baseline(args.policy)
    space = space_of(args)
    plan = plan_of(args)
    if args.goal == "cause":
        learner = CauseLearner(_effect_names(args), estimate_noise=not args.case)
        base = replace(base, learner=learner)
        policy = TellCausesApart(learner) if args.policy == "optimal" else policy
        plan = replace(plan, collapses=None) if args.case else plan
    if args.goal == "population":
        learner = PopulationLearner(noise_rounds=0 if args.case else NOISE_ROUNDS)
        base = replace(base, learner=learner)
        policy = LearnPopulation(_optimal(args)) if args.policy == "optimal" else policy
        plan = (
            replace(plan, repeats=1) if args.repeats is None else plan
        )  # a repeat would be of the same gel
    if isinstance(policy, Fixed):
        space.check_inside(torch.tensor(policy.designs, dtype=torch.float64))
        if args.case and not args.stop and args.designs > len(policy.designs):
            raise InputDataError(
                f"--policy lists {len(policy.designs)} designs and --designs is {args.designs}; "
                "list as many."
            )
    rules = args.stop or ([_CAUSE_SURE] if args.goal == "cause" else [])
    return replace(base, space=space, plan=plan, policy=policy, stop=stopping_rule(*rules))


_OF_GOAL = {"effects": "cause", "hide": "cause", "scatter": "population"}


def check_goal(args: argparse.Namespace) -> None:
    """Raise for options that do not suit the goal."""
    for option, goal in _OF_GOAL.items():
        if args.goal != goal and getattr(args, option) is not None:
            raise InputDataError(f"--{option} has no effect without --goal {goal}.")
    if args.goal != "cause" and any(
        part.strip().startswith("cause=") for text in args.stop for part in text.split(",")
    ):
        raise InputDataError(
            f"--stop is {' '.join(args.stop)!r}: cause= has no effect without --goal cause."
        )
    if args.goal == "gel":
        return
    if args.q != 1 and args.goal == "cause":
        raise InputDataError(
            f"--q is {args.q}; with --goal cause each shot depends on what the last one showed: "
            "leave --q out."
        )
    if args.method != "exact":
        raise InputDataError(
            f"--method is {args.method!r}; --goal {args.goal} learns with the exact likelihood: "
            "leave --method out."
        )
    for option, what in (
        ("hide", "puts an effect into a simulated gel"),
        ("scatter", "is of simulated gels"),
    ):
        if getattr(args, option) is not None and not args.case:
            raise InputDataError(f"--{option} {what}, and has no effect without --case.")
    hidden(args)
    scatter(args)
    _effect_names(args)


def scatter(args: argparse.Namespace) -> dict[str, float]:
    """Standard deviation between simulated shots of the logarithm of each parameter."""
    if args.scatter is None:
        return {}
    truth = reference_case(args.case).truth
    found = {}
    for part in args.scatter.split(","):
        name, _, text = part.partition("=")
        value = parse_number(text)
        name = PARAMETERS[name.strip()].name if value is not None else name
        if value is None or not 0.0 <= value <= _LARGEST or name in found:
            raise InputDataError(
                f"--scatter is {args.scatter!r}; expected NAME=SD, each parameter once and SD "
                f"from 0 to {_LARGEST:g}, as G=.2."
            )
        if truth.get(name, 0.0) <= 0.0:
            raise InputDataError(
                f"--scatter names {name}, which is zero in the gel of {args.case}; name one of "
                f"{', '.join(truth)}."
            )
        found[name] = value
    return found


def parse_number(text: str) -> float | None:
    """A finite number, or None."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def hidden(args: argparse.Namespace) -> dict[str, float]:
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


def one_model(prior: Belief, case: ReferenceCase | None, goal: str) -> Belief:
    """The one model of a campaign for a cause or about a population: that of the simulated gel, or
    the only one named.
    """
    if case:
        return even_belief((prior[case.truth_model],))
    if len(prior.models) > 1:
        raise InputDataError(
            f"--models names {len(prior.models)} ({', '.join(prior.keys)}); with --goal {goal} "
            "name one, as nhkv."
        )
    return prior


def _effect_names(args: argparse.Namespace) -> tuple[str, ...]:
    """The effects that may be the cause; none for the whole library."""
    names = () if args.effects is None else tuple(names_of(args.effects, "--effects"))
    library(names or None)
    return names


def _optimal(args: argparse.Namespace) -> Optimal:
    """The search for the most informative design, of the size that the options ask for."""
    search = PAPER_OPTIMAL if args.method == "paper" else Optimal()
    return replace(
        search, evaluations=args.evaluations, initial=min(search.initial, args.evaluations)
    )


def _baseline(text: str) -> DesignPolicy:
    """The policy of a name, or of a list of designs."""
    if text in _BASELINES:
        return _BASELINES[text]()
    if ":" not in text:
        raise InputDataError(
            f"--policy is {text!r}; expected optimal, {', '.join(_BASELINES)}, or designs "
            "We:R_inf*,..."
        )
    return Fixed(
        tuple(
            pair for part in text.split(",") if (pair := parse_pair(part, "--policy")) is not None
        )
    )
