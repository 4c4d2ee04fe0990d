"""Hypotheses of a diagnosis: the base model alone, with effects freed, or with a gel of its own in
each curve.

A hypothesis is the base model's prior with the effects' priors beside it, so everything that fits,
weighs or designs for models does so for causes. Gels that differ are further nuisances of the
experiments (``ExperimentBatch.between``).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.float64 import tensor
from imr_torch.gap.adequacy import Adequacy, adequacy_test
from imr_torch.material import Effect, ModelBelief, add_parameters
from imr_torch.observe import NUISANCES, ExperimentBatch
from imr_torch.population import SCALE
from imr_torch.simulate import Simulator
from imr_torch.types import Progress

EXPLAINS = 3.0
"""Nats that an effect must explain to count as more than nothing."""
GEL_SCATTER = "gel_scatter"
"""Name of the hypothesis that the gel differs between experiments."""
# prior standard deviations between the starts of a fit that frees no effect
_GEL_APART = 0.25


@dataclass(frozen=True)
class Hypothesis:
    """The base model with some effects; none for the null hypothesis.

    Args:
        base: the base model's prior.
        effects: what is freed beside it, of one strength in all experiments.
        gels_differ: whether the gel differs between experiments (:func:`scatters`).

    >>> from imr_torch.gap.hypotheses import Hypothesis
    >>> from imr_torch.material import LIBRARY, wide_prior
    >>> base = Hypothesis(wide_prior(["nhkv"]).models[0])
    >>> base.name, base.beside(LIBRARY["clock"]).differing().name
    ('none', 'clock+gel_scatter')
    """

    base: ModelBelief
    effects: tuple[Effect, ...] = ()
    gels_differ: bool = False

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the effects, and ``gel_scatter`` where gels differ."""
        scatter = (GEL_SCATTER,) if self.gels_differ else ()
        return (*(effect.name for effect in self.effects), *scatter)

    @property
    def name(self) -> str:
        """``"none"``, or the parts joined by ``+``."""
        return "+".join(self.parts) or "none"

    def beside(self, effect: Effect) -> "Hypothesis":
        """The same with one effect more."""
        return replace(self, effects=(*self.effects, effect))

    def differing(self) -> "Hypothesis":
        """The same with gels that differ between experiments."""
        return replace(self, gels_differ=True)

    def seen(self, batch: ExperimentBatch) -> ExperimentBatch:
        """The data as this hypothesis has them: experiments with gels of their own where these
        differ.
        """
        return replace(batch, between=scatters(self.base) if self.gels_differ else {})

    @property
    def belief(self) -> ModelBelief:
        """The prior of base and effects together."""
        return add_parameters(
            self.base,
            {
                name: prior
                for effect in self.effects
                for name, prior in effect.priors.items()
            },
        )

    def starts(
        self, null: ModelFit, given: Mapping[str, Sequence[Sequence[float]]]
    ) -> Float[Tensor, "starts controls"]:
        """``S x d`` controls ``v``: those of a fit without the last effect, and that at each of
        some values.

        Args:
            null: the fit; what it holds of the other effects is kept.
            given: effect -> values of its parameters; its own starts where not given.
        """
        belief = self.belief
        known = dict(zip(null.prior.names, null.mean, strict=True))
        if set(belief.names) <= set(known):
            kept = torch.stack([known[name] for name in belief.names])
            return torch.stack((kept, kept + _GEL_APART))
        last = self.effects[-1]
        rows = []
        for start in given.get(last.name, last.starts):
            for (name, prior), value in zip(last.priors.items(), start, strict=True):
                known[name] = prior.to_control(tensor(value))
            rows.append(torch.stack([known[name] for name in belief.names]))
        return torch.stack(rows)


@dataclass(frozen=True)
class Inquiry:
    """What is asked of data: whether a base model is enough, and what it may lack.

    Args:
        base: the base model's prior.
        batch: the data.
        simulator: makes the bubbles.
        effects: the library to choose from.
        alone: the base model's fit of each experiment by itself, from which gels that differ start;
            without them they are not among the causes.
        most: parts that are selected at most.
        progress: called with one line per step.
    """

    base: ModelBelief
    batch: ExperimentBatch
    simulator: Simulator
    effects: tuple[Effect, ...] = ()
    alone: Sequence[ModelFit] = ()
    most: int = 2
    progress: Progress = None

    def longer(self, held: Hypothesis) -> dict[str, Hypothesis]:
        """What a hypothesis can be made by one part more -> that hypothesis.

        An effect that shares no parameter with those held, or gels that differ, where shots can
        show that.
        """
        taken = {name for effect in held.effects for name in effect.names}
        found = {e.name: held.beside(e) for e in self.effects if not taken & set(e.names)}
        if self.alone and not held.gels_differ:
            found[GEL_SCATTER] = held.differing()
        return found

    def test(self, fit: ModelFit, held: Hypothesis, *, seed: int) -> Adequacy:
        """The gap test at the fit of a hypothesis."""
        return adequacy_test(
            fit, self.effects, held.seen(self.batch), self.simulator, seed=seed
        )


def in_words(part: str) -> str:
    """What a report calls a part of a hypothesis: an effect by its name.

    >>> from imr_torch.gap.hypotheses import in_words
    >>> in_words("gel_scatter"), in_words("clock")
    ('differences between shots', 'clock')
    """
    return "differences between shots" if part == GEL_SCATTER else part


def may_differ(batch: ExperimentBatch) -> bool:
    """Whether gels can be asked to differ between experiments: repeats may be of different gels
    themselves.
    """
    return len(batch.experiments) > 1 and all(e.repeats == 1 for e in batch.experiments)


def scatters(base: ModelBelief) -> dict[str, float]:
    """Parameter of the gel -> its scatter between experiments whose gels differ.

    What is inferred of the medium does not differ, nor does the strength of an effect: an effect
    that may differ freely between curves explains anything.
    """
    return dict.fromkeys(base.of_gel, SCALE)


def laplace_evidence(fit: ModelFit) -> float:
    """``log p(y)`` in the Gaussian approximation, nats.

    Priors are standard normal in the controls, so constants cancel.
    """
    return float(-fit.cost + fit.chol.diagonal().log().sum()) - 0.5 * fit.nuisance_log_det


def overdispersion(fit: ModelFit, batch: ExperimentBatch) -> float:
    """Chi squared per degree of freedom of a fit to the mean curves, at least 1."""
    fitted = len(fit.mean) + fit.nuisances.numel()
    return max(1.0, batch.square(fit.prediction) / max(1, int(batch.mask.sum()) - fitted))


def gels_of(fit: ModelFit, hypothesis: Hypothesis) -> dict[str, list[float]]:
    """Parameter of the gel -> its value in each experiment of a fit with gels that differ, SI.

    Empty where they do not differ.
    """
    deviations = fit.nuisances[:, len(NUISANCES) :]
    if not hypothesis.gels_differ:
        return {}
    common = dict(zip(fit.prior.names, fit.prior.physical(fit.mean), strict=True))
    between = scatters(hypothesis.base).items()
    return {
        name: (common[name] * (scatter * column).exp()).tolist()
        for (name, scatter), column in zip(between, deviations.unbind(1), strict=True)
    }
