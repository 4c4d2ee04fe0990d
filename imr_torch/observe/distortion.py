"""Measurement errors that all experiments share (clock, exposure, refraction), as entries of the parameter vector.

A maximum that was missed, a clock that runs wrong, an exposure that blurs are not nuisances of one experiment but
departures that a diagnosis must be able to name; so they stand beside the properties of the gel, each with a neutral
value of zero at which it does nothing, exactly.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from imr_torch.material import PARAMETERS, Effect, Parameter, TruncatedNormal, register_effect


def _error(name: str, meaning: str, lower: float, upper: float) -> Parameter:
    return PARAMETERS.register(Parameter(name, meaning, "1", "none", lower, upper, 0.0))


MISSED_MAXIMUM = _error("missed_maximum", "true Rmax over the measured one, less 1", -0.2, 0.2)
TRIGGER_OFFSET = _error("trigger_offset", "time of the first frame, in Rmax/U_c", -0.3, 0.3)
RINF_BIAS = _error("rinf_bias", "true R_inf over the measured one, less 1", -0.5, 0.5)
CLOCK = _error("clock", "log of true over measured time at a fixed time scale", -0.3, 0.3)
EXPOSURE_BLUR = _error("exposure_blur", "exposure, in Rmax/U_c", 0.0, 0.5)
REFRACTION = _error("refraction", "relative error of R that grows with R*", -0.2, 0.2)

register_effect(
    Effect(
        "missed_maximum",
        "the true maximum was missed",
        "measurement",
        {"missed_maximum": TruncatedNormal(0.0, 0.015)},
    )
)
register_effect(
    Effect(
        "trigger_offset",
        "the clock starts early or late",
        "measurement",
        {"trigger_offset": TruncatedNormal(0.0, 0.025)},
        group="start",
    )
)
register_effect(
    Effect(
        "rinf_bias",
        "the rest radius is misread",
        "geometry",
        {"rinf_bias": TruncatedNormal(0.0, 0.05)},
    )
)
register_effect(
    Effect(
        "clock",
        "frame rate or pixel size is off",
        "measurement",
        {"clock": TruncatedNormal(0.0, 0.025)},
    )
)
register_effect(
    Effect(
        "exposure_blur",
        "frames average over their exposure",
        "measurement",
        {"exposure_blur": TruncatedNormal(0.0, 0.05, lower=0.0)},
    )
)
register_effect(
    Effect(
        "refraction",
        "the gel refracts: R is magnified as it grows",
        "measurement",
        {"refraction": TruncatedNormal(0.0, 0.01)},
    )
)

_GEOMETRY = ("missed_maximum", "trigger_offset", "rinf_bias")  # in the order of the nuisances of one experiment
_NODES, _WEIGHTS = (torch.as_tensor(x) for x in np.polynomial.legendre.leggauss(8))


@dataclass(frozen=True)
class Distortion:
    """The errors of a batch; tensors of ``batch_shape x 1``, to stand beside experiments.

    Args:
        shifts: ``batch_shape x 1 x 3`` tensor, common to all experiments, as nuisances are to one.
        clock: see ``CLOCK``.
        blur: see ``EXPOSURE_BLUR``.
        refraction: see ``REFRACTION``.
    """

    shifts: Tensor
    clock: Tensor
    blur: Tensor
    refraction: Tensor

    @classmethod
    def of(cls, parameters: Tensor) -> "Distortion | None":
        """The errors in ``batch_shape x p`` parameters; None where every one is neutral."""
        names = (*_GEOMETRY, "clock", "exposure_blur", "refraction")
        columns = parameters[..., PARAMETERS.index(names)]
        if not bool((columns != 0.0).any()):
            return None
        clock, blur, refraction = columns[..., 3:].unbind(-1)
        return cls(columns[..., None, :3], clock[..., None], blur[..., None], refraction[..., None])

    def placed(self, designs: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        """True designs (``... x E x 2``) and times (``... x E x T``) of a clock that is wrong."""
        rate = torch.exp(self.clock)[..., None]
        slower = torch.cat((1.0 / rate, torch.ones_like(rate)), -1)
        return designs * slower, times * rate

    def filmed(self, times: Tensor, simulate: Callable[[Tensor], Tensor]) -> Tensor:
        """Radii as filmed: averaged over the exposure, seen through a lens.

        Args:
            times: ``... x E x T`` tensor, true times of the frames.
            simulate: true radii at times, for any number of them.
        """
        radius = self._averaged(times, simulate) if bool((self.blur != 0.0).any()) else simulate(times)
        return radius * (1.0 + self.refraction[..., None] * radius)

    def _averaged(self, times: Tensor, simulate: Callable[[Tensor], Tensor]) -> Tensor:
        """Mean over an exposure centred on each frame, by Gauss-Legendre; one call for the frames and all nodes."""
        blur = torch.where(self.blur == 0.0, 1e-3, self.blur)[..., None, None]  # neutral members only need distinct times
        nodes = times[..., None] + 0.5 * blur * _NODES.to(times)
        every = torch.cat((times[..., None], nodes), -1).flatten(-2)
        rising, order = every.sort(-1)
        place = order.argsort(-1)
        radius = simulate(rising)
        radius = radius.gather(-1, place.expand(radius.shape)).unflatten(-1, (-1, 1 + len(_NODES)))
        mean = 0.5 * (radius[..., 1:] * _WEIGHTS.to(times)).sum(-1)
        return torch.where(self.blur[..., None] == 0.0, radius[..., 0], mean)
