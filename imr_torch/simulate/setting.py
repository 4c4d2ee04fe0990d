"""What the numbers of a bubble follow from, before its parameters make dimensionless numbers of it;
effects change it.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.simulate.conditions import Conditions
from imr_torch.types import BubbleValues


class Setting(NamedTuple):
    """What the numbers of a bubble follow from; each a ``B`` tensor, which effects may change.

    Args:
        rest_radius: ``R_inf*`` of the design.
        tension: ``1/We`` as it acts on the wall.
        slowness: ``1/c``.
        far: far-field pressure.
        image: strength of a mirror bubble.
        beyond: share of the terms of second order in the Mach number.
        velocity: of the wall at time zero.
        saturation: vapour pressure at the far temperature.
        conduction: factor on the conductivity of the contents.
        exponent: of polytropic gas.
        adiabatic: ratio of specific heats.
        gas: amount of gas at time zero over that which rests at ``rest_radius``.
        warmth: mean temperature of the contents at time zero, less 1.
        pace: ``U_c`` of the medium over that of the surroundings, ``sqrt(rho_0/rho)``.
        ambient: far-field pressure at which the contents were at rest.
        resting: ``1/We`` at which they were.
        temperature: of the medium, K.
    """

    rest_radius: BubbleValues
    tension: BubbleValues
    slowness: BubbleValues
    far: BubbleValues
    image: BubbleValues
    beyond: BubbleValues
    velocity: BubbleValues
    saturation: BubbleValues
    conduction: BubbleValues
    exponent: BubbleValues
    adiabatic: BubbleValues
    gas: BubbleValues
    warmth: BubbleValues
    pace: BubbleValues
    ambient: BubbleValues
    resting: BubbleValues
    temperature: BubbleValues

    @classmethod
    def of(cls, designs: Float[Tensor, "members 2"], conditions: Conditions) -> "Setting":
        """The setting of ``B x 2`` designs without effects."""
        outer = conditions.surroundings
        weber, rest = designs.unbind(1)
        sense = -1.0 if conditions.backwards else 1.0

        def all_at(value: float) -> Tensor:
            return torch.full_like(weber, value)

        return cls(
            rest_radius=rest,
            tension=1.0 / weber,
            slowness=all_at(sense * outer.velocity_scale / outer.sound_speed),
            far=all_at(1.0),
            image=all_at(0.0),
            beyond=all_at(0.0),
            velocity=all_at(sense * conditions.initial_velocity / outer.velocity_scale),
            saturation=all_at(conditions.saturation),
            conduction=all_at(1.0),
            exponent=all_at(conditions.gas.exponent),
            adiabatic=all_at(conditions.mixture.heat_ratio),
            gas=all_at(1.0),
            warmth=all_at(0.0),
            pace=all_at(1.0),
            ambient=all_at(1.0),
            resting=1.0 / weber,
            temperature=all_at(outer.temperature),
        )
