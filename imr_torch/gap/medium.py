"""What assumed values of the medium would change in a fit: shifts of its parameters, from local
sensitivities at the fit.

Where the medium differs a little from the assumed one, the prediction changes by ``c`` and a refit
shifts everything fitted, the nuisances included, by the linear least-squares solution for the
residual ``-c`` (Gauss-Newton at the minimum of the posterior). The derivative is taken over a
thousandth of the deviation, in bubbles that take the fit's own solver steps.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.files import Document
from imr_torch.goodness.linear import linearise_fit
from imr_torch.html import render
from imr_torch.material import PARAMETERS
from imr_torch.observe import ExperimentBatch, GelMedium, predict
from imr_torch.observe.medium import label
from imr_torch.simulate import Simulator
from imr_torch.simulate.setting import OF_MEDIUM

DEVIATIONS = {
    "density": 1.03,
    "sound_speed": 1.05,
    "surface_tension": 1.3,
    "temperature": 1.01,
    "far_field_pressure": 1.02,
}
"""Field -> factor by which a gel's value may well differ from the assumed one: 3 K of room temperature, the pressure of 200 m
of altitude, water's surface tension in place of .056 N/m."""

MATTERS = 1.0 / 3.0
"""Shift, in posterior standard deviations, from which on an assumed value is said to matter."""

_STEP = 1e-3
_NO_SCALE = 3.0  # relative change of a parameter that is nearly zero, for which percents say nothing


@dataclass(frozen=True)
class MediumSensitivity:
    """What an assumed value of the medium would change.

    Args:
        name: field of :class:`imr_torch.units.Surroundings`.
        assumed: its value with unit.
        factor: of the deviation.
        relative: parameter -> its relative change under that deviation, to first order; only what
            matters is listed.
        sigmas: parameter -> the same in posterior standard deviations.

    >>> from imr_torch.gap import MediumSensitivity
    >>> MediumSensitivity("density", "1060 kg/m^3", 1.03, {"G": -0.041}, {"G": -0.6}).sentence()
    'density was assumed 1060 kg/m^3; 3 % more would change G by -4.1 % (-0.6 sd).'
    """

    name: str
    assumed: str
    factor: float
    relative: dict[str, float]
    sigmas: dict[str, float]

    def sentence(self) -> str:
        """In words."""
        return render(
            "sensitivity.txt", found=self, label=label(self.name), no_scale=_NO_SCALE
        )

    def to_dict(self) -> Document:
        """JSON-ready values."""
        return vars(self) | {"sentence": self.sentence()}


def medium_sensitivities(
    fit: ModelFit, batch: ExperimentBatch, simulator: Simulator, medium: GelMedium
) -> tuple[MediumSensitivity, ...]:
    """What assumed values of the medium would change in a fit, of those that would move a parameter
    by a third of its sd.

    Args:
        fit: the fit.
        batch: its data.
        simulator: makes the bubbles, in this medium.
        medium: which values were assumed.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.assimilate import SearchOptions, assimilate
    >>> from imr_torch.gap import medium_sensitivities
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, GelMedium, SimulatedLaboratory
    >>> simulator, design = PolytropicSimulator(), torch.tensor([400.0, 0.22], dtype=torch.float64)
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=1)
    >>> batch, options = ExperimentBatch((laboratory.shoot(design, seed=0),)), SearchOptions(raw_samples=16, starts=2)
    >>> fit = assimilate(wide_prior(["nhkv"]), batch, simulator, seed=0, options=options)["nhkv"]
    >>> [found.name for found in medium_sensitivities(fit, batch, simulator, GelMedium())][:2]
    ['density', 'sound_speed']
    """
    names = [
        name
        for name in DEVIATIONS
        if name in medium.assumed and OF_MEDIUM[name] not in fit.prior.material.names
    ]
    if not names:
        return ()
    shifts = _shifts(fit, batch, simulator, names)
    sigmas = shifts / torch.linalg.norm(fit.chol, dim=1)
    moved = torch.cat((fit.mean[None], fit.mean + _STEP * shifts))
    before, *after = fit.prior.physical(fit.prior.unwhitened(moved))
    changes = (torch.stack(after) - before) / (_STEP * before.abs().clamp_min(1e-300))
    found = []
    for name, sigma, relative in zip(names, sigmas.tolist(), changes.tolist(), strict=True):
        own = fit.prior.names
        gel = [own.index(parameter) for parameter in fit.prior.of_gel]
        matters = [i for i in gel if abs(sigma[i]) > MATTERS and math.isfinite(sigma[i])]
        if matters:
            found.append(
                MediumSensitivity(
                    name,
                    medium.value(name),
                    DEVIATIONS[name],
                    {own[i]: relative[i] for i in matters},
                    {own[i]: sigma[i] for i in matters},
                )
            )
    return tuple(found)


def _shifts(
    fit: ModelFit,
    batch: ExperimentBatch,
    simulator: Simulator,
    names: list[str],
) -> Tensor:
    """Shifts ``K x d`` of the gel's controls under the deviations of some fields, to first order."""
    parameters = fit.parameters(fit.mean).repeat(1 + len(names), 1)
    for row, name in zip(parameters[1:], names, strict=True):
        row[PARAMETERS.index([OF_MEDIUM[name]])[0]] += _STEP * math.log(DEVIATIONS[name])
    nuisances = (fit.nuisances * batch.nuisance_sds).expand(len(parameters), -1, -1)
    leader, *moved = predict(simulator, parameters, batch, nuisances, bundled=True)
    line = linearise_fit(fit, batch, simulator)
    changes = line.whiten((torch.stack(moved) - leader).nan_to_num() / _STEP)
    return -(changes @ line.to_shift.mT)[:, : len(fit.mean)]
