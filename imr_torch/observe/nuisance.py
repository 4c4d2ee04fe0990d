"""Measurement errors: those of each experiment (its nuisances), and those that all experiments share
(:class:`Distortion`).

Nuisances are errors of the measured Rmax, time zero and R_inf, and by how much a parameter of the
gel differs from that of the others. Each is a standard normal control per experiment times its
prior standard deviation, and neutral at 0: a fit of the gel marginalises over them, so that an
error of Rmax is not mistaken for a change of modulus.

A maximum that was missed, a clock that runs wrong, an exposure that blurs, alike in all
experiments, are departures that a diagnosis must be able to name; so they are entries of the
parameter vector, beside the properties of the gel, each with a neutral value of zero at which it
does nothing, exactly.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from imr_torch.elementary import Law
from imr_torch.errors import check_fields
from imr_torch.float64 import tensor
from imr_torch.material import LIBRARY, PARAMETERS, dimensionless
from imr_torch.material.effect import give_physics
from imr_torch.simulate import EARLIEST
from imr_torch.types import (
    BatchParameters,
    BroadcastValues,
    DesignVectors,
    Frames,
    FrameTimes,
    ParameterVectors,
)
from imr_torch.units import Surroundings

NUISANCES = ("max_radius", "time_zero", "rest_radius")
"""The nuisances of one experiment, in the order of tensors of them."""

SMALLEST = 0.1
"""Smallest true Rmax that is simulated, over the measured one."""


@dataclass(frozen=True)
class Nuisance:
    """Prior standard deviations of one experiment's nuisances; 0 means known exactly.

    Args:
        max_radius: relative, of Rmax.
        time_zero: of the time of the maximum, dimensionless (over ``Rmax/U_c``).
        rest_radius: relative, of R_inf.

    >>> from imr_torch.observe import Nuisance
    >>> Nuisance(max_radius=0.003, time_zero=0.004).sds().tolist()
    [0.003, 0.004, 0.0]
    """

    max_radius: float = 0.0
    time_zero: float = 0.0
    rest_radius: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self, lambda sd: 0.0 <= sd < 1.0, "a standard deviation in [0, 1)")

    def sds(self) -> Float[Tensor, "3"]:
        """The three standard deviations in the order of ``NUISANCES``."""
        return tensor(list(vars(self).values()))


FLOOR = Nuisance(max_radius=0.003, time_zero=0.004, rest_radius=0.01)
"""What no fit of frames sees of Rmax, time zero and R_inf: pixel size and edge detection."""


def displaced(
    designs: DesignVectors,
    times: FrameTimes,
    shifts: Float[Tensor, "*#batch 3"],
) -> tuple[DesignVectors, FrameTimes, Float[Tensor, "*#batch 1"]]:
    """Design and times that the bubble truly had, given what was measured and the shifts.

    Args:
        designs: measured (We, R_inf*).
        times: measured, dimensionless with the measured Rmax.
        shifts: ``... x 3`` tensor in the order of ``NUISANCES`` (relative, dimensionless,
            relative).

    Returns:
        True designs, true times, and the factor (``... x 1``) from the true R* to the measured one.

    >>> import torch
    >>> from imr_torch.observe import displaced
    >>> design, times = torch.tensor([400.0, 0.22], dtype=torch.float64), torch.tensor([0.0, 1.0], dtype=torch.float64)
    >>> shift = torch.tensor([0.01, 0.0, 0.0], dtype=torch.float64)  # the true Rmax is 1 % larger
    >>> true_design, true_times, factor = displaced(design, times, shift)
    >>> [round(x, 3) for x in true_design.tolist()], round(float(factor), 2)
    ([404.0, 0.218], 1.01)
    """
    scale = 1.0 + shifts[..., 0:1]
    weber = designs[..., 0:1] * scale
    rest = designs[..., 1:2] * (1.0 + shifts[..., 2:3]) / scale
    return (
        torch.cat((weber, rest.clamp(1e-3, 0.999)), dim=-1),
        (times + shifts[..., 1:2]) / scale,
        scale,
    )


def find_impossible(
    times: Frames,
    shifts: Float[Tensor, "*#batch experiments 3"],
    earliest: float,
) -> Bool[Tensor, "*#batch experiments"]:
    """Which experiments shifts ``... x E x 3`` take where there is no bubble to simulate: ``... x
    E`` boolean tensor.

    A search may step there; it is a member that failed, and no error.

    Args:
        times: measured, dimensionless.
        shifts: as in :func:`displaced`.
        earliest: t* to which a first frame may be taken; one that was measured earlier may stay
            there.
    """
    scale = 1.0 + shifts[..., 0]
    first = (times[..., 0] + shifts[..., 1]) / scale
    early = first < times[..., 0].clamp_max(earliest)
    # NaN is not possible either
    return ~((scale >= SMALLEST) & ~early & shifts.isfinite().all(-1))


def with_own(
    parameters: ParameterVectors,
    names: Collection[str],
    deviations: Float[Tensor, "*#batch own"],
) -> ParameterVectors:
    """Parameter vectors, SI, with the values that an experiment has.

    Args:
        parameters: of all experiments.
        names: parameters, all positive, of which the experiment has values of its own.
        deviations: by how much their logarithms differ.
    """
    columns = PARAMETERS.index(tuple(names))
    own = parameters[..., columns] * deviations.exp()
    return parameters.expand(*own.shape[:-1], -1).index_copy(-1, torch.tensor(columns), own)


_NODES, _WEIGHTS = (torch.as_tensor(x) for x in np.polynomial.legendre.leggauss(8))
_COLUMNS = PARAMETERS.index(
    (
        "missed_maximum",
        "trigger_offset",
        "rinf_bias",
        "clock",
        "exposure_blur",
        "edge_error",
    )
)
"""Where the errors that all experiments share stand in a parameter tensor, those of the geometry
first and in the order of ``NUISANCES``; a column never moves, since entries are only appended."""


@dataclass(frozen=True)
class Distortion:
    """The errors of a batch; tensors of ``batch_shape x 1``, to stand beside experiments.

    Args:
        shifts: common to all experiments, as nuisances are to one.
        clock: log of true over measured time.
        blur: exposure, in Rmax/U_c; ``batch_shape x E`` where the exposure of each experiment is
            known.
        edge: measured less true radius, m.
        films: laws of effects that change the radius as filmed, with their parameters.
        parameters: values of these among all, SI; ``batch_shape x 1 x p``.
    """

    shifts: Float[Tensor, "*batch 1 3"]
    clock: Float[Tensor, "*batch 1"]
    blur: Float[Tensor, "*batch #experiments"]
    edge: Float[Tensor, "*batch 1"]
    films: tuple[tuple[Law, tuple[str, ...]], ...]
    parameters: Float[Tensor, "*batch 1 parameters"]

    @classmethod
    def of(
        cls, parameters: BatchParameters, exposures: Float[Tensor, "#experiments"]
    ) -> "Distortion | None":
        """The errors in ``batch_shape x p`` parameters, known ``exposures`` (``E``) added to the
        blur; None if all are 0.
        """
        columns = parameters[..., _COLUMNS]
        films = tuple(
            (effect.film, effect.names)
            for effect in LIBRARY.values()
            if effect.film is not None
            and parameters[..., PARAMETERS.index(effect.names[:1])].any()
        )
        if not columns.any() and not exposures.any() and not films:
            return None
        clock, blur, edge = (x[..., None] for x in columns[..., 3:].unbind(-1))
        return cls(
            columns[..., None, :3],
            clock,
            blur + exposures.to(blur),
            edge,
            films,
            parameters[..., None, :],
        )

    def shifts_of(
        self,
        designs: Float[Tensor, "experiments 2"],
        max_radius: Float[Tensor, "experiments"],
    ) -> tuple[
        Float[Tensor, "*batch #experiments 3"], Float[Tensor, "*batch #experiments 1"]
    ]:
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
        rate = self.clock.exp()[..., None]
        slower = torch.cat((1.0 / rate, torch.ones_like(rate)), -1)
        return designs * slower, times * rate

    def film_radius(
        self,
        times: Frames,
        simulate: Callable[[Tensor], Tensor],
        max_radius: Float[Tensor, "experiments"],
        surroundings: Surroundings,
    ) -> Frames:
        """Radii as filmed: averaged over the exposure, then changed by each effect of the film.

        Args:
            times: true times of the frames.
            simulate: true radii at times, for any number of them.
            max_radius: measured, m.
            surroundings: of the bubbles.
        """
        radius = (
            self._average_exposure(times, simulate) if self.blur.any() else simulate(times)
        )
        if self.films:
            theta = dimensionless(self.parameters, max_radius, surroundings)
            for law, names in self.films:
                radius = law(radius, times, *(theta[name][..., None] for name in names))
        return radius

    def _average_exposure(
        self, times: Tensor, simulate: Callable[[Tensor], Tensor]
    ) -> Tensor:
        """Mean over an exposure centred on each frame, by Gauss-Legendre; one call for the frames
        and all nodes.

        NaN where an exposure reaches back to before the bubble is simulated. One below
        1e-6, in t*, is taken as an instant: no frame can tell it from none, and its nodes
        may be one number.
        """
        instant = self.blur < 1e-6
        early = times[..., 0] - 0.5 * self.blur < EARLIEST
        # instants, and what reaches too far back, only need distinct times
        blur = torch.where(instant | early, 1e-3, self.blur)
        nodes = times[..., None] + 0.5 * blur[..., None, None] * _NODES.to(times)
        every = torch.cat((times[..., None], nodes), -1).flatten(-2)
        rising, order = every.sort(-1)
        place = order.argsort(-1)
        radius = simulate(rising)
        radius = radius.gather(-1, place.expand(radius.shape)).unflatten(
            -1, (-1, 1 + len(_NODES))
        )
        mean = 0.5 * (radius[..., 1:] * _WEIGHTS.to(times)).sum(-1)
        return torch.where(
            early[..., None],
            torch.nan,
            torch.where(instant[..., None], radius[..., 0], mean),
        )


def magnify_by_size(radius: Frames, time: Frames, refraction: BroadcastValues) -> Frames:
    """What a lens or the curved gel does to a radius: an error that grows with R*.

    >>> import torch
    >>> from imr_torch.observe.nuisance import magnify_by_size
    >>> radius = torch.tensor([[1.0, 0.5]], dtype=torch.float64)
    >>> magnify_by_size(radius, radius, torch.tensor(0.02)).tolist()
    [[1.0199999995529652, 0.5049999998882413]]
    """
    return radius * (1.0 + refraction * radius)


give_physics("refraction", film=magnify_by_size)
