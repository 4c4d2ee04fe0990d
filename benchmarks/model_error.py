"""Information gain about the gel where the model may lack something: tried, and not in the package,
since designs and errors stayed the same (RESULTS.md).

A shot may be most informative where an effect that the model lacks is largest, and then moves the
fit most. Here, what is lacking is marginalised: of each gel drawn, every effect of the library is
simulated once with values drawn from its priors, and the change of the curves, of the same unknown
strength ``w ~ N(0, 1)`` in all shots, is a further uncertain direction of the linearised posterior.
With its columns ``B`` beside the sensitivities ``J``, whitened by noise and prior, the gain about
the gel is that of the Schur complement

    1/2 log det(P + J^T J - J^T B (1 + B^T B)^-1 B^T J) - 1/2 log det P,

averaged over three cases: nothing is lacking, one effect acts (families of effects are equally
probable), or something unknown, for which all of them act at once, as in the error budget of
:mod:`imr_torch.gap.model_error`. Each case is taken as known to the analyst: what it costs to find
out which of them is true is left out, so the gain is an upper bound of that of the mixture.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.design.laplace import Laplace, local_precision
from imr_torch.design.likelihood import Data, Linear, infer_linear
from imr_torch.design.response import Response, Shot, radii
from imr_torch.float64 import randn, tensor, zeros
from imr_torch.material import Effect, ModelBelief, library
from imr_torch.material.model_belief import add_parameters
from imr_torch.types import DrawnValues


@dataclass(frozen=True)
class RobustLaplace(Laplace):
    """:class:`Laplace` with the gain about the parameters under model error; that about the
    constitutive model is unchanged.

    Args:
        effects: names of effects that may be lacking; all that are offered if None.
        known: probability that one of them acts.
        unknown: probability of something unknown.

    >>> from benchmarks.model_error import RobustLaplace
    >>> from imr_torch.design import Plan, expected_information_gain
    >>> from imr_torch.material import reference_case
    >>> from imr_torch.simulate import PolytropicSimulator
    >>> prior, design = reference_case("soft-pa").prior, torch.tensor([[400.0, 0.2]], dtype=torch.float64)
    >>> usual, robust = (
    ...     expected_information_gain(prior, design, PolytropicSimulator(), Plan(), estimator=estimator, seed=0)
    ...     for estimator in (Laplace(4), RobustLaplace(4, effects=("wall", "sound_speed")))
    ... )
    >>> robust.parameters < usual.parameters
    True
    """

    effects: tuple[str, ...] | None = None
    known: float = 0.25
    unknown: float = 0.25

    def inform_gels(
        self,
        shot: Shot,
        part: ModelBelief,
        gels: Response,
        linear: Linear,
        source: torch.Generator,
    ) -> DrawnValues:
        """See :meth:`Laplace.inform_gels`."""
        alone = super().inform_gels(shot, part, gels, linear, source)
        effects = library(self.effects, base=part.model)
        if not effects or not len(gels):
            return alone
        lacking = _change_gels(shot, part, gels, effects, source)
        d = gels.controls.shape[1]
        controls = torch.cat((gels.controls, zeros(len(gels), len(effects))), 1)
        slopes = torch.cat((gels.by_gel, lacking), -1)
        beside = Response(controls, gels.radius, slopes, gels.by_nuisance)
        data = Data(gels.radius, shot.plan.frames_in_window(gels.radius))
        precision = infer_linear(data, beside, shot.plan).fisher
        prior = local_precision(part, gels.controls)
        precision[:, :d, :d] += prior
        precision[:, d:, d:] += torch.eye(len(effects)).to(prior)
        gel, shared, own = precision[:, :d, :d], precision[:, :d, d:], precision[:, d:, d:]
        explained = (shared * torch.linalg.solve(gel, shared)).sum(1)
        families = [effect.family for effect in effects]
        shares = tensor([1.0 / families.count(one) / len(set(families)) for one in families])
        with_one = torch.log1p(-explained / own.diagonal(dim1=1, dim2=2)) @ shares
        with_all = torch.logdet(precision) - torch.logdet(own) - torch.logdet(gel)
        return alone + 0.5 * (self.known * with_one + self.unknown * with_all)


def _change_gels(
    shot: Shot,
    part: ModelBelief,
    gels: Response,
    effects: Sequence[Effect],
    source: torch.Generator,
) -> Tensor:
    """What each effect changes of the curves, draws x designs x frames x effects; nothing where it
    cannot be simulated.
    """
    changes = []
    for effect in effects:
        more = add_parameters(part, effect.priors)
        controls = randn(len(gels), len(more.names), generator=source)
        controls[:, [more.names.index(name) for name in part.names]] = gels.controls
        changes.append(radii(shot, more, controls) - gels.radius)
    return torch.stack(changes, -1).nan_to_num(0.0)
