"""Inference of the population that the gels of several shots are from: its median, the scatter,
each shot's own values.

Every control of a model's parameters is normal over shots: ``z_e ~ N(m, T)``, so a parameter with a
log-normal prior is log-normal over shots. The centre ``m`` has the model's prior, each scatter an
independent half-normal prior (Gelman, Bayesian Analysis 1, 2006), and whether a parameter varies at
all is decided by evidence, over all sets of parameters that may vary.

Every shot is first fitted on its own, with one law of the noise for all, and its posterior weighted
by draws (:func:`fit_shots`). The noise is inferred from the residuals of these fits and not from a
common one, in which shots that differ would look like noise
(:func:`imr_torch.assimilate.infer_frame_noise`). The cost is linear in the number of shots. The
population needs these draws alone (:class:`~imr_torch.population.ShotLikelihood`) and simulates
nothing.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain, combinations

import torch

from imr_torch.assimilate import (
    FIRST_JITTER,
    NOISE_ROUNDS,
    Assimilation,
    FrameNoise,
    FrameNoisePrior,
    SearchOptions,
    assimilate,
    infer_frame_noise,
    weigh,
)
from imr_torch.assimilate.noise_estimation import freedom_of
from imr_torch.errors import InputDataError
from imr_torch.float64 import tensor, zeros
from imr_torch.material import LogNormal, ModelBelief, even_belief
from imr_torch.observe import Experiment, ExperimentBatch, Noise
from imr_torch.observe.noise import FEWEST_RESIDUALS
from imr_torch.population.closed_form import MOST
from imr_torch.population.likelihood import ShotLikelihood
from imr_torch.population.result import BayesFactor, Population, ScaleCheck
from imr_torch.population.sampling import (
    Problem,
    WeightedPopulation,
    jackknife_error,
    sample_population,
)
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import Controls, Progress, report_progress

SCALE = 0.3
"""Scale of the half-normal prior of each scatter: of ln G, ln mu, and of the control of other parameters."""


@one_torch_thread()
def fit_shots(
    prior: ModelBelief,
    experiments: Sequence[Experiment],
    simulator: Simulator,
    *,
    noise: Noise | None = None,
    rounds: int = NOISE_ROUNDS,
    samples: int = 256,
    seed: int = 0,
    options: SearchOptions | None = None,
    early: tuple[float, float] = (0.3, 1.0),
    progress: Progress = None,
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
        options: how the most probable gel is searched for; from two starts when not given.
        early: tolerances (gradient in posterior standard deviations, agreement of starts in nats)
            of fits that only the noise is taken from.
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
        raise InputDataError(
            f"Shots of different names are needed, got {len(labels)}: {labels}."
        )
    belief = even_belief((prior,))
    law = noise or Noise()
    first = replace(law, jitter=FIRST_JITTER) if rounds else law
    options = options or SearchOptions(starts=2)
    current = None
    fits = []
    draws = 5  # which take as long as so many fits
    steps = (rounds + 1 + draws) * len(labels)

    def report_shot(what: str, label: str, done: int, state: str) -> None:
        step = f"{what}: {label}"
        text = f"{step}, {done}/{steps}, {state}"
        report_progress(progress, text, stage="shots", step=step, done=done, of=steps)

    for number in range(rounds + 1):
        last = number == rounds
        how = options if last else replace(options, gradient=early[0], agreement=early[1])
        near: Sequence[Assimilation | None] = fits or [None] * len(labels)
        found = []
        for place, (experiment, before) in enumerate(zip(experiments, near, strict=True)):
            own = child(seed, "shot", experiment.label, number)
            batch = ExperimentBatch((experiment,), first)
            batch = batch if current is None else current.of_curve(place).applied(batch)
            found.append(
                assimilate(
                    belief, batch, simulator, seed=own, options=how, near=before, warn=False
                )
            )
            done = number * len(labels) + len(found)
            report_shot("shots", experiment.label, done, f"round {number + 1}")
        fits = found
        if not last:
            current = share_noise(fits, law, simulator, widen=number + 1 == rounds)
            if progress:
                progress(f"noise {law if current is None else current.law}")
    weighted = []
    for fit, label in zip(fits, labels, strict=True):
        weighted.append(
            weigh(fit, simulator, seed=child(seed, "weigh", label), samples=samples)
        )
        done = steps - draws * (len(labels) - len(weighted))
        report_shot("draws", label, done, weighted[-1].fits[0].trust)
    return tuple(weighted)


def share_noise(
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
    frames = sum(float(found.batch.mask.sum()) for found in fits)
    taken = sum(freedom_of(found.fits[0], found.batch) for found in fits)
    if frames - taken < FEWEST_RESIDUALS:
        return None
    near = [found.fits[0].linearise(found.batch, simulator) for found in fits]
    return infer_frame_noise(near, FrameNoisePrior(law)).for_fits(widen=widen)


@one_torch_thread()
def infer_population(
    fits: Sequence[Assimilation],
    *,
    varying: Sequence[str] | None = None,
    scale: float = SCALE,
    draws: int = 4000,
    seed: int = 0,
) -> Population:
    """Infer median, scatter and every shot's own values.

    Args:
        fits: one weighted assimilation of one model per shot, as of :func:`fit_shots`.
        varying: parameters that may differ from shot to shot, all of the gel when not given; the
            others, and what is inferred of the medium, are the same in all.
        scale: of the half-normal prior of the scatters.
        draws: of population, scatters and shots; half as many for each evidence.
        seed: of these draws.

    Raises:
        InputDataError: for fewer than two shots, shots of different models or priors, an unknown
            parameter, more than four that vary, or a scale that is not positive.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> from imr_torch.population import fit_shots, infer_population
    >>> simulator, design = PolytropicSimulator(), torch.tensor([400.0, 0.22]).double()
    >>> shots = []
    >>> for number, stiffness in enumerate((6e3, 7e3, 9e3, 10e3)):
    ...     laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack({"G": stiffness, "mu": 0.09}), repeats=1)
    ...     shots.append(laboratory.shoot(design, seed=number, label=f"shot {number}"))
    >>> fits = fit_shots(wide_prior(["nhkv"])["nhkv"], shots, simulator, rounds=0, samples=64)
    >>> population = infer_population(fits)
    >>> population.by_parameter["G"].value > 0.0 > population.by_parameter["mu"].value  # G differs, and mu does not
    True
    """
    prior = _check_shots(fits, varying, scale, draws)
    shots = tuple(map(ShotLikelihood.of, fits))
    names = prior.names
    units = coordinate_units(prior)
    columns = [names.index(name) for name in (varying or prior.of_gel)]

    def draw_population(
        which: Sequence[int], width: float, count: int, *key: str | int
    ) -> WeightedPopulation:
        scales = zeros(len(names))
        scales[list(which)] = width / units[list(which)]
        source = generator(child(seed, *key))
        return sample_population(Problem(shots, prior, scales), count, source)

    def draw_sets(width: float) -> dict[tuple[int, ...], WeightedPopulation]:
        """Of every set of the parameters that may vary."""
        sizes = range(len(columns) + 1)
        sets = chain.from_iterable(combinations(columns, size) for size in sizes)
        return {
            which: draw_population(which, width, draws // 2, "evidence", *which)
            for which in sets
        }

    found = draw_population(columns, scale, draws, "population")
    evidence = draw_sets(scale)
    checks = []
    for width in (0.5 * scale, 2.0 * scale):
        other = draw_population(columns, width, draws, "population")
        intervals = {
            names[i]: other.take_quantiles(other.scatter[:, i] * units[i]).tolist()
            for i in columns
        }
        checks.append(
            ScaleCheck(width, _bayes_factor(draw_sets(width), columns), intervals)
        )
    return Population(
        prior=prior,
        shots=shots,
        designs=torch.cat([fit.batch.designs for fit in fits]),
        noise=fits[0].batch.noise,
        varying=tuple(names[i] for i in columns),
        units=units,
        scale=scale,
        found=found,
        log_evidence=float(found.log_evidences[0]),
        any_scatter=_bayes_factor(evidence, columns),
        by_parameter={names[i]: _bayes_factor(evidence, [i]) for i in columns},
        checks=tuple(checks),
    )


def coordinate_units(prior: ModelBelief) -> Controls:
    """What a control of 1 is in the coordinate whose scatter is stated, a logarithm where there is
    one.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.population import coordinate_units
    >>> [round(x, 2) for x in coordinate_units(wide_prior(["gen_qkv"])["gen_qkv"]).tolist()]  # ln 5, ln 3, the control of alpha
    [1.61, 1.1, 1.0]
    """
    values = [
        math.log(m.factor) if isinstance(m, LogNormal) else 1.0 for m in prior.marginals
    ]
    return tensor(values)


def _check_shots(
    fits: Sequence[Assimilation], varying: Sequence[str] | None, scale: float, draws: int
) -> ModelBelief:
    """The prior that all shots share."""
    if len(fits) < 2:
        raise InputDataError(f"A population needs at least two shots, got {len(fits)}.")
    for fit in fits:
        if len(fit.fits) != 1 or len(fit.batch.experiments) != 1:
            raise InputDataError(
                f"Each shot needs a fit of one model to one experiment; one has {len(fit.fits)} "
                "models and "
                f"{len(fit.batch.experiments)} experiments. Use fit_shots."
            )
    prior = fits[0].fits[0].prior
    for fit in fits[1:]:
        other = fit.fits[0].prior
        if not other.same_as(prior):
            raise InputDataError(
                f"The shots were fitted with different models or priors: {prior.model!r}, "
                f"{other.model!r}."
            )
    unknown = [name for name in varying or () if name not in prior.names]
    if unknown:
        raise InputDataError(
            f"varying: {unknown[0]!r} is no free parameter of {prior.model!r}, which has "
            f"{prior.names}."
        )
    count = len(prior.of_gel if varying is None else set(varying))
    if not 1 <= count <= MOST:
        raise InputDataError(
            f"{count} parameters would vary from shot to shot; at least 1 and at most {MOST} can. "
            "Name them in `varying`."
        )
    if not 0.0 < scale < math.inf or draws < 500:
        raise InputDataError(
            f"scale is {scale} and draws {draws}; expected a positive scale and at least 500 draws."
        )
    return prior


def _bayes_factor(
    evidence: Mapping[tuple[int, ...], WeightedPopulation], columns: Sequence[int]
) -> BayesFactor:
    """Mean evidence of the sets in which one of some parameters varies, over that of the others."""
    means = []
    variance = 0.0
    for varies in (True, False):
        some = [
            found for s, found in evidence.items() if varies is bool(set(s) & set(columns))
        ]
        logs = torch.stack([found.log_evidences for found in some])
        means.append(torch.logsumexp(logs, 0) - math.log(len(some)))
        errors = tensor([found.evidence_error for found in some])
        variance += float((torch.softmax(logs[:, 0], 0) * errors).square().sum())
    difference = means[0] - means[1]
    return BayesFactor(
        float(difference[0]),
        math.hypot(math.sqrt(variance), jackknife_error(difference[1:])),
        all(found.reliable for found in evidence.values()),
    )
