"""Every effect of the library both ways: found in data that have it, and not claimed in data that
do not.
"""

import pytest

from imr_torch.assimilate import ModelFit
from imr_torch.float64 import tensor
from imr_torch.gap.hypotheses import Hypothesis, laplace_evidence
from imr_torch.material import LIBRARY, Effect, TruncatedNormal, library
from tests.gap.synthetic import BASE, DESIGNS, fit, shoot

REPEATS = 10
CLAIMED = 3.5  # nats at which an effect is more probable than none: even odds against its share of the prior
LARGE = {
    "permanent_set": 3.0,
    "vapour_pressure": 2.0,
}  # prior standard deviations at which these data show them; else 1
FAINT = {"surface_tension"}  # a typical one is not seen in these data
SLOW = {
    "stress_relaxation"
}  # a fit that leads to a relaxation time of zero takes ever shorter steps, half a minute


def effects(*without: str):
    """The same test of every effect that a diagnosis is offered."""
    names = [effect.name for effect in library(without=without)]
    return pytest.mark.parametrize("effect", [LIBRARY[name] for name in names], ids=names)


def typical(effect: Effect) -> dict[str, float]:
    """The effect at a prior standard deviation of its amplitude."""
    prior = effect.priors[effect.names[0]]
    assert isinstance(prior, TruncatedNormal)
    return dict(
        zip(
            effect.names,
            (LARGE.get(effect.name, 1.0) * prior.sd, *effect.starts[0][1:]),
            strict=True,
        )
    )


def evidence_of(
    effect: Effect, null: ModelFit, batch, **values: float
) -> tuple[float, ModelFit]:
    """Nats by which the base model with the effect is better than alone, and its fit."""
    found = fit(batch, Hypothesis(BASE, (effect,)), **values)
    return laplace_evidence(found) - laplace_evidence(null), found


@pytest.fixture(scope="module")
def matched():
    """Data of the base model, and its fit."""
    batch = shoot({}, DESIGNS, repeats=REPEATS)
    return batch, fit(batch)


@effects()
def test_that_an_effect_is_found_where_it_is(effect):
    values = typical(effect)
    batch = shoot(values, DESIGNS, repeats=REPEATS)
    gain, found = evidence_of(effect, fit(batch), batch, **values)
    assert found.certificate.converged
    place = found.prior.names.index(effect.names[0])
    name = effect.names[0]
    truth = effect.priors[name].to_control(tensor(values[name]))
    assert abs(found.mean[place] - truth) < 4.0 * found.chol[place].norm()
    assert (gain > CLAIMED) == (effect.name not in FAINT)


@effects(*SLOW)
def test_that_an_effect_is_not_claimed_where_there_is_none(effect, matched):
    batch, null = matched
    start = dict(zip(effect.names, effect.starts[0], strict=True))
    assert evidence_of(effect, null, batch, **start)[0] < CLAIMED
