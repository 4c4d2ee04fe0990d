"""Stress laws with memory: Maxwell and Zener branches, the standard solids of the published code,
Oldroyd-B, and the fluids of Giesekus and of Phan-Thien and Tanner.

Each replaces the instantaneous stress of the terms beside it by one that relaxes: for a member with
a relaxation time, the law takes off what those terms add at once and adds its memory state instead.
At a relaxation time of zero it does nothing, so a batch may mix gels with and without memory.

Sources: Warnez & Johnsen (Phys. Fluids 27, 2015) for Maxwell, Zener and the upper-convected branch
round a bubble; Estrada et al. (J. Mech. Phys. Solids 112, 2018), section 2.2, for the standard
linear and nonlinear solids. Arms of a generalised Maxwell model and the springpot (Bonfanti, Kaplan,
Charras & Kabla, Soft Matter 16, 2020) replace nothing: they stand beside all other terms.
"""

from math import e, pi
from math import log as log_of

from imr_torch.elementary import Scalar, Scalars, exp, expm1, log, sin, where
from imr_torch.material.elastic import linear_elastic
from imr_torch.material.stress import StressTerm, shell_rule
from imr_torch.material.viscous import newtonian


def _relaxation_rate(time: Scalar) -> Scalar:
    """``1/De``; 0 for members that do not relax."""
    return where(time > 0.0, 1.0 / where(time > 0.0, time, 1.0), 0.0)


def _fastest_rate(strength: Scalar, time: Scalar, *others: Scalar) -> Scalar:
    return _relaxation_rate(time)


_SHELLS = shell_rule(10)
"""Bubbles are within 1e-4 in ``R*`` of those with 40 shells."""


def maxwell(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    memory: Scalar,
    mu: Scalar,
    tau: Scalar,
    retardation: Scalar,
) -> Scalars:
    """Viscous stress that relaxes: ``De Z' + Z = -4 (1 - s) R^2 U/Re``, ``S = Z/R^3 - 4 s U/(Re
    R)``.

    The linear Maxwell fluid (with ``s > 0``: Jeffreys) round a bubble, exact for it because its
    stress falls as ``r^-3`` at all times; beside an elastic term it is the Zener model (Warnez &
    Johnsen 2015). The state is ``Z/R^3``. ``s`` is the retardation time over the relaxation time.
    """
    on = tau > 0.0
    relaxation = _relaxation_rate(tau)
    strain = velocity / radius
    instant = where(on, 4.0 * (1.0 - retardation) * mu, 0.0)
    change = where(
        on, -relaxation * (memory + instant * strain) - 3.0 * strain * memory, 0.0
    )
    value = where(on, memory, 0.0) + instant * strain
    return value, change - instant * strain * strain, instant / radius, change


def _relaxing_solid(
    radius: Scalar,
    velocity: Scalar,
    memory: Scalar,
    mu: Scalar,
    time: Scalar,
    elastic: Scalar,
    slope: Scalar,
    stiffness: Scalar,
) -> Scalars:
    """A solid whose whole stress relaxes to its elastic one: ``S' = (S_e - S)/De - 4 U/(Re De R) -
    f(l) U/R``.

    ``S_e`` is the elastic stress beside the dashpot's branch, ``slope`` its derivative in ``ln l``,
    ``f`` its stiffness against fast strain. The state is ``S``; it starts relaxed, at ``S_e``, because
    a bubble is slow near its maximum.
    """
    on = time > 0.0
    viscous = 4.0 * mu
    strain = velocity / radius
    change = where(
        on,
        _relaxation_rate(time) * (elastic - memory - viscous * strain) - stiffness * strain,
        0.0,
    )
    value = where(on, memory - elastic + viscous * strain, 0.0)
    rate = where(on, change - slope * strain - viscous * strain * strain, 0.0)
    return value, rate, where(on, viscous / radius, 0.0), change


def _linear_solid(inverse: Scalar, G_lin: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """``S_e``, ``dS_e/d ln l`` and ``f`` at ``1/l``."""
    stiffness = 4.0 * G_lin
    cubed = inverse * inverse * inverse
    return -stiffness / 3.0 * (1.0 - cubed), -stiffness * cubed, stiffness


def _nonlinear_solid(inverse: Scalar, G: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """``S_e``, ``dS_e/d ln l`` and ``f`` at ``1/l``.

    ``f`` without its removable pole at ``l = 1``.
    """
    x = inverse
    x2 = x * x
    cubed = x2 * x
    # (3/14 l^3 + l^2 - 3/(2 l) + 2/(7 l^4))/(l^3 - 1)
    polynomial = (
        3.0
        + 17.0 * x
        + 17.0 * x2
        + 17.0 * cubed
        - 4.0 * x2 * x2
        - 4.0 * x2 * cubed
        - 4.0 * cubed * cubed
    ) / 14.0
    stiffness = 4.0 * G * polynomial / (1.0 + x + x2)
    return -0.5 * G * (5.0 - x * (4.0 + cubed)), -2.0 * G * x * (1.0 + cubed), stiffness


def standard_linear(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    memory: Scalar,
    mu: Scalar,
    tau_sls: Scalar,
    G_lin: Scalar,
) -> Scalars:
    """A linear spring beside a linear Maxwell branch (Estrada et al. 2018, eq. 12)."""
    spring = _linear_solid(rest_radius / radius, G_lin)
    return _relaxing_solid(radius, velocity, memory, mu, tau_sls, *spring)


def _standard_linear_start(
    rest_radius: Scalar, mu: Scalar, tau_sls: Scalar, G_lin: Scalar
) -> Scalars:
    return (where(tau_sls > 0.0, _linear_solid(rest_radius, G_lin)[0], 0.0),)


def standard_nonlinear(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    memory: Scalar,
    mu: Scalar,
    tau_sns: Scalar,
    G: Scalar,
) -> Scalars:
    """A neo-Hookean spring beside a linear Maxwell branch (Estrada et al. 2018, eq. 13; "nhzen" in the
    published code).
    """
    spring = _nonlinear_solid(rest_radius / radius, G)
    return _relaxing_solid(radius, velocity, memory, mu, tau_sns, *spring)


def _standard_nonlinear_start(
    rest_radius: Scalar, mu: Scalar, tau_sns: Scalar, G: Scalar
) -> Scalars:
    return (where(tau_sns > 0.0, _nonlinear_solid(rest_radius, G)[0], 0.0),)


def oldroyd_b(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    radial: Scalar,
    hoop: Scalar,
    mu: Scalar,
    tau_ucm: Scalar,
    retardation: Scalar,
) -> Scalars:
    """Upper-convected Maxwell branch with a solvent, its stress integral in closed form with two
    states.

    ``Z_1' = -(1/De - 2U/R) Z_1 - 2 (1 - s) R^2 U/(Re De)``, ``Z_2' = -(1/De + U/R) Z_2 - 2 (1 - s)
    R^2 U/(Re De)``, ``S = (Z_1 + Z_2)/R^3 - 4 s U/(Re R)`` (Warnez & Johnsen 2015, section II.C).
    The states are ``Z/R^3``. Each shell of the gel keeps ``r^3 - R^3``, so its stress is an
    integral over its past; integrated over the shells first, the past enters by ``(R/R')^2 + R'/R``
    alone, one state for each. Neither is the radial or the hoop stress; their sum is exact.
    """
    on = tau_ucm > 0.0
    relaxation = _relaxation_rate(tau_ucm)
    strain = velocity / radius
    instant = where(on, 4.0 * (1.0 - retardation) * mu, 0.0)
    drive = 0.5 * instant * relaxation * strain
    radial_change = where(on, -(relaxation + strain) * radial - drive, 0.0)
    hoop_change = where(on, -(relaxation + 4.0 * strain) * hoop - drive, 0.0)
    value = where(on, radial + hoop, 0.0) + instant * strain
    rate = radial_change + hoop_change - instant * strain * strain
    return value, rate, instant / radius, radial_change, hoop_change


def _strain_shell(
    radius: Scalar,
    velocity: Scalar,
    shell: Scalar,
    weight: Scalar,
    radial: Scalar,
    hoop: Scalar,
    mu: Scalar,
    time: Scalar,
    retardation: Scalar,
    mobility: Scalar,
    extensibility: Scalar,
) -> Scalars:
    """The share of one shell in the stress of a polymer in a solvent, see :func:`giesekus` and
    :func:`ptt`.
    """
    on = time > 0.0
    relaxation = _relaxation_rate(time)
    polymer = (1.0 - retardation) * mu
    softness = where(polymer > 0.0, 1.0 / where(polymer > 0.0, polymer, 1.0), 0.0)
    instant = where(on, 4.0 * polymer, 0.0) / len(_SHELLS)
    flow = velocity / radius
    per_volume = 1.0 / (radius * radius * radius + shell)
    strain = radius * radius * velocity * per_volume
    drive = 2.0 * polymer * relaxation * strain
    fade = relaxation + softness * extensibility * (radial + 2.0 * hoop)
    softening = softness * mobility
    radial_change = -(fade + 4.0 * strain + softening * radial) * radial - 2.0 * drive
    hoop_change = -(fade - 2.0 * strain + softening * hoop) * hoop + drive
    radial_change = where(on, radial_change, 0.0)
    hoop_change = where(on, hoop_change, 0.0)
    share = where(on, weight * per_volume / 1.5, 0.0)
    value = share * (radial - hoop)
    rate = share * (radial_change - hoop_change) - 3.0 * strain * value
    return (
        value + instant * flow,
        rate - instant * flow * flow,
        instant / radius,
        radial_change,
        hoop_change,
    )


def giesekus(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    shell: Scalar,
    weight: Scalar,
    radial: Scalar,
    hoop: Scalar,
    mu: Scalar,
    tau_giesekus: Scalar,
    retardation: Scalar,
    mobility: Scalar,
) -> Scalars:
    """A polymer whose drag falls where it is aligned: ``D s + s/De + (a/mu_p) s^2 = 2 (mu_p/De) d``
    (Giesekus, J. Non-Newtonian Fluid Mech. 11, 1982).

    ``D`` is the upper-convected rate, ``d`` the rate of strain, ``mu_p = (1 - s) mu``. The states
    are the radial and the hoop stress of each shell ``q = r^3 - R^3``; the stress integral is ``2/3
    int (s_rr - s_tt)/(R^3 + q) dq``. At ``a = 0`` it is :func:`oldroyd_b`.
    """
    return _strain_shell(
        radius,
        velocity,
        shell,
        weight,
        radial,
        hoop,
        mu,
        tau_giesekus,
        retardation,
        mobility,
        0.0,
    )


def ptt(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    shell: Scalar,
    weight: Scalar,
    radial: Scalar,
    hoop: Scalar,
    mu: Scalar,
    tau_ptt: Scalar,
    retardation: Scalar,
    extensibility: Scalar,
) -> Scalars:
    """A network that fades faster where it is stretched: ``D s + (1 + e De/mu_p tr s) s/De = 2
    (mu_p/De) d``, linear (Phan-Thien & Tanner, J. Non-Newtonian Fluid Mech. 2, 1977).

    Otherwise as :func:`giesekus`.
    """
    return _strain_shell(
        radius,
        velocity,
        shell,
        weight,
        radial,
        hoop,
        mu,
        tau_ptt,
        retardation,
        0.0,
        extensibility,
    )


def _fade_arm(
    memory: Scalar, relaxation: Scalar, modulus: Scalar, strain: Scalar
) -> Scalar:
    """The rate of ``Z/R^3`` where ``Z' = -Z/De - 4 G R^2 U``, in which ``relaxation`` is ``1/De``."""
    return -relaxation * memory - (4.0 * modulus + 3.0 * memory) * strain


def first_arm(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    memory: Scalar,
    G_arm: Scalar,
    tau_arm: Scalar,
) -> Scalars:
    """A Maxwell arm beside all else: ``Z' = -Z/De - 4 G R^2 U``, ``S = Z/R^3``; it starts relaxed."""
    modulus = where(tau_arm > 0.0, G_arm, 0.0)
    change = _fade_arm(memory, _relaxation_rate(tau_arm), modulus, velocity / radius)
    return memory, change, 0.0, change


def second_arm(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    memory: Scalar,
    G_arm_slow: Scalar,
    tau_arm_slow: Scalar,
) -> Scalars:
    """Another one, as :func:`first_arm`."""
    return first_arm(radius, velocity, rest_radius, memory, G_arm_slow, tau_arm_slow)


_SPACING = 0.75 * log_of(10.0)
"""Log of the ratio of the relaxation rates of neighbouring arms."""


def _springpot_modulus(
    number: float, G: Scalar, order: Scalar, reference: Scalar
) -> Scalar:
    """The modulus of an arm by its number: that of the rate ``U_c/Rmax`` is 0."""
    return (
        G
        * sin(pi * order)
        * (_SPACING / pi)
        * exp(order * (_SPACING * number - log(reference)))
    )


def _fade_springpot(
    memory: Scalar,
    number: float,
    G: Scalar,
    order: Scalar,
    reference: Scalar,
    strain: Scalar,
) -> Scalar:
    modulus = _springpot_modulus(number, G, order, reference)
    return _fade_arm(memory, e ** (_SPACING * number), modulus, strain)


def springpot(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    m0: Scalar,
    m1: Scalar,
    m2: Scalar,
    m3: Scalar,
    m4: Scalar,
    m5: Scalar,
    m6: Scalar,
    G_frac: Scalar,
    fractional: Scalar,
    reference_rate: Scalar,
) -> Scalars:
    """A fractional element beside all else: the complex modulus ``G (i w/w_r)^a``, a spring at ``a =
    0`` and a dashpot at ``a = 1`` (Scott Blair 1947).

    ``t^-a/Gamma(1 - a) = (sin(pi a)/pi) int e^(a y - t e^y) dy``: seven Maxwell arms, four in three
    decades of rates from .03 to 1000 ``U_c/Rmax``, a linear spring for all slower ones and a dashpot
    for all faster ones. The complex modulus is within 2 % from .1 to 300 ``U_c/Rmax``.
    """
    slow = _springpot_modulus(-3.0, G_frac, fractional, reference_rate)
    slow = slow / -expm1(-_SPACING * fractional)
    fast = _springpot_modulus(5.0, G_frac, fractional, reference_rate) * e ** (
        -5.0 * _SPACING
    )
    fast = fast / -expm1(_SPACING * (fractional - 1.0))
    value, rate, _ = linear_elastic(radius, velocity, rest_radius, slow)
    flow, flow_rate, inertia = newtonian(radius, velocity, rest_radius, fast)
    strain = velocity / radius
    changes = (
        _fade_springpot(m0, -2.0, G_frac, fractional, reference_rate, strain),
        _fade_springpot(m1, -1.0, G_frac, fractional, reference_rate, strain),
        _fade_springpot(m2, 0.0, G_frac, fractional, reference_rate, strain),
        _fade_springpot(m3, 1.0, G_frac, fractional, reference_rate, strain),
        _fade_springpot(m4, 2.0, G_frac, fractional, reference_rate, strain),
        _fade_springpot(m5, 3.0, G_frac, fractional, reference_rate, strain),
        _fade_springpot(m6, 4.0, G_frac, fractional, reference_rate, strain),
    )
    for memory in (m0, m1, m2, m3, m4, m5, m6):
        value = value + memory
    for change in changes:
        rate = rate + change
    return value + flow, rate + flow_rate, inertia, *changes


def _springpot_start(
    rest_radius: Scalar, G_frac: Scalar, fractional: Scalar, reference_rate: Scalar
) -> Scalars:
    """Of a bubble whose volume grew evenly from ``R_inf`` within ``Rmax/U_c``."""
    grown = -4.0 / 3.0 * (1.0 - rest_radius**3)
    rates = [(k, e ** (_SPACING * k)) for k in range(-2, 5)]
    return tuple(
        grown
        * _springpot_modulus(k, G_frac, fractional, reference_rate)
        * (1.0 - e**-rate)
        / rate
        for k, rate in rates
    )


def _springpot_fastest(
    G_frac: Scalar, fractional: Scalar, reference_rate: Scalar
) -> Scalar:
    return where(G_frac > 0.0, e ** (4.0 * _SPACING), 0.0)


MEMORY = (
    StressTerm(maxwell, switch="tau", states=1, fastest=_fastest_rate),
    StressTerm(
        standard_linear,
        switch="tau_sls",
        states=1,
        start=_standard_linear_start,
        fastest=_fastest_rate,
    ),
    StressTerm(
        standard_nonlinear,
        switch="tau_sns",
        states=1,
        start=_standard_nonlinear_start,
        fastest=_fastest_rate,
    ),
    StressTerm(oldroyd_b, switch="tau_ucm", states=2, fastest=_fastest_rate),
    StressTerm(first_arm, switch="G_arm", states=1, fastest=_fastest_rate),
    StressTerm(second_arm, switch="G_arm_slow", states=1, fastest=_fastest_rate),
    StressTerm(
        springpot,
        switch="G_frac",
        states=7,
        beside=("reference_rate",),
        start=_springpot_start,
        fastest=_springpot_fastest,
    ),
    StressTerm(
        giesekus,
        switch="tau_giesekus",
        states=2 * len(_SHELLS),
        fastest=_fastest_rate,
        shells=_SHELLS,
    ),
    StressTerm(
        ptt,
        switch="tau_ptt",
        states=2 * len(_SHELLS),
        fastest=_fastest_rate,
        shells=_SHELLS,
    ),
)
"""The terms of these laws."""
