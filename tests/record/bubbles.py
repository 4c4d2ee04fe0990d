"""Records of bubbles with known wall pressure: Keller-Miksis with a polytropic gas in a neo-Hookean
Kelvin-Voigt medium, integrated forwards and backwards from the maximum by SciPy.
"""

from scipy.integrate import solve_ivp

from imr_torch.simulate import Conditions, PolytropicGas
from imr_torch.units import Surroundings
from tests.simulate.si_reference import Reference

LIQUID = Surroundings()
CONDITIONS = Conditions(LIQUID, PolytropicGas(1.4, "rest"))


def wall_pressure(radius, speed, rest, modulus, viscosity):
    """Less that of the far field, Pa, and its rate."""
    gel = Reference(CONDITIONS, modulus, viscosity)
    pressure, rate = gel.press_wall(radius, speed, rest, rest)
    return pressure - LIQUID.far_field_pressure, rate


def make_rate(top, rest, modulus, viscosity, near=0.0):
    """Rate of ``(radius, speed)``, or of these with the amplitude of shape mode 2 and its rate:
    Plesset, J. Appl. Phys. 25, 1954, in a viscous liquid without vorticity.

    Args:
        top: maximum radius, m.
        rest: R_inf, m.
        modulus: Pa.
        viscosity: Pa s.
        near: a wall or another bubble, which adds ``near d(R^2 U)/dt / top`` to the balance.
    """
    density, sound = LIQUID.density, LIQUID.sound_speed
    kinematic = viscosity / density

    def rate(_, state):
        radius, speed, *shape = state
        pressure, change = wall_pressure(radius, speed, rest, modulus, viscosity)
        mach = speed / sound
        push = (1 + mach) * pressure / density + radius * change / (density * sound)
        push -= 1.5 * speed**2 * (1 - mach / 3) + near * 2 * radius * speed**2 / top
        inertia = (
            (1 - mach) * radius + 4 * viscosity / (density * sound) + near * radius**2 / top
        )
        bend = push / inertia
        if not shape:
            return [speed, bend]
        stiff = 12 * LIQUID.surface_tension / density + 8 * kinematic * speed
        drag = 3 * speed / radius + 40 * kinematic / radius**2
        return [
            speed,
            bend,
            shape[1],
            (bend / radius - stiff / radius**3) * shape[0] - drag * shape[1],
        ]

    return rate


def paths(*bubble, near=0.0, lowest=0.25, last=None):
    """Growth (in negative time) and collapse as dense solutions.

    Args:
        bubble: of :func:`make_rate`.
        near: the same.
        lowest: radius over the maximum at which they end.
        last: t* at which the second ends instead; it has the shape mode then, as large as the
            bubble at the maximum.
    """
    top = bubble[0]
    unit = float(LIQUID.time_scale(top))

    def too_small(_, state):
        return state[0] - lowest * top

    too_small.terminal = True
    shape = [] if last is None else [top, 0]
    return [
        solve_ivp(
            make_rate(*bubble, near),
            (0, end * unit),
            [top, 0, *shape],
            rtol=1e-8,
            atol=1e-12,
            events=too_small if last is None or end < 0 else None,
            dense_output=True,
        )
        for end in (-3, last or 3)
    ]
