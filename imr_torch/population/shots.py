"""Every shot fitted on its own, with one law of the noise for all, and its posterior weighted by
draws.

The noise is inferred from the residuals of these fits and not from a common one, in which shots
that differ would look like noise (:func:`imr_torch.assimilate.infer_frame_noise`). The cost is
linear in the number of shots.
"""

from collections.abc import Sequence
from dataclasses import replace

from imr_torch.assimilate import (
    NOISE_ROUNDS,
    Assimilation,
    FrameNoise,
    FrameNoisePrior,
    Posterior,
    SearchOptions,
    assimilate,
    infer_frame_noise,
    weigh,
)
from imr_torch.assimilate.noise_estimation import freedom_of
from imr_torch.errors import InputDataError
from imr_torch.material import ModelBelief
from imr_torch.material.belief import even_belief
from imr_torch.observe import Experiment, ExperimentBatch, Noise
from imr_torch.observe.noise import FEWEST_RESIDUALS
from imr_torch.random import child
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress, ProgressLine

_OPTIONS = SearchOptions(starts=2)
_GRADIENT, _AGREEMENT = (
    0.3,
    1.0,
)  # tolerances (posterior standard deviations, nats) of fits that only the noise is taken from
_SAMPLES = 256


@one_torch_thread()
def fit_shots(
    prior: ModelBelief,
    experiments: Sequence[Experiment],
    simulator: Simulator,
    *,
    noise: Noise | None = None,
    rounds: int = NOISE_ROUNDS,
    samples: int = _SAMPLES,
    seed: int = 0,
    options: SearchOptions | None = None,
    progress: Progress | None = None,
) -> tuple[Assimilation, ...]:
    """Fit a model to every experiment by itself.

    Args:
        prior: of the gel of every shot.
        experiments: one a shot; repeats within one are taken to be of the same gel.
        simulator: makes the bubbles.
        noise: law of the observation noise; the published one by default.
        rounds: how often it is inferred from all residuals; 0 keeps it.
        samples: draws of each posterior.
        seed: of everything random.
        options: how the most probable gel is searched for.
        progress: called with one line per shot.

    Returns:
        One weighted assimilation per experiment, all with the same noise.

    Raises:
        InputDataError: without experiments, or for two of one label.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> from imr_torch.population import fit_shots
    >>> simulator, design = PolytropicSimulator(), torch.tensor([400.0, 0.22]).double()
    >>> shots = []
    >>> for number, stiffness in enumerate((7e3, 9e3)):
    ...     laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack({"G": stiffness, "mu": 0.09}), repeats=1)
    ...     shots.append(laboratory.shoot(design, seed=number, label=f"shot {number}"))
    >>> fits = fit_shots(wide_prior(["nhkv"])["nhkv"], shots, simulator, rounds=0, samples=64)
    >>> [round(float(fit.fits[0].posterior.means[0]), -3) for fit in fits]
    [7000.0, 9000.0]
    """
    labels = [experiment.label for experiment in experiments]
    if not labels or len(set(labels)) < len(labels):
        raise InputDataError(f"Shots of different names are needed, got {len(labels)}: {labels}.")
    belief = even_belief((prior,))
    law = noise or Noise()
    options = options or _OPTIONS
    current = None
    fits = []
    steps = (rounds + 2) * len(labels)  # fits of every round, then draws
    for number in range(rounds + 1):
        last = number == rounds
        how = options if last else replace(options, gradient=_GRADIENT, agreement=_AGREEMENT)
        near: Sequence[Assimilation | None] = fits or [None] * len(labels)
        found = []
        for place, (experiment, before) in enumerate(zip(experiments, near, strict=True)):
            own = child(seed, "shot", experiment.label, number)
            batch = ExperimentBatch((experiment,), law)
            batch = batch if current is None else current.of_curve(place).applied(batch)
            found.append(
                assimilate(belief, batch, simulator, seed=own, options=how, near=before, warn=False)
            )
            if progress:
                done = number * len(labels) + len(found)
                text = f"shots: {experiment.label}, {done}/{steps}, round {number + 1}"
                step = f"shots: {experiment.label}"
                progress(ProgressLine(text, stage="shots", step=step, done=done, of=steps))
        fits = found
        if not last:
            current = shared_noise(fits, law, simulator, widen=number + 1 == rounds)
            if progress:
                progress(f"noise {law if current is None else current.law}")
    weighted = []
    for fit, label in zip(fits, labels, strict=True):
        weighted.append(weigh(fit, simulator, seed=child(seed, "weigh", label), samples=samples))
        if progress:
            done = steps - len(labels) + len(weighted)
            text = f"draws: {label}, {done}/{steps}, {weighted[-1].fits[0].trust}"
            progress(ProgressLine(text, step=f"draws: {label}", done=done, of=steps))
    return tuple(weighted)


def shared_noise(
    fits: Sequence[Assimilation], law: Noise, simulator: Simulator, *, widen: bool
) -> FrameNoise | None:
    """The noise, one law for all shots, each with a gel of its own, enlarged if their intervals are
    to be right.

    None where the fits left fewer than ten degrees of freedom.

    Args:
        fits: of the shots.
        law: to begin with.
        simulator: makes the bubbles.
        widen: see :func:`imr_torch.assimilate.noise_estimation.with_inferred_noise`.
    """
    pairs = [(found.fits[0], found.batch) for found in fits]
    if (
        sum(float(batch.mask.sum()) - freedom_of(fit, batch) for fit, batch in pairs)
        < FEWEST_RESIDUALS
    ):
        return None
    near = [Posterior(fit.prior, batch, simulator).neighbourhood(fit.point) for fit, batch in pairs]
    return infer_frame_noise(near, FrameNoisePrior(law)).for_fits(widen=widen)
