"""Water against tabulated values, and named media: what a source states, moved with temperature as
water is.
"""

import pytest

from imr_torch.material.media import NAMED, OF_WATER, ROOM, named_medium
from tests.refusals import refused


@pytest.mark.parametrize(
    ("field", "temperature", "value", "error"),
    [  # IAPWS-95 at .1 MPa; surface tension: table of IAPWS R1-76
        ("density", 277.13, 999.97, 0.01),
        ("density", 298.15, 997.05, 0.02),
        ("density", 310.15, 993.33, 0.03),
        ("sound_speed", 293.15, 1482.3, 0.3),
        ("sound_speed", 310.15, 1523.6, 0.5),
        ("surface_tension", 293.15, 72.75e-3, 2e-5),
        ("surface_tension", 333.15, 66.24e-3, 2e-5),
    ],
)
def test_that_water_is_as_in_the_tables(field, temperature, value, error):
    assert OF_WATER[field](temperature) == pytest.approx(value, abs=error)


@pytest.mark.parametrize("name", NAMED)
def test_that_a_named_medium_is_its_source_at_its_temperature_and_follows_water_elsewhere(
    name,
):
    medium = named_medium(name)
    assert medium.source
    assert medium.at(medium.temperature) == pytest.approx(dict(medium.values))
    warm = medium.at(320.0)
    for field, value in medium.values.items():
        assert warm[field] / value == pytest.approx(
            OF_WATER[field](320.0) / OF_WATER[field](ROOM)
        )
    assert set(medium.sds) <= set(medium.values)


def test_that_a_name_which_is_not_known_is_refused_with_those_that_are():
    with refused("Unknown medium 'gelatine'; known are water, pbs"):
        named_medium("gelatine")
