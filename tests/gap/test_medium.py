"""What assumed values of the medium would change: against refits in that medium, and silent where
nothing changes.
"""

import math

import pytest
import torch

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.assimilate import ModelFit, SearchOptions, assimilate
from imr_torch.float64 import linspace, tensor
from imr_torch.gap import medium_sensitivities
from imr_torch.gap.medium import DEVIATIONS
from imr_torch.material import PARAMETERS
from imr_torch.observe import (
    ExperimentBatch,
    GelMedium,
    SimulatedLaboratory,
    Statement,
    gel_medium,
)
from imr_torch.simulate.setting import OF_MEDIUM
from tests.gap.synthetic import SIMULATOR, UNSURE

OPTIONS = SearchOptions(raw_samples=24, starts=2)


def batch(repeats: int) -> ExperimentBatch:
    laboratory = SimulatedLaboratory(
        SIMULATOR, PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=repeats, nuisance=UNSURE,
        times=linspace(0.0, 2.5, 51),
    )  # fmt: skip
    designs = tensor([[400.0, 0.22], [250.0, 0.17]])
    return ExperimentBatch(
        tuple(laboratory.shoot(design, seed=i) for i, design in enumerate(designs))
    )


def fit_of(data: ExperimentBatch, prior=None) -> ModelFit:
    return assimilate(
        prior or wide_prior(["nhkv"]), data, SIMULATOR, seed=0, options=OPTIONS
    ).fits[0]


def list_found(data: ExperimentBatch, fit: ModelFit, medium: GelMedium | None = None):
    """Name -> what is said of that value of the medium."""
    found = medium_sensitivities(fit, data, SIMULATOR, medium or GelMedium())
    return {x.name: x for x in found}


@pytest.fixture(scope="module")
def many():
    data = batch(30)
    return data, fit_of(data)


@pytest.mark.parametrize("field", ["density", "sound_speed", "far_field_pressure"])
def test_that_the_shift_is_that_of_a_refit(many, field):
    """The medium is moved a fifth of the deviation, so that the refit stays linear."""
    data, fit = many
    found = list_found(data, fit)[field]
    entry = PARAMETERS[OF_MEDIUM[field]]
    share = 0.2
    moved = _held(entry.name, share * math.log(DEVIATIONS[field]), data)
    shift = (moved.mean - fit.mean) / torch.linalg.norm(fit.chol, dim=1)
    for name, sigma in found.sigmas.items():
        assert share * sigma == pytest.approx(
            float(shift[fit.prior.names.index(name)]), rel=0.12, abs=0.03
        )
        value, after = (
            float(f.parameters(f.mean)[PARAMETERS.index([name])[0]]) for f in (fit, moved)
        )
        assert share * found.relative[name] == pytest.approx(
            after / value - 1.0, rel=0.12, abs=2e-4
        )


def _held(name: str, value: float, data: ExperimentBatch) -> ModelFit:
    """The fit in a medium whose parameter has a value: simulated with it in every bubble."""

    class Moved(PolytropicSimulator):
        def __call__(self, parameters, designs, times):
            return super().__call__(self.there(parameters), designs, times)

        def bundle(self, parameters, designs, times):
            return super().bundle(self.there(parameters), designs, times)

        @staticmethod
        def there(parameters):
            moved = parameters.clone()
            moved[..., PARAMETERS.index([name])[0]] = value
            return moved

    return assimilate(wide_prior(["nhkv"]), data, Moved(), seed=0, options=OPTIONS).fits[0]


def test_that_what_is_stated_or_inferred_is_not_listed_and_what_does_not_matter_neither(
    many,
):
    given = {"density", "far_field_pressure"}
    listed = list_found(*many).keys()
    assert given <= listed
    stated = gel_medium(Statement.from_text("density=1060,pressure=101325"))
    assert list_found(*many, stated).keys() == listed - given
    few = batch(1)
    assert "surface_tension" not in list_found(few, fit_of(few))


def test_that_the_sentence_names_value_deviation_and_shift(many):
    found = list_found(*many)["density"]
    assert found.sentence().startswith(
        "density was assumed 1060 kg/m^3; 3 % more would change G by "
    )
    assert " sd)" in found.sentence()
