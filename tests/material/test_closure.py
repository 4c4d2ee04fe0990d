"""The generic closure: each law's stress, its scale, and that nothing but the law's own state
matters.
"""

import pytest

from imr_torch.float64 import tensor
from imr_torch.material.departures import CLOSURE
from tests.material.gels import stress_of_term, tensors

RADIUS = 0.4
VELOCITY = -2.0
REST = 0.25
STRETCH = RADIUS / REST
STATES = {
    "law_stretch": STRETCH - 1.0,
    "law_stretch_squared": (STRETCH - 1.0) ** 2,
    "law_compression": STRETCH**-3 - 1.0,
    "law_compression_steep": STRETCH**-6 - 1.0,
    "law_velocity": VELOCITY,
    "law_velocity_squared": VELOCITY * abs(VELOCITY),
    "law_rate_squared": (VELOCITY / RADIUS) * abs(VELOCITY / RADIUS),
}


@pytest.mark.parametrize("law", CLOSURE, ids=lambda law: law.switch)
@pytest.mark.parametrize("coefficient", [0.0, 0.02, -0.04])
def test_that_each_law_is_a_stress_against_its_state(law, coefficient):
    radius, velocity, rest = (tensor(x) for x in (RADIUS, VELOCITY, REST))
    stress = stress_of_term(law, radius, velocity, rest, tensors({law.switch: coefficient}))
    # |U| is rounded off
    assert stress.value == pytest.approx(-coefficient * STATES[law.switch], rel=1e-3)
