"""What would be measured of gels: the radius in each frame, or the time of the first collapse.

Measured designs and times are first taken to the true ones (:mod:`~imr_torch.observe.nuisance`), at
which the bubble is simulated, and the result back.

The collapse is where the wall's velocity changes sign, by a cubic through radius and velocity at
both ends of an interval of the output; in two passes the intervals shrink to 1e-6 of the collapse
time. Of many shots, the time is a smooth function of two numbers, (ln We, R_inf*): it is simulated at
the Chebyshev nodes of their range and interpolated, so that the cost of a gel does not grow with the
number of shots.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial

import numpy as np
import torch
from jaxtyping import Float
from numpy.polynomial.chebyshev import chebpts1
from numpy.polynomial.polynomial import polyvander2d
from torch import Tensor

from imr_torch.float64 import tensor
from imr_torch.observe.experiments import ExperimentBatch, Film
from imr_torch.observe.nuisance import (
    NUISANCES,
    Distortion,
    displaced,
    find_impossible,
    with_own,
)
from imr_torch.simulate import EARLIEST, Simulator
from imr_torch.simulate.growth import AT_MAXIMUM, WithGrowth
from imr_torch.types import BroadcastValues, ExperimentFrames, Frames, ParameterVectors


def predict(
    simulator: Simulator,
    parameters: ParameterVectors,
    film: Film | ExperimentBatch,
    shifts: Float[Tensor, "*#batch experiments nuisances"] | None = None,
    *,
    times: ExperimentFrames | None = None,
    bundled: bool = False,
    kept: "NodeTimes | None" = None,
) -> Frames:
    """What the camera would see of each gel in each experiment.

    Args:
        simulator: makes the bubbles.
        parameters: SI.
        film: the experiments, for their designs and times: an :class:`ExperimentBatch`, or a
            :class:`Film` of planned ones.
        shifts: nuisances in physical size; none when not given.
        times: measured, dimensionless, increasing; those of the frames when not given.
        bundled: whether the last batch dimension holds the members of a bundle
            (:meth:`imr_torch.simulate.Simulator.bundle`), the leader first.
        kept: collapse times of the last call, for the same simulator and experiments. Where given,
            times are right to 3e-5 and not to 2e-6, so that no differences can be taken, and gels
            of the last call are not simulated again; not for bundles.

    Returns:
        ``batch_shape x E x T`` tensor, R/Rmax with the measured Rmax; NaN rows where a solve
        failed, or shifts leave no bubble.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import Experiment, ExperimentBatch, predict
    >>> times = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    >>> batch = ExperimentBatch((Experiment("shot 1", (400.0, 0.22), times, torch.ones(1, 3, dtype=torch.float64)),))
    >>> seen = predict(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), batch)
    >>> [round(x, 3) for x in seen[0].tolist()]
    [1.0, 0.846, 0.418]
    """
    designs = film.designs
    times = film.times if times is None else times
    if (film.times < AT_MAXIMUM).any():
        simulator = WithGrowth(simulator)
    if isinstance(film, Film):
        instant = designs.new_zeros(1)
        return _predict_radii(
            simulator, parameters, designs, times, shifts, bundled, instant
        )
    parts = []
    order = _group_alike(film)
    for rows in order:
        gels = parameters
        own = None if shifts is None else shifts[..., rows, : len(NUISANCES)]
        if film.between and shifts is not None:
            gels = with_own(
                parameters, film.between, shifts[..., rows[0], len(NUISANCES) :]
            )
        common = (simulator, gels, designs[rows])
        if film.collapse[rows[0]]:
            near = film.mean[rows, 0]
            found = predict_collapse(*common, near, own, bundled=bundled, kept=kept)
            parts.append(found[..., None].expand(*found.shape, times.shape[-1]))
        else:
            parts.append(
                _predict_radii(*common, times[rows], own, bundled, film.exposures[rows])
            )
    return torch.cat(parts, -2)[..., torch.cat(order).argsort(), :]


def _group_alike(film: ExperimentBatch) -> list[Tensor]:
    """Rows of experiments that are simulated together: of one kind and with the same parameters."""
    rows = torch.arange(len(film.experiments))
    if film.between:
        return list(rows.split(1))
    return [part for part in (rows[~film.collapse], rows[film.collapse]) if len(part)]


def _predict_radii(
    simulator: Simulator,
    parameters: Tensor,
    designs: Tensor,
    times: Tensor,
    shifts: Tensor | None,
    bundled: bool,
    exposures: Tensor,
) -> Tensor:
    """:func:`predict` for curves, with the known exposure of each."""
    truth = _find_truth(simulator, parameters, designs, times, shifts, exposures)

    def simulate_radius(times: Tensor) -> Tensor:
        return _simulate_bubbles(
            simulator, parameters, truth.designs, times, bundled=bundled
        )[0]

    if truth.distortion is None:
        return simulate_radius(truth.times) * truth.scale
    surroundings = simulator.conditions.surroundings
    max_radius = surroundings.max_radius(designs[:, 0])
    radius = truth.distortion.film_radius(
        truth.times, simulate_radius, max_radius, surroundings
    )
    return radius * truth.scale + truth.beyond


@dataclass(frozen=True)
class _Truth:
    """The bubbles that gave what was measured.

    Args:
        designs: true ones, ``... x E x 2``.
        times: true ones, ``... x E x T``.
        scale: from the true R* to the measured one, ``... x E x 1``; NaN where the errors leave no
            bubble.
        offset: by which measured times are too small, ``... x E x 1``.
        beyond: what the error of the edge adds to the radius.
        distortion: errors that all experiments share; None without.
    """

    designs: Tensor
    times: Tensor
    scale: Tensor
    offset: Tensor
    beyond: Tensor
    distortion: Distortion | None


def _find_truth(
    simulator: Simulator,
    parameters: Tensor,
    designs: Tensor,
    times: Tensor,
    shifts: Tensor | None,
    exposures: Tensor,
    *,
    earliest_filmed: float = -0.4,
    earliest_grown: float = -1.5,
) -> _Truth:
    """True designs and times of what was measured with ``shifts`` and the errors among the
    parameters.

    ``earliest_filmed``: time to which a first frame may be taken where an exposure reaches on from
    it, or the clock is wrong. ``earliest_grown``: the same of a bubble with its growth.
    """
    shifts = designs.new_zeros(*designs.shape[:-1], 3) if shifts is None else shifts
    beyond = shifts[..., :1]
    distortion = Distortion.of(parameters, exposures)
    if distortion is not None:
        errors, beyond = distortion.shifts_of(
            designs, simulator.conditions.surroundings.max_radius(designs[:, 0])
        )
        shifts = shifts + errors
    earliest = EARLIEST if distortion is None else earliest_filmed
    if isinstance(simulator, WithGrowth):
        earliest = earliest_grown
    lost = find_impossible(times, shifts, earliest)
    shifts = torch.where(lost[..., None], 0.0, shifts)
    designs, times, scale = displaced(designs, times, shifts)
    if distortion is not None:
        designs, times = distortion.correct_clock(designs, times)
    scale = torch.where(lost[..., None], torch.nan, scale)
    return _Truth(designs, times, scale, shifts[..., 1:2], beyond, distortion)


def _simulate_bubbles(
    simulator: Simulator,
    parameters: Tensor,
    designs: Tensor,
    times: Tensor,
    *,
    bundled: bool = False,
) -> tuple[Tensor, Tensor]:
    """Radius and velocity of each gel in each experiment, dimensionless.

    Args:
        simulator: makes the bubbles.
        parameters: SI.
        designs: true ones.
        times: true ones.
        bundled: as for :func:`imr_torch.observe.predict`.
    """
    if not bundled:
        solution = simulator(parameters[..., None, :], designs, times)
        return solution.radius, solution.velocity
    # experiments are bundles of their own, so members move to the last batch dimension
    inputs = (
        x if x.ndim > 2 else x[None] for x in (parameters[..., None, :], designs, times)
    )
    solution = simulator.bundle(*(x.transpose(-3, -2) for x in inputs))
    return solution.radius.transpose(-3, -2), solution.velocity.transpose(-3, -2)


def first_minimum(
    times: Float[Tensor, "*#batch frames"],
    radius: Float[Tensor, "*#batch frames"],
    velocity: Float[Tensor, "*#batch frames"],
) -> BroadcastValues:
    """Time of the first minimum of curves, where the velocity changes sign; NaN for a curve without
    one.

    Args:
        times: increasing.
        radius: ``... x n`` tensor.
        velocity: ``... x n`` tensor.

    >>> import torch
    >>> from imr_torch.observe.prediction import first_minimum
    >>> times = torch.linspace(0.0, 9.0, 46, dtype=torch.float64)
    >>> round(float(first_minimum(times, 1.1 + torch.cos(times), -torch.sin(times))), 3)
    3.142
    """
    turns = (velocity[..., :-1] < 0.0) & (velocity[..., 1:] >= 0.0)
    before = (turns.cumsum(-1) == 0).sum(-1, keepdim=True)  # intervals before the first
    left = before.clamp_max(turns.shape[-1] - 1)
    shape = turns.shape[:-1]

    def ends(values: Tensor) -> tuple[Tensor, Tensor]:
        whole = values.expand(*shape, values.shape[-1])
        return whole.gather(-1, left)[..., 0], whole.gather(-1, left + 1)[..., 0]

    (t0, t1), (r0, r1), (u0, u1) = ends(times), ends(radius), ends(velocity)
    h = t1 - t0
    rise = r1 - r0
    u0 = u0 * h
    u1 = u1 * h
    a = 3.0 * (u0 + u1 - 2.0 * rise)
    b = 2.0 * (3.0 * rise - 2.0 * u0 - u1)
    share = -2.0 * u0 / (b + (b * b - 4.0 * a * u0).clamp_min(0.0).sqrt())
    return torch.where(turns.any(-1), t0 + h * share.clamp(0.0, 1.0), torch.nan)


def predict_collapse(
    simulator: Simulator,
    parameters: ParameterVectors,
    designs: Float[Tensor, "experiments 2"],
    measured: Float[Tensor, "experiments"],
    shifts: Float[Tensor, "*#batch experiments 3"] | None = None,
    *,
    bundled: bool = False,
    kept: "NodeTimes | None" = None,
    nodes: tuple[int, int] = (4, 3),
) -> Float[Tensor, "*#batch experiments"]:
    """Collapse times that would be measured of each gel in each shot: ``batch_shape x E``,
    dimensionless; NaN without one.

    Args:
        simulator: makes the bubbles.
        parameters: SI.
        designs: measured.
        measured: measured times; a collapse is looked for up to two and a half times as late.
        shifts: nuisances in physical size.
        bundled: as for :func:`imr_torch.observe.predict`.
        kept: the same.
        nodes: along ln We and R_inf*, at which the times of more shots than nodes are simulated; of
            a gel that collapses freely, times are right to 2e-5 in the median over the range of 52
            shots of one gel, and to 2e-3 over all of We 100 to 1000 and R_inf* .1 to .3.
    """
    instant = measured.new_zeros(1)
    truth = _find_truth(simulator, parameters, designs, measured[:, None], shifts, instant)
    simulate = partial(
        _simulate_collapses, simulator, bundled=bundled, precise=kept is None
    )
    if truth.designs.shape[-2] > math.prod(nodes):
        found = _interpolate_collapses(
            simulate, parameters, truth.designs, designs, measured, bundled, kept, nodes
        )
    else:
        found = simulate(parameters, truth.designs, measured)
    if truth.distortion is not None:
        found = found / truth.distortion.clock.exp()
    return found * truth.scale[..., 0] - truth.offset[..., 0]


@dataclass(eq=False)
class NodeTimes:
    """Collapse times at nodes, of the gels that were asked for last.

    Args:
        asked: gels, nodes and times about which collapses were looked for.
        times: of each gel at each node.
    """

    asked: tuple[Tensor, ...] = ()
    times: Tensor = field(default_factory=partial(torch.zeros, 0))

    def find_times(self, simulate: Callable[..., Tensor], *asked: Tensor) -> Tensor:
        """The times, simulated if they are not known."""
        if not self.asked or not all(map(torch.equal, asked, self.asked)):
            self.times = simulate(*asked)
            self.asked = asked
        return self.times


@cache
def _collapse_times_looked_at() -> tuple[Tensor, Tensor, Tensor]:
    """Output times, over the measured collapse time: up to 1.15, up to 2.5, and about the collapse.

    By the first two the minimum is found to 3e-5; the last are 3e-7 apart at their middle, where the
    time is as smooth in the gel as the solver's output.
    """
    usual = np.append(
        np.linspace(0.0, 0.7, 40, endpoint=False), np.linspace(0.7, 1.15, 901)[:-1]
    )
    later = np.linspace(1.15, 1.3, 300, endpoint=False)
    late = np.concatenate((usual, later, np.linspace(1.3, 2.5, 601)[:-1]))
    close = 1e-3 * np.sinh(np.linspace(-6.0, 6.0, 201)) / math.sinh(6.0)
    usual, late, close = (torch.from_numpy(x) for x in (usual, late, close))
    return usual, late, close


def _simulate_collapses(
    simulator: Simulator,
    parameters: Tensor,
    designs: Tensor,
    about: Tensor,
    *,
    bundled: bool,
    precise: bool,
) -> Tensor:
    """Collapse times ``... x E`` of true designs, looked for about ``E`` times."""

    def find_minima(times: Tensor, gels: Tensor, designs: Tensor) -> Tensor:
        bubbles = _simulate_bubbles(simulator, gels, designs, times, bundled=bundled)
        return first_minimum(times, *bubbles)

    usual, late, close = (about[:, None] * x.to(about) for x in _collapse_times_looked_at())
    found = find_minima(usual, parameters, designs)
    missing = found.isnan().any(-1)
    found = _replace_times(
        found, missing, partial(find_minima, late), parameters, designs, bundled
    )
    if not (precise or bundled):
        return found
    lost = found.isnan()
    near = torch.where(lost, about, found)[..., None] + close
    return torch.where(lost, torch.nan, find_minima(near, parameters, designs))


def _replace_times(
    found: Tensor,
    chosen: Tensor,
    find_times: Callable[[Tensor, Tensor], Tensor],
    parameters: Tensor,
    designs: Tensor,
    bundled: bool,
) -> Tensor:
    """Times ``... x E``, those of the chosen gels (``...``), or of bundles with one of these, found
    anew.
    """
    if bundled:
        chosen = chosen.any(-1)
    if not chosen.any():
        return found
    gels = parameters.expand(*found.shape[:-1], -1)[chosen]
    anew = find_times(gels, designs.expand(*found.shape, 2)[chosen])
    return found.index_put((chosen,), anew)


def _interpolate_collapses(
    simulate: Callable[..., Tensor],
    parameters: Tensor,
    designs: Tensor,
    measured: Tensor,
    about: Tensor,
    bundled: bool,
    kept: NodeTimes | None,
    nodes: tuple[int, int],
    *,
    steps: tuple[float, float] = (0.05, 0.01),
) -> Tensor:
    """The same, interpolated between designs; simulated of gels that collapse at some nodes alone.

    The range of (ln We, R_inf*) is rounded to ``steps``, so that nodes stay, and where times are
    kept a step wider than that of the measured designs.
    """
    places, middles = (
        torch.stack((x[..., 0].log(), x[..., 1]), -1) for x in (designs, measured)
    )
    step = tensor(steps)
    ends = places.reshape(-1, 2)
    if kept is not None:
        ends = torch.cat((ends, middles - step, middles + step))
    low = torch.floor(ends.amin(0) / step) * step
    half = 0.5 * (torch.ceil(ends.amax(0) / step) * step - low)
    unit = torch.cartesian_prod(*(torch.from_numpy(chebpts1(n)) for n in nodes))
    at = low + half * (1.0 + unit)
    at[:, 0] = at[:, 0].exp()
    gels, rows = _distinct_gels(parameters, bundled)
    middle = about.mean().expand(len(at))
    times = (kept or NodeTimes()).find_times(simulate, gels, at, middle)[..., rows, :]
    lost = times.isnan()

    def find_powers(places: Tensor) -> Tensor:
        x, y = (column.numpy() for column in places.unbind(-1))
        return torch.from_numpy(polyvander2d(x, y, [n - 1 for n in nodes]))

    weights = find_powers((places - low) / half - 1.0) @ torch.linalg.inv(find_powers(unit))
    found = (weights * times[..., None, :]).sum(-1)

    some = lost.any(-1) & ~lost.all(-1)
    find_times = partial(simulate, about=about)
    return _replace_times(found, some, find_times, parameters, designs, bundled)


def _distinct_gels(parameters: Tensor, bundled: bool) -> tuple[Tensor, Tensor]:
    """Gels to be simulated, and which of them each member has: members of a bundle of which only
    the design is moved share the bubbles of the leader, draws of one gel each other's.
    """
    if not bundled:
        gels, rows = torch.unique(
            parameters.reshape(-1, parameters.shape[-1]), dim=0, return_inverse=True
        )
        return gels, rows.reshape(parameters.shape[:-1])
    moved = (parameters != parameters[..., :1, :]).any(-1)
    moved = moved.reshape(-1, moved.shape[-1]).any(0)
    moved[0] = True
    return parameters[..., moved, :], torch.where(moved, moved.cumsum(0) - 1, 0)
