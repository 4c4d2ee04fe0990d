"""Calibration of the inference near one gel: gels of its posterior, each with further curves, are
inferred from the measured and the further curves together.

If prior, likelihood and computation agree, the place of such a gel in the posterior of all curves is
uniform: for gels like this one and these curves, and not on average over the prior (posterior
simulation-based calibration, Säilynoja, Schmitt, Bürkner & Vehtari, arXiv 2502.03279, 2025).
"""

from dataclasses import dataclass, replace
from typing import Any

import scipy  # whose parts are imported when they are used; `stats` takes long
import torch

from imr_torch.assimilate import (
    NOISE_ROUNDS,
    Assimilation,
    FitOptions,
    ModelFit,
    Point,
    Posterior,
    SearchOptions,
)
from imr_torch.calibration.replicate import Arrangement, Replicate, Truth, judge_replicate
from imr_torch.calibration.statistics import uniformity
from imr_torch.design import Plan
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.float64 import randn, zeros
from imr_torch.material import Belief
from imr_torch.observe import Experiment, ExperimentBatch, Noise
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import FrameValues, Progress, ProgressLine

FEWEST_GELS = 10
"""Replicates from which on their places can be tested."""


@dataclass(frozen=True)
class NearGelCheck:
    """How often the intervals of gels like the measured one hold the truth.

    Args:
        model: whose posterior.
        replicates: one for each gel.

    >>> from imr_torch.calibration import NearGelCheck, Replicate
    >>> gels = [Replicate(k, "nhkv", weighted={"G": (k + 0.5) / 20}) for k in range(20)]
    >>> print(NearGelCheck("nhkv", tuple(gels)).sentence)
    On 20 simulated gels like this one 90 % intervals hold G in 18 (15 to 20 would be right).
    """

    model: str
    replicates: tuple[Replicate, ...]

    @property
    def inferred(self) -> list[dict[str, float]]:
        """Where the true values of each gel that was inferred lie in their posteriors."""
        return [r.weighted for r in self.replicates if r.failure is None]

    @property
    def places(self) -> dict[str, list[float]]:
        """Parameter -> where its true values lie in the posteriors of the gels that were inferred."""
        names = self.inferred[0] if self.inferred else ()
        return {name: [place[name] for place in self.inferred] for name in names}

    @property
    def failed(self) -> int:
        """Gels whose inference failed."""
        return len(self.replicates) - len(self.inferred)

    @property
    def held(self) -> dict[str, int]:
        """Parameter -> how many 90 % intervals hold the truth."""
        return {name: sum(abs(x - 0.5) <= 0.45 for x in row) for name, row in self.places.items()}

    @property
    def expected(self) -> tuple[int, int]:
        """Ends of the central range, of 95 %, of that number if the inference is right."""
        low, high = scipy.stats.binom.interval(0.95, len(self.inferred), 0.9)
        return int(low), int(high)

    @property
    def wrong(self) -> list[str]:
        """Parameters whose places are not uniform at a level of 5 % for all together."""
        if len(self.inferred) < FEWEST_GELS:
            return []
        level = 0.05 / len(self.places)
        return [name for name, row in self.places.items() if uniformity(row).p < level]

    @property
    def sentence(self) -> str:
        """The result, and what follows from it."""
        inferred = len(self.inferred)
        if inferred < FEWEST_GELS:
            return (
                f"Inference failed on {self.failed} of {len(self.replicates)} simulated gels like "
                "this one, too many for a statement on its intervals."
            )
        text = f"On {inferred} simulated gels like this one "
        low, high = self.expected
        shares = ", ".join(f"{name} in {number}" for name, number in self.held.items())
        text += f"90 % intervals hold {shares} ({low} to {high} would be right)"
        if self.failed:
            text += f"; inference failed in {self.failed} more"
        if self.wrong:
            text += f"; those of {' and '.join(self.wrong)} do not hold what they state"
        return f"{text}."

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready values."""
        return {
            "model": self.model,
            "gels": len(self.replicates),
            "failed": self.failed,
            "places": self.places,
            "held_90": self.held,
            "expected_90": self.expected,
            "wrong": self.wrong,
            "sentence": self.sentence,
        }


@one_torch_thread()
def check_near_gel(
    fits: Assimilation,
    model: str,
    simulator: Simulator,
    count: int,
    *,
    seed: int,
    samples: int = 256,
    options: FitOptions | None = None,
    progress: Progress = None,
) -> NearGelCheck:
    """Check on gels drawn from the posterior of measured curves whether intervals hold the truth.

    Each has further curves at the same designs and frames, with nuisances of their prior and noise
    of the posterior of its law, and is inferred from the measured and the further curves; the noise
    too, where that of the measured curves was.

    Args:
        fits: of the measured curves, with weighted draws (:func:`imr_torch.assimilate.weigh`).
        model: the model whose posterior is checked.
        simulator: makes the bubbles of truth and inference.
        count: of gels; :data:`FEWEST_GELS` at least for a statement.
        seed: of everything random.
        samples: weighted draws of each round.
        options: how gels are fitted.
        progress: called with one line for each gel.

    Raises:
        InputDataError: if the model has no weighted draws, or an experiment is no curve.
        ConvergenceError: if no gel of the posterior can be simulated.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import SearchOptions, assimilate, weigh
    >>> from imr_torch.calibration import check_near_gel
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=1)
    >>> shot, options = laboratory.shoot(torch.tensor([400.0, 0.22]).double(), seed=1), SearchOptions(raw_samples=16, starts=2)
    >>> fits = assimilate(case.prior, ExperimentBatch((shot,)), simulator, seed=0, options=options)
    >>> weighted = weigh(fits, simulator, seed=0, samples=64)
    >>> found = check_near_gel(weighted, "nhkv", simulator, 1, seed=0, samples=64, options=options)
    >>> found.failed, sorted(found.places)
    (0, ['G', 'mu'])
    """
    fit = fits[model]
    if fit.sample is None:
        raise InputDataError(f"check_near_gel: {model} has no weighted draws; call weigh first.")
    if len(fits.batch.curves) < len(fits.batch.experiments):
        raise InputDataError("check_near_gel is about curves; leave shots of collapse times out.")
    inferred = fits.batch.noise_laws is not None
    start = Noise() if inferred else fits.batch.noise
    arrangement = Arrangement(
        Belief((fits.prior[model],), zeros(1)),
        designs=(),
        plan=Plan(noise=start),
        samples=samples,
        options=options or SearchOptions(),
        noise_rounds=NOISE_ROUNDS if inferred else 0,
    )
    found = []
    for number in range(count):
        own = child(seed, "near", number)
        truth = _draw_truth(fit, fits.batch, simulator, own, arrangement.attempts)
        found.append(judge_replicate(arrangement, truth, number, simulator, seed=own))
        if progress:
            text = f"simulated gel {number + 1} of {count}"
            progress(
                ProgressLine(text, stage="simulated gels", step="gel", done=number + 1, of=count)
            )
    return NearGelCheck(model, tuple(found))


def _draw_truth(
    fit: ModelFit, batch: ExperimentBatch, simulator: Simulator, seed: int, attempts: int
) -> Truth:
    """A gel of the posterior that can be simulated; the measured experiments, and those on it."""
    assert fit.sample is not None
    posterior = Posterior(fit.prior, batch, simulator)
    for attempt in range(attempts):
        source = generator(child(seed, "gel", attempt))
        row = torch.multinomial(fit.sample.weights, 1, generator=source)
        gel = fit.sample.controls[row]
        nuisances = randn(1, *batch.nuisance_sds.shape, generator=source)
        clean = posterior.predict(Point(gel, nuisances))[0]
        if bool(torch.isfinite(clean).all()):
            law = _draw_law(batch, source)
            further = [
                _shoot_again(e, clean[k, : len(e.times)], law, source)
                for k, e in enumerate(batch.curves)
            ]
            return Truth(fit.model, gel[0], (*batch.curves, *further), attempt)
    raise ConvergenceError(
        f"None of {attempts} gels of the posterior of {fit.model!r} could be simulated."
    )


def _draw_law(batch: ExperimentBatch, source: torch.Generator) -> Noise:
    """A law of the posterior of the noise; the one that is known where it was not inferred."""
    laws = batch.noise_laws
    if laws is None:
        return batch.noise
    row = int(torch.multinomial(laws.weights, 1, generator=source))
    factor = float(torch.exp(laws.log_scale_sds[row] * randn(1, generator=source)))
    return laws.laws[row].scaled(factor)


def _shoot_again(
    experiment: Experiment, clean: FrameValues, law: Noise, source: torch.Generator
) -> Experiment:
    """Curves like those of an experiment, of a true curve."""
    own = law.scaled(experiment.noise_factor)
    radius = own.draw(clean, experiment.times, experiment.repeats, generator=source)
    label = f"{experiment.label}, simulated"
    return replace(
        experiment, label=label, radius=radius, noise_factor=1.0, noise_factor_sd=0.0, weight=1.0
    )
