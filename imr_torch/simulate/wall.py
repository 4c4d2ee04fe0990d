"""The balance at the bubble wall: Keller-Miksis with surface tension and a stress integral, all dimensionless.

``(1 - U/c) R U' + 3/2 (1 - U/(3c)) U^2 = (1 + U/c + (R/c) d/dt) P`` with ``P = p_b - 1/(We R) + S - 1``
(Keller & Miksis, J. Acoust. Soc. Am. 68, 1980; Estrada et al. 2018, eq. 4). ``dP/dt`` contains ``dU/dt`` through the
viscous stress; that part is taken to the left-hand side.
"""

from dataclasses import dataclass

from torch import Tensor

from imr_torch.material import StressTerm, active_terms, dimensionless, stress_integral
from imr_torch.simulate.conditions import Conditions


@dataclass(frozen=True)
class PolytropicBubble:
    """A batch of bubbles made dimensionless, ready to be integrated.

    Args:
        weber: ``B`` tensor.
        rest_radius: ``B`` tensor, ``R_inf / Rmax``.
        theta: dimensionless parameters, each a ``B`` tensor.
        terms: the stress terms that act in this batch.
        gas_pressure: ``B`` tensor, gas pressure at ``R = Rmax`` over ``p_inf``.
        vapour_pressure: over ``p_inf``.
        exponent: three times the polytropic exponent.
        sound_speed: over ``U_c``.
    """

    weber: Tensor
    rest_radius: Tensor
    theta: dict[str, Tensor]
    terms: tuple[StressTerm, ...]
    gas_pressure: Tensor
    vapour_pressure: float
    exponent: float
    sound_speed: float

    @classmethod
    def of(cls, parameters: Tensor, designs: Tensor, conditions: Conditions) -> "PolytropicBubble":
        """Make a batch dimensionless: ``parameters`` is ``B x p`` (SI), ``designs`` ``B x 2`` (We, R_inf*)."""
        surroundings, gas = conditions.surroundings, conditions.gas
        weber, rest_radius = designs[:, 0], designs[:, 1]
        theta = dimensionless(parameters, surroundings.max_radius(weber), surroundings)
        exponent = 3.0 * gas.exponent
        at_rest = 1.0 + 1.0 / (weber * rest_radius) - conditions.vapour_pressure
        return cls(
            weber=weber,
            rest_radius=rest_radius,
            theta=theta,
            terms=active_terms(theta),
            gas_pressure=at_rest * rest_radius ** (3.0 if gas.reference == "maximum" else exponent),
            vapour_pressure=conditions.vapour_pressure,
            exponent=exponent,
            sound_speed=surroundings.sound_speed / surroundings.velocity_scale,
        )

    def take(self, members: Tensor) -> "PolytropicBubble":
        """The sub-batch of the members with these indices."""
        return PolytropicBubble(
            self.weber[members],
            self.rest_radius[members],
            {name: value[members] for name, value in self.theta.items()},
            self.terms,
            self.gas_pressure[members],
            self.vapour_pressure,
            self.exponent,
            self.sound_speed,
        )

    def bubble_pressure(self, radius: Tensor) -> Tensor:
        """Gas and vapour pressure over ``p_inf``; ``radius`` broadcasts against ``B``."""
        return self.gas_pressure * radius**-self.exponent + self.vapour_pressure

    def acceleration(self, radius: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
        """``dU/dt`` and the bubble pressure at a state; shapes broadcast against ``B``."""
        pressure = self.bubble_pressure(radius)
        stress = stress_integral(self.terms, radius, velocity, self.rest_radius, self.theta)
        tension = 1.0 / (self.weber * radius)
        rate = velocity / radius
        load = pressure - tension + stress.value - 1.0
        load_rate = (tension - self.exponent * (pressure - self.vapour_pressure)) * rate + stress.rate
        mach = velocity / self.sound_speed
        delay = radius / self.sound_speed
        force = (1.0 + mach) * load + delay * load_rate - (1.5 - 0.5 * mach) * velocity * velocity
        return force / ((1.0 - mach) * radius - delay * stress.acceleration), pressure
