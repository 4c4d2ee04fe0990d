"""Stress terms with memory: Maxwell and Zener branches, the standard solids of the published code, Oldroyd-B.

Each replaces the instantaneous stress of the terms beside it by one that relaxes: for a member with a relaxation time, the
term takes off what those terms add at once and adds its memory state instead. At a relaxation time of zero it does
nothing, so a batch may mix gels with and without memory.

Sources: Warnez & Johnsen (Phys. Fluids 27, 2015) for Maxwell, Zener and the upper-convected branch round a bubble; Estrada
et al. (J. Mech. Phys. Solids 112, 2018), section 2.2, for the standard linear and nonlinear solids.
"""

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from imr_torch.material.stress import Stress


def _relaxation(time: Tensor) -> tuple[Tensor, Tensor]:
    """Which members relax, and ``1/De`` (zero for the others)."""
    on = time > 0.0
    return on, torch.where(on, 1.0 / torch.where(on, time, 1.0), 0.0)


class MaxwellBranch:
    """Viscous stress that relaxes: ``De Z' + Z = -4 (1 - s) R^2 U/Re``, ``S = Z/R^3 - 4 s U/(Re R)``.

    The linear Maxwell fluid (with ``s > 0``: Jeffreys) round a bubble, exact for it because its stress falls as ``r^-3`` at all
    times; beside an elastic term it is the Zener model (Warnez & Johnsen 2015). The state is ``Z/R^3``. ``s`` is the
    retardation time over the relaxation time.
    """

    names: ClassVar[tuple[str, ...]] = ("mu", "tau", "retardation")
    switch: ClassVar[str] = "tau"
    states: ClassVar[int] = 1
    analytic: ClassVar[bool] = True

    def __call__(
        self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor], memory: Tensor
    ) -> Stress:
        """See :class:`imr_torch.material.stress.MemoryTerm`."""
        on, _ = _relaxation(theta["tau"])
        instant = torch.where(on, 4.0 * (1.0 - theta["retardation"]) * theta["mu"], 0.0) / radius
        value = torch.where(on, memory[0], 0.0) + instant * velocity
        rate = self.memory_rate(radius, velocity, rest_radius, theta, memory)[0] - instant * velocity**2 / radius
        return Stress(value, rate, instant)

    def start(self, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Tensor:
        """Relaxed: see :class:`imr_torch.material.stress.MemoryTerm`."""
        return torch.zeros_like(rest_radius)[None]

    def memory_rate(
        self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor], memory: Tensor
    ) -> Tensor:
        """See :class:`imr_torch.material.stress.MemoryTerm`."""
        on, rate = _relaxation(theta["tau"])
        strain = velocity / radius
        drive = 4.0 * (1.0 - theta["retardation"]) * theta["mu"] * strain
        return torch.where(on, -rate * (memory + drive) - 3.0 * strain * memory, 0.0)

    def fastest(self, theta: Mapping[str, Tensor]) -> Tensor:
        """See :class:`imr_torch.material.stress.MemoryTerm`."""
        return _relaxation(theta["tau"])[1]


class _StandardSolid:
    """A solid whose whole stress relaxes to its elastic one: ``S' = (S_e - S)/De - 4 U/(Re De R) - f(l) U/R``.

    ``S_e`` is the elastic stress beside the dashpot's branch, ``f`` its stiffness against fast strain. The state is ``S``; it
    starts relaxed, at ``S_e``, because a bubble lingers at its maximum.
    """

    names: ClassVar[tuple[str, ...]]
    switch: ClassVar[str]
    states: ClassVar[int] = 1
    analytic: ClassVar[bool] = True

    def elastic(self, inverse: Tensor, theta: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """``S_e``, ``dS_e/d ln l`` and ``f`` at ``1/l``."""
        raise NotImplementedError

    def __call__(
        self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor], memory: Tensor
    ) -> Stress:
        """See :class:`imr_torch.material.stress.MemoryTerm`."""
        on, _ = _relaxation(theta[self.switch])
        strain = velocity / radius
        elastic, slope, _ = self.elastic(rest_radius / radius, theta)
        viscous = 4.0 * theta["mu"] / radius
        rate = self.memory_rate(radius, velocity, rest_radius, theta, memory)[0]
        return Stress(
            torch.where(on, memory[0] - elastic + viscous * velocity, 0.0),
            torch.where(on, rate - slope * strain - viscous * velocity * strain, 0.0),
            torch.where(on, viscous, 0.0),
        )

    def start(self, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Tensor:
        """Relaxed to the elastic stress: see :class:`imr_torch.material.stress.MemoryTerm`."""
        on, _ = _relaxation(theta[self.switch])
        return torch.where(on, self.elastic(rest_radius, theta)[0], 0.0)[None]

    def memory_rate(
        self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor], memory: Tensor
    ) -> Tensor:
        """See :class:`imr_torch.material.stress.MemoryTerm`."""
        on, rate = _relaxation(theta[self.switch])
        strain = velocity / radius
        elastic, _, stiffness = self.elastic(rest_radius / radius, theta)
        return torch.where(on, rate * (elastic - memory - 4.0 * theta["mu"] * strain) - stiffness * strain, 0.0)

    def fastest(self, theta: Mapping[str, Tensor]) -> Tensor:
        """See :class:`imr_torch.material.stress.MemoryTerm`."""
        return _relaxation(theta[self.switch])[1]


class StandardLinearSolid(_StandardSolid):
    """A linear spring beside a linear Maxwell branch (Estrada et al. 2018, eq. 12)."""

    names: ClassVar[tuple[str, ...]] = ("mu", "G_lin", "tau_sls")
    switch: ClassVar[str] = "tau_sls"

    def elastic(self, inverse: Tensor, theta: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """See :class:`_StandardSolid`."""
        stiffness = 4.0 * theta["G_lin"]
        return -stiffness / 3.0 * (1.0 - inverse**3), -stiffness * inverse**3, stiffness


class StandardNonlinearSolid(_StandardSolid):
    """A neo-Hookean spring beside a linear Maxwell branch (Estrada et al. 2018, eq. 13; "nhzen" in the published code)."""

    names: ClassVar[tuple[str, ...]] = ("mu", "G", "tau_sns")
    switch: ClassVar[str] = "tau_sns"

    def elastic(self, inverse: Tensor, theta: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """See :class:`_StandardSolid`."""
        modulus, cubed = theta["G"], inverse**3
        # (3/14 l^3 + l^2 - 3/(2 l) + 2/(7 l^4))/(l^3 - 1) without its removable pole at l = 1
        x = inverse
        polynomial = (3.0 + 17.0 * x + 17.0 * x**2 + 17.0 * x**3 - 4.0 * x**4 - 4.0 * x**5 - 4.0 * x**6) / 14.0
        stiffness = 4.0 * modulus * polynomial / (1.0 + x + x * x)
        return (
            -0.5 * modulus * (5.0 - inverse * (4.0 + cubed)),
            -2.0 * modulus * inverse * (1.0 + cubed),
            stiffness,
        )


class OldroydB:
    """Upper-convected Maxwell branch with a solvent, its stress integral in closed form with two states.

    ``Z_1' = -(1/De - 2U/R) Z_1 - 2 (1 - s) R^2 U/(Re De)``, ``Z_2' = -(1/De + U/R) Z_2 - 2 (1 - s) R^2 U/(Re De)``,
    ``S = (Z_1 + Z_2)/R^3 - 4 s U/(Re R)`` (Warnez & Johnsen 2015, section II.C). The states are ``Z/R^3``. Each shell of the
    gel keeps ``r^3 - R^3``, so its stress is an integral over its past; integrated over the shells first, the past enters by
    ``(R/R')^2 + R'/R`` alone, one state for each. Neither is the radial or the hoop stress; their sum is exact.
    """

    names: ClassVar[tuple[str, ...]] = ("mu", "tau_ucm", "retardation")
    switch: ClassVar[str] = "tau_ucm"
    states: ClassVar[int] = 2
    analytic: ClassVar[bool] = True

    def __call__(
        self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor], memory: Tensor
    ) -> Stress:
        """See :class:`imr_torch.material.stress.MemoryTerm`."""
        on, _ = _relaxation(theta["tau_ucm"])
        instant = torch.where(on, 4.0 * (1.0 - theta["retardation"]) * theta["mu"], 0.0) / radius
        rates = self.memory_rate(radius, velocity, rest_radius, theta, memory)
        value = torch.where(on, memory[0] + memory[1], 0.0) + instant * velocity
        return Stress(value, rates[0] + rates[1] - instant * velocity**2 / radius, instant)

    def start(self, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Tensor:
        """Relaxed: see :class:`imr_torch.material.stress.MemoryTerm`."""
        return torch.zeros_like(rest_radius).expand(2, *rest_radius.shape)

    def memory_rate(
        self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor], memory: Tensor
    ) -> Tensor:
        """See :class:`imr_torch.material.stress.MemoryTerm`."""
        on, rate = _relaxation(theta["tau_ucm"])
        strain = velocity / radius
        drive = 2.0 * (1.0 - theta["retardation"]) * theta["mu"] * rate * strain
        radial = -(rate + strain) * memory[0] - drive
        hoop = -(rate + 4.0 * strain) * memory[1] - drive
        return torch.where(on, torch.stack((radial, hoop)), 0.0)

    def fastest(self, theta: Mapping[str, Tensor]) -> Tensor:
        """See :class:`imr_torch.material.stress.MemoryTerm`."""
        return _relaxation(theta["tau_ucm"])[1]
