"""Whether a curve is new and can be simulated under a belief, asked before it enters a journal.

A curve whose times or size are in another unit is found by the bubbles of the belief: they fail, or
collapse at another time than the curve does by orders of magnitude.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from imr_torch.campaign.journal import curve_hash
from imr_torch.errors import InputDataError
from imr_torch.material import Belief
from imr_torch.observe import Experiment, ExperimentBatch, Noise, collapse_time, predict
from imr_torch.observe.plausibility import RAYLEIGH_TIME
from imr_torch.random import child
from imr_torch.simulate import Simulator


def check_whole(experiment: Experiment, max_method: str, *, fewest: int = 10) -> None:
    """Raise for a curve that shows too little of a bubble to learn from: a shot that failed.

    Args:
        experiment: cut to the window that is assimilated.
        max_method: how its maximum was found, of :class:`imr_torch.observe.Landmarks`.
        fewest: frames that it must have.

    Raises:
        InputDataError: if it has fewer frames, its maximum is not in the record, or it shows no
            collapse.
    """
    count = len(experiment.times)
    reason = ""
    if count < fewest:
        reason = f"has {count} frames to fit, and at least {fewest} are needed"
    elif max_method == "edge":
        reason = (
            "begins after its maximum radius (cut off by the edge of the picture, or filmed too "
            "late); if that is known, state Rmax_m in the JSON file beside it"
        )
    elif not math.isfinite(collapse_time(experiment.times, experiment.mean, 1)):
        reason = "shows no collapse"
    if reason:
        raise InputDataError(f"Experiment {experiment.label!r} {reason}.")


def check_simulated(
    belief: Belief,
    experiment: Experiment,
    simulator: Simulator,
    noise: Noise,
    seed: int,
    *,
    draws: int = 8,
    factor: float = 30.0,
) -> None:
    """Raise unless at least one gel of the belief gives a curve at the design and times of an
    experiment.

    Args:
        belief: gels of each model are drawn from it.
        experiment: cut to the window that is assimilated.
        simulator: makes the bubbles.
        noise: law of the observation noise.
        seed: of the draws.
        draws: gels of each model.
        factor: times earlier or later than that of an empty bubble that a collapse may be.

    Raises:
        InputDataError: if no bubble could be simulated, or the curve collapses too early or too
            late.
    """
    name, (weber, rest) = f"Experiment {experiment.label!r}", experiment.design
    collapse = collapse_time(experiment.times, experiment.mean, 1)
    last = float(experiment.times[-1])
    late = factor * RAYLEIGH_TIME < collapse < math.inf
    if late or (collapse < RAYLEIGH_TIME / factor and last < RAYLEIGH_TIME):
        raise InputDataError(
            f"{name} collapses first at a dimensionless time of {collapse:.3g}; bubbles do near "
            f"{RAYLEIGH_TIME}. Its times or "
            "its radii are in another unit than stated: correct the file or its layout, and tell "
            "it again."
        )
    batch = ExperimentBatch((experiment,), noise)
    for part in belief.models:
        controls = part.controls(draws, seed=child(seed, "admission"))
        with torch.no_grad():
            radius = predict(simulator, part.parameters(controls), batch)
        if radius.isfinite().all(-1).any():
            return
    raise InputDataError(
        f"{name} at (We, R_inf*) = ({weber:g}, {rest:g}) and times up to {last:.3g} cannot be "
        f"simulated: all {draws} gels "
        f"drawn of each of {', '.join(belief.keys)} failed. Check Rmax, R_inf and the units of "
        "the file; nothing was recorded."
    )


def check_new(
    experiments: Sequence[Experiment],
    told: Mapping[int, Experiment],
    outstanding: Sequence[int],
    journal: Path,
) -> None:
    """Raise if a curve was told before, or is given twice.

    Args:
        experiments: to be told.
        told: those that were told before, by number.
        outstanding: numbers of those that were told and not learnt yet.
        journal: where they are, for the message.
    """
    known = {curve_hash(experiment): number for number, experiment in told.items()}
    given: dict[str, str] = {}
    for experiment in experiments:
        curve = curve_hash(experiment)
        if curve in known:
            number = known[curve]
            waiting = (
                " It was not learnt yet; resuming without telling it again does so."
                * (number in outstanding)
            )
            raise InputDataError(
                f"Experiment {experiment.label!r} has the curve of experiment {number} "
                f"({told[number].label!r}), which is in "
                f"{journal} already; each curve counts once.{waiting} Tell only new curves; to "
                "replace this one, "
                f"forget it first: Campaign.forget({number}), imr-torch campaign --resume "
                f"--forget {number}."
            )
        if curve in given:
            raise InputDataError(
                f"Experiments {given[curve]!r} and {experiment.label!r} have the same curve, "
                "which counts once: omit one."
            )
        given[curve] = experiment.label
