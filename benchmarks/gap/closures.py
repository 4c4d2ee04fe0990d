"""Six truths that the library does not hold: stress laws of another hand, and errors of a camera.

Each has one strength. Laws are dimensionless as all of :mod:`imr_torch.material.stress`; they are
registered (:func:`register_closures`) in the process that simulates alone, so that no fit can find
them. A stress of the interface is that of Boussinesq and Scriven (Scriven, Chem. Eng. Sci. 12,
1960). A drag of Darcy of constant permeability ``k`` would be ``-(eta/k) R U``, the library's
``size_drag``, and that of pores that open with the square of the local hoop stretch is within 1.5
standard deviations of it; here the strain gone through opens them for good. Energy leaves once
shapes have grown, with the strain gone through, and what is no sphere looks larger. Viscous stress
relaxes with two times, each of half the viscosity.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from benchmarks.gap.unknown import compare_pressures
from benchmarks.records import Line
from imr_torch.elementary import Scalar, Scalars, exp, sqrt
from imr_torch.float64 import arange, ones, tensor
from imr_torch.material import PARAMETERS, Parameter, StressTerm, register_term
from imr_torch.material.stress import SMOOTH
from imr_torch.observe import Experiment, ExperimentBatch, predict
from imr_torch.observe.nuisance import FLOOR
from imr_torch.simulate import Simulator
from imr_torch.units import Surroundings
from imr_torch.unknown import MissingPressure

STEP = 0.005  # of dense true curves, t*
SAMPLES = 10  # of them a frame, where a film has 80 steps
FRAMES = 80
_OPENED = 2.0  # strain by which pores have opened
_LOOKS_LARGER = 0.03  # apparent radius a unit of the loss
_GROWN = 2.0  # strain by which shapes have grown


def surface_viscosity(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, surface: Scalar
) -> Scalars:
    """``S = -4 kappa U/R^2``; ``surface`` is ``kappa`` over ``p_inf Rmax`` and the time scale."""
    slope = -4.0 * surface / (radius * radius)
    return slope * velocity, -2.0 * slope * velocity * velocity / radius, slope


def opening_darcy(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, strain: Scalar, darcy: Scalar
) -> Scalars:
    """``S = -d R U exp(-e/e_0)`` with the strain ``e' = |U|/R``: pores that it opens."""
    change = velocity * velocity / sqrt(velocity * velocity + SMOOTH * SMOOTH) / radius
    factor = -darcy * radius * exp(-strain / _OPENED)
    rate = factor * velocity * (velocity / radius - change / _OPENED)
    return factor * velocity, rate, factor, change


def growing_loss(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, strain: Scalar, loss: Scalar
) -> Scalars:
    """``S = -z U|U| (1 - exp(-(e/e_0)^4))`` with the strain ``e' = |U|/R``."""
    speed = sqrt(velocity * velocity + SMOOTH * SMOOTH)
    change = velocity * velocity / speed / radius
    cubed = strain * strain * strain / _GROWN**4
    left = exp(-cubed * strain)
    grown = loss * (1.0 - left)
    rate = -loss * velocity * speed * 4.0 * cubed * left * change
    slope = -grown * (velocity * velocity / speed + speed)
    return -grown * velocity * speed, rate, slope, change


def two_times(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    fast: Scalar,
    slow: Scalar,
    mu: Scalar,
    fast_time: Scalar,
    slow_time: Scalar,
) -> Scalars:
    """Two arms ``De Z' + Z = -2 R^2 U/Re`` in place of the dashpot; states are ``Z/R^3``."""
    strain = velocity / radius
    by_fast = -(fast + 2.0 * mu * strain) / fast_time - 3.0 * strain * fast
    by_slow = -(slow + 2.0 * mu * strain) / slow_time - 3.0 * strain * slow
    dashpot = 4.0 * mu / radius
    value = fast + slow + dashpot * velocity
    return value, by_fast + by_slow - dashpot * velocity * strain, dashpot, by_fast, by_slow


_DIMENSIONS = {
    "surface": "none",  # of each shot's own
    "darcy": "drag",
    "loss": "none",
    "fast_time": "time",
    "slow_time": "time",
}
_TERMS = (
    (surface_viscosity, "surface", 0),
    (opening_darcy, "darcy", 1),
    (growing_loss, "loss", 1),
    (two_times, "fast_time", 2),
)


def _fastest(mu: Tensor, fast_time: Tensor, slow_time: Tensor) -> Tensor:
    return 1.0 / fast_time


def register_closures() -> None:
    """Make the laws known to the simulators of this process."""
    for name, dimension in _DIMENSIONS.items():
        PARAMETERS.register(Parameter(name, name, "SI", dimension, 0.0, 1e12, 0.0))  # type: ignore[arg-type]
    for law, switch, states in _TERMS:
        fastest = _fastest if law is two_times else None
        register_term(StressTerm(law, switch, states, beside=("mu",), fastest=fastest))


def parameters_of(effect: str, strength: float, weber: float) -> dict[str, float]:
    """Parameters, SI, of a shot at a strength: of the interface ``kappa`` in uPa s m, of the drag in
    MPa s/m^2, of the loss ``z``, of the slower time in us, a quarter of which is the faster one.
    """
    outer = Surroundings()
    size = float(outer.max_radius(tensor(weber)))
    area = outer.far_field_pressure * size * float(outer.time_scale(size))
    return {
        "surface_viscosity": {"surface": 1e-6 * strength / area},
        "darcy": {"darcy": 1e6 * strength},
        "no_sphere": {"loss": strength},
        "two_times": {"slow_time": 1e-6 * strength, "fast_time": 0.25e-6 * strength},
    }.get(effect, {})


def film_dense(
    effect: str, strength: float, radius: Tensor, weber: float, every: int
) -> Tensor:
    """A dense true curve as a camera films it that takes each so many-th sample.

    A frame is dropped before the last ``strength`` ones; the edge drifts by ``strength`` in um a
    film of 4 t*; a bubble looks larger by 3 % of ``strength`` soon after its first collapse.
    """
    places = torch.arange(0, FRAMES * SAMPLES + 1, every)
    if effect == "dropped_frame":
        places = places + every * (torch.arange(len(places)) >= len(places) - strength)
    seen = radius[places]
    if effect == "drifting_edge":
        drift = 1e-6 * strength / float(Surroundings().max_radius(tensor(weber)))
        return seen + drift * places / places[-1]
    if effect == "no_sphere":
        first = int(radius[: round(1.5 / STEP)].argmin())
        since = STEP * (places - first).clamp_min(0).double()
        return seen * (1.0 - _LOOKS_LARGER * strength * torch.expm1(-since / 0.1))
    return seen


def film_shots(
    effect: str,
    strength: float,
    gels: Sequence[Mapping[str, float]],
    designs: Sequence[tuple[float, float]],
    shifts: Tensor,
    every: int,
    simulator: Simulator,
) -> Tensor:
    """Frames without noise of shots of gels, ``shots x frames``; shifts are ``shots x 3``."""
    register_closures()
    times = STEP * arange(0.0, float(FRAMES * SAMPLES + 2 * SAMPLES))
    rows = []
    for gel, design, shift in zip(gels, designs, shifts, strict=True):
        values = {**gel, **parameters_of(effect, strength, design[0])}
        shot = Experiment("", design, times, ones(1, len(times)), FLOOR)
        own = PARAMETERS.pack(values)[None]
        radius = predict(simulator, own, ExperimentBatch((shot,)), shift[None, None])[0, 0]
        rows.append(film_dense(effect, strength, radius, design[0], every))
    return torch.stack(rows)


def compare_shots(
    effect: str,
    strength: float,
    gels: Sequence[Mapping[str, float]],
    designs: Sequence[tuple[float, float]],
    fitted: Mapping[str, float],
    shots: Sequence[MissingPressure],
) -> Line:
    """The true missing pressure beside the inferred one."""
    register_closures()
    pairs = zip(gels, designs, strict=True)
    truths = [
        {**gel, **parameters_of(effect, strength, design[0])} for gel, design in pairs
    ]
    return compare_pressures(designs, truths, fitted, shots, Surroundings())
