"""Measurement errors that all experiments share (clock, exposure, refraction, edge), as entries of
the parameter vector.

A maximum that was missed, a clock that runs wrong, an exposure that blurs are not nuisances of one
experiment but departures that a diagnosis must be able to name; so they stand beside the properties
of the gel, each with a neutral value of zero at which it does nothing, exactly.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.material import PARAMETERS
from imr_torch.simulate import EARLIEST
from imr_torch.types import BatchParameters, Frames

_NODES, _WEIGHTS = (torch.as_tensor(x) for x in np.polynomial.legendre.leggauss(8))


@cache
def _find_columns() -> list[int]:
    """Where the errors stand in a parameter tensor, those of the geometry first and in the order of
    the nuisances of one experiment.

    A column never moves, since entries are only appended.
    """
    return PARAMETERS.index(
        (
            "missed_maximum",
            "trigger_offset",
            "rinf_bias",
            "clock",
            "exposure_blur",
            "refraction",
            "edge_error",
        )
    )


@dataclass(frozen=True)
class Distortion:
    """The errors of a batch; tensors of ``batch_shape x 1``, to stand beside experiments.

    Args:
        shifts: common to all experiments, as nuisances are to one.
        clock: log of true over measured time.
        blur: exposure, in Rmax/U_c; ``batch_shape x E`` where the exposure of each experiment is
            known.
        refraction: relative error of R that grows with R*.
        edge: measured less true radius, m.
    """

    shifts: Float[Tensor, "*batch 1 3"]
    clock: Float[Tensor, "*batch 1"]
    blur: Float[Tensor, "*batch #experiments"]
    refraction: Float[Tensor, "*batch 1"]
    edge: Float[Tensor, "*batch 1"]

    @classmethod
    def of(
        cls,
        parameters: BatchParameters,
        exposures: Float[Tensor, "experiments"] | None = None,
    ) -> "Distortion | None":
        """The errors in ``batch_shape x p`` parameters, known ``exposures`` (``E``) added to the
        blur; None if all are 0.
        """
        columns = parameters[..., _find_columns()]
        known = exposures is not None and bool((exposures != 0.0).any())
        if not known and not bool((columns != 0.0).any()):
            return None
        clock, blur, refraction, edge = (x[..., None] for x in columns[..., 3:].unbind(-1))
        if exposures is not None and known:
            blur = blur + exposures.to(blur)
        return cls(columns[..., None, :3], clock, blur, refraction, edge)

    def shifts_of(
        self, designs: Float[Tensor, "experiments 2"], max_radius: Float[Tensor, "experiments"]
    ) -> tuple[Float[Tensor, "*batch #experiments 3"], Float[Tensor, "*batch #experiments 1"]]:
        """Errors of the measured designs and times, and what the edge's error adds to the radius as
        filmed.

        Rmax and R_inf are read off the same film, so each holds the same error ``d`` as every
        frame: the true ones are smaller by ``d``, and ``R* = (R + d)/(Rmax + d)`` is 1 at the
        maximum whatever the error. A threshold set too high or too low moves the edge so (0.5 to 2
        pixels are 0.003 to 0.02 in R*). An R_inf that is known otherwise does not hold ``d``, but
        loses it here.

        Args:
            designs: measured (We, R_inf*).
            max_radius: measured, m.

        Returns:
            ``... x E x 3`` tensor in the order of the nuisances, and ``... x E x 1``, in R*.
        """
        edge = self.edge / max_radius
        moved = torch.stack((-edge, torch.zeros_like(edge), -edge / designs[:, 1]), -1)
        return self.shifts + moved, edge[..., None]

    def correct_clock(
        self,
        designs: Float[Tensor, "*#batch experiments 2"],
        times: Frames,
    ) -> tuple[Float[Tensor, "*#batch experiments 2"], Frames]:
        """True designs (``... x E x 2``) and times (``... x E x T``) of a clock that is wrong."""
        rate = torch.exp(self.clock)[..., None]
        slower = torch.cat((1.0 / rate, torch.ones_like(rate)), -1)
        return designs * slower, times * rate

    def film_radius(
        self,
        times: Frames,
        simulate: Callable[[Tensor], Tensor],
    ) -> Frames:
        """Radii as filmed: averaged over the exposure, seen through a lens.

        Args:
            times: true times of the frames.
            simulate: true radii at times, for any number of them.
        """
        radius = (
            self._average_exposure(times, simulate)
            if bool((self.blur != 0.0).any())
            else simulate(times)
        )
        return radius * (1.0 + self.refraction[..., None] * radius)

    def _average_exposure(
        self, times: Tensor, simulate: Callable[[Tensor], Tensor], *, shortest: float = 1e-6
    ) -> Tensor:
        """Mean over an exposure centred on each frame, by Gauss-Legendre; one call for the frames
        and all nodes.

        NaN where an exposure reaches back to before the bubble is simulated. One below
        ``shortest``, in t*, is taken as an instant: no frame can tell it from none, and its nodes
        may be one number.
        """
        instant = self.blur < shortest
        early = times[..., 0] - 0.5 * self.blur < EARLIEST
        blur = torch.where(instant | early, 1e-3, self.blur)[
            ..., None, None
        ]  # these members only need distinct times
        nodes = times[..., None] + 0.5 * blur * _NODES.to(times)
        every = torch.cat((times[..., None], nodes), -1).flatten(-2)
        rising, order = every.sort(-1)
        place = order.argsort(-1)
        radius = simulate(rising)
        radius = radius.gather(-1, place.expand(radius.shape)).unflatten(-1, (-1, 1 + len(_NODES)))
        mean = 0.5 * (radius[..., 1:] * _WEIGHTS.to(times)).sum(-1)
        return torch.where(
            early[..., None], torch.nan, torch.where(instant[..., None], radius[..., 0], mean)
        )
