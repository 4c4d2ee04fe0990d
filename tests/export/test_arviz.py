"""The ArviZ tree: groups, names, units, moments; its file; and what ArviZ makes of it."""

import numpy as np
import pytest

from imr_torch.assimilate import SearchOptions, weigh
from imr_torch.export import to_arviz
from imr_torch.observe import ExperimentBatch, GelMedium, Nuisance
from tests.linear import (
    NHKV,
    LinearSimulator,
    exact,
    experiments,
    fit_linear,
    prior,
    tensor,
)
from tests.refusals import refused

pytest.importorskip("arviz_base", reason="needs the extra arviz")


@pytest.fixture(scope="module")
def weighted():
    batch = experiments(3, nuisance=Nuisance(time_zero=0.2, rest_radius=0.3))
    fit = fit_linear(batch, belief=prior(("newtonian", "nhkv")))
    return weigh(fit, LinearSimulator(), seed=1, samples=1024)


def test_that_every_model_has_the_groups_of_the_schema_with_named_axes(weighted):
    tree = to_arviz(weighted, seed=0, draws=200)
    assert set(tree.children) == {"newtonian", "nhkv"}
    branch = tree["nhkv"]
    assert set(branch.children) == {
        "posterior",
        "sample_stats",
        "log_likelihood",
        "observed_data",
        "constant_data",
    }
    assert branch["posterior"]["G"].dims == ("chain", "draw")
    assert branch["posterior"]["G"].shape == (1, 200)
    assert branch["posterior"]["nuisances"].dims == (
        "chain",
        "draw",
        "experiment",
        "nuisance",
    )
    assert branch["posterior"]["nuisance"].values.tolist() == [
        "max_radius",
        "time_zero",
        "rest_radius",
    ]
    assert branch["log_likelihood"]["radius"].dims == ("chain", "draw", "experiment")
    assert branch["observed_data"]["radius"].dims == ("experiment", "frame")
    assert branch["observed_data"]["experiment"].values.tolist() == ["e0", "e1", "e2"]
    assert set(tree["newtonian"]["posterior"].data_vars) == {"mu", "nuisances"}


def test_that_units_travel_with_the_variables(weighted):
    branch = to_arviz(weighted, seed=0, draws=10)["nhkv"]
    assert branch["posterior"]["G"].attrs == {"units": "Pa"}
    assert branch["posterior"]["mu"].attrs["units"] == "Pa s"


def test_that_draws_have_the_posteriors_moments(weighted):
    posterior = to_arviz(weighted, seed=0, draws=4000)["nhkv"]["posterior"]
    part = weighted.prior["nhkv"]
    truth = exact(weighted.prior["nhkv"], weighted.batch)
    slopes = tensor(*[m.sd for m in part.marginals])
    mean = part.physical(truth.mean)
    sd = slopes * truth.covariance.diagonal().sqrt()
    for i, name in enumerate(part.names):
        assert posterior[name].mean() == pytest.approx(
            float(mean[i]), abs=0.1 * float(sd[i])
        )
        assert posterior[name].std() == pytest.approx(float(sd[i]), rel=0.08)
    found = posterior["nuisances"].mean(("chain", "draw")).values
    np.testing.assert_allclose(found, truth.nuisances.numpy(), atol=0.12)


def test_that_data_are_what_was_measured_and_missing_frames_are_nan(weighted):
    tree = to_arviz(weighted, seed=0, draws=10)
    batch = weighted.batch
    radius = tree["nhkv/observed_data"]["radius"].values
    times = tree["nhkv/constant_data"]["time"].values
    assert np.array_equal(np.isfinite(radius), batch.mask.numpy())
    assert np.array_equal(radius[batch.mask], batch.mean[batch.mask].numpy())
    assert np.array_equal(times[batch.mask], batch.times[batch.mask].numpy())
    designs = [tree["nhkv/constant_data"][name].values for name in ("weber", "rest_radius")]
    assert np.array_equal(np.stack(designs, 1), batch.designs.numpy())


def test_that_arvizs_leave_one_out_is_the_evidence_of_all_over_that_of_the_others(weighted):
    loo = pytest.importorskip("arviz_stats", reason="needs arviz-stats").base.array_stats
    branch = to_arviz(weighted, seed=0, draws=4000)["nhkv"]
    part = weighted.prior["nhkv"]
    batch = weighted.batch
    shapes = []
    for e in range(3):
        likelihood = branch["log_likelihood"]["radius"].values[0, :, e]
        weights, shape = loo.psislw(likelihood)
        shapes.append(float(shape))
        if shape > 0.7:
            continue
        rest = tuple(x for i, x in enumerate(batch.experiments) if i != e)
        others = ExperimentBatch(rest, batch.noise)
        truth = exact(part, batch).log_evidence - exact(part, others).log_evidence
        assert np.logaddexp.reduce(weights + likelihood) == pytest.approx(
            float(truth), abs=0.2
        )
    assert min(shapes) < 0.7


def test_that_arvizs_plots_and_comparison_take_the_tree(weighted):
    plots = pytest.importorskip("arviz_plots", reason="needs the extra arviz")
    stats = pytest.importorskip("arviz_stats")
    pyplot = pytest.importorskip("matplotlib.pyplot")
    tree = to_arviz(weighted, seed=0, draws=200)
    for plot in (plots.plot_dist, plots.plot_pair, plots.plot_forest):
        plot(tree["nhkv"], var_names=["G", "mu"], backend="matplotlib")
    pyplot.close("all")
    table = stats.compare({name: tree[name] for name in ("newtonian", "nhkv")})
    assert table.index[0] == "nhkv"


def test_that_a_fit_without_weights_gives_its_gaussian():
    fit = fit_linear(experiments(1))
    branch = to_arviz(fit, seed=0, draws=4000)["nhkv"]
    assert set(branch.children) == {"posterior", "observed_data", "constant_data"}
    expected = fit["nhkv"].posterior
    assert branch["posterior"]["G"].mean() == pytest.approx(
        float(expected.means[0]), rel=0.02
    )
    assert branch["posterior"]["G"].std() == pytest.approx(float(expected.sds[0]), rel=0.05)


def test_that_an_inferred_density_is_exported_as_the_logarithm_that_it_is():
    belief = GelMedium().loosened.believed(NHKV)
    options = SearchOptions(raw_samples=8, starts=2)
    fits = fit_linear(experiments(2), belief=belief, options=options, warn=False)
    names = set(to_arviz(fits, seed=0, draws=2)["nhkv+density/posterior"].data_vars)
    assert names == {"G", "mu", "ln_density_ratio"}


def test_that_a_file_holds_the_tree(weighted, tmp_path):
    import xarray

    tree = to_arviz(weighted, seed=0, draws=20)
    path = tmp_path / "fit.nc"
    tree.to_netcdf(path, engine="h5netcdf")
    with xarray.open_datatree(path, engine="h5netcdf") as back:
        assert set(back["nhkv"].children) == set(tree["nhkv"].children)
        assert np.array_equal(
            back["nhkv/posterior"]["G"].values, tree["nhkv/posterior"]["G"].values
        )
        assert back["nhkv/posterior"]["G"].attrs["units"] == "Pa"
        assert back["nhkv/observed_data"]["experiment"].values.tolist() == [
            "e0",
            "e1",
            "e2",
        ]


def test_that_no_draw_is_refused(weighted):
    with refused("draws is 0; at least 1"):
        to_arviz(weighted, seed=0, draws=0)
