"""A characterisation as MATLAB reads it: parameters, and curves that two lines plot."""

import numpy as np
import pytest
from scipy.io import loadmat

from imr_torch.export import write_mat
from tests.results.documents import fitted, traces


@pytest.fixture(scope="module")
def result():
    return fitted(traces(("a", "b")))


def test_that_parameters_and_curves_are_struct_arrays_in_us_and_um(result, tmp_path):
    result.to_mat(tmp_path / "gel.mat")
    read = loadmat(tmp_path / "gel.mat", squeeze_me=True)
    assert read["model"] == "nhkv"
    names = [str(name) for name in read["parameters"]["name"]]
    document = result.to_document(draws=5)
    for name, (low, middle, high) in document["models"]["nhkv"]["intervals"].items():
        row = read["parameters"][names.index(name)]
        assert (row["low"], row["median"], row["high"]) == (low, middle, high)
    for curve, trace, wanted in zip(
        read["curves"], result.traces, document["curves"], strict=True
    ):
        start = 1e6 * wanted["time_of_max_s"]
        assert curve["id"] == trace.experiment_id
        assert curve["time_us"] + start == pytest.approx(
            1e6 * trace.time_s.numpy(), abs=1e-6
        )
        assert curve["radius_um"] == pytest.approx(1e6 * trace.radius_m.numpy())
        fitted_frames = curve["fitted"] > 0
        near = np.interp(
            curve["time_us"][fitted_frames],
            curve["model_time_us"],
            curve["model_radius_um"],
        )
        left = curve["radius_um"][fitted_frames] - near
        assert curve["asphericity"].size == 0
        size = 1e6 * wanted["Rmax_m"]
        assert left / size == pytest.approx(curve["residual"], abs=3e-3)


def test_that_a_result_without_curves_is_written_too(tmp_path):
    models = {"nhkv": {"intervals": {"G": [4e3, 5e3, 6e3], "density": [-0.1, 0.0, 0.1]}}}
    document = {"model_probabilities": {"nhkv": 1.0}, "models": models, "curves": []}
    write_mat(document, tmp_path / "gel.mat")
    read = loadmat(tmp_path / "gel.mat", squeeze_me=True)
    assert read["curves"].size == 0
    assert read["parameters"]["name"].tolist() == ["G", "ln_density_ratio"]


def test_that_the_shape_is_written_of_the_curves_that_have_it(result, tmp_path):
    document = result.to_document(draws=5)
    first, second = document["curves"]
    frames = len(first["measured"]["t_star"])
    shaped = first | {"measured": first["measured"] | {"asphericity": [0.05] * frames}}
    write_mat(document | {"curves": [shaped, second]}, tmp_path / "gel.mat")
    found = loadmat(tmp_path / "gel.mat", squeeze_me=True)["curves"]["asphericity"]
    assert [x.size for x in found] == [frames, 0]
    assert found[0].tolist() == [0.05] * frames
