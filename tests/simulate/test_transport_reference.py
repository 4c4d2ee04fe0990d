"""Against an independent converged solver of the same equations, on public cases of the published code."""

import numpy as np
import pytest
import torch

from imr_torch.errors import UnsupportedError
from imr_torch.files import read_json
from imr_torch.float64 import tensor
from imr_torch.simulate import PRESETS, Accuracy, Resolution, TransportSimulator
from tests.conformance import authors as adapter
from tests.refusals import refused

CURVES = {"published": "estrada2018", "authors_code": "parity_spectral"}


@pytest.fixture(scope="module")
def cases(shared):
    return read_json(shared / "reference" / "authors_code_public.json")["cases"]


@pytest.fixture(scope="module")
def oracle(shared):
    return dict(np.load(shared / "reference" / "oracle_curves_public.npz"))


def simulate(cases, times, key, accuracy):
    parameters = torch.stack([adapter.parameter_vector(case) for case in cases])
    designs = tensor([[case["We"], case["Rinf_star"]] for case in cases])
    return TransportSimulator(PRESETS[key], accuracy)(
        parameters, designs, torch.as_tensor(times)
    ).radius.numpy()


@pytest.mark.parametrize("key", CURVES)
def test_radius_agrees_with_the_independent_solver(cases, oracle, key):
    radius = simulate(cases, oracle["t_1601"], key, Accuracy(3e-5, Resolution(22, 22)))
    error = np.abs(radius - oracle[f"{CURVES[key]}_R_1601"])
    assert np.median(error) < 5e-5
    assert np.median(error.max(1)) < 1e-3
    # the independent solver itself is good to 1e-3 or 2e-3 in the most violent case
    assert error.max() < 2.5e-3


@pytest.mark.parametrize("key", CURVES)
def test_collapse_times_and_rebounds_agree_at_default_accuracy(cases, oracle, key):
    extrema = oracle[f"{CURVES[key]}_extrema"]
    (collapse, smallest), (peak, rebound) = extrema[:, 0, :2].T, extrema[:, 1, :2].T
    near = np.linspace(-2e-3, 2e-3, 401)
    times = np.concatenate((collapse[:, None] + near, peak[:, None] + 20.0 * near), 1)
    radius = simulate(cases, times, key, Accuracy())
    assert np.abs(near[radius[:, :401].argmin(1)]).max() < 1e-4
    assert np.abs(radius[:, :401].min(1) - smallest).max() < 5e-4
    assert np.abs(radius[:, 401:].max(1) - rebound).max() < 1e-3


def test_the_adapter_gives_the_converged_curve(cases, oracle):
    radius = adapter.radius(
        {**cases[2], "preset": "published", "grid": "converged"}, oracle["t_1601"][::20]
    )
    assert np.abs(radius - oracle["estrada2018_R_1601"][2, ::20]).max() < 3e-4


def test_on_the_published_grid_the_published_code_is_reproduced(cases, shared):
    curves = np.load(shared / "reference" / "authors_code_public.npz")
    times = curves["t_81"][:41]
    radius = adapter.radius(
        {**cases[2], "preset": "authors_code", "grid": "authors_240"}, times
    )
    assert np.abs(radius - curves["R_81"][2, :41]).max() < 1e-4


def test_the_adapter_refuses_models_that_the_toolkit_does_not_have(cases):
    with refused("not in the registry", UnsupportedError):
        adapter.radius(
            {**cases[0], "equivalent_model": "unheard_of"}, np.linspace(0.0, 1.0, 5)
        )
