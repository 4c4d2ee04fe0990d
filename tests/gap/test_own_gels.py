"""Curves that differ:

their gels as nuisances against separate bubbles and closed forms, and as a step of the selection.
"""

import math
import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from imr_torch import PolytropicSimulator
from imr_torch.assimilate import Point, Posterior, SearchOptions, assimilate
from imr_torch.errors import InputDataError
from imr_torch.gap import (
    Parts,
    additions,
    describe,
    diagnose,
    library,
    own_gels,
    prediction,
    to_json,
    write_page,
)
from imr_torch.gap.attribute import Inquiry
from imr_torch.gap.document import selection_document
from imr_torch.gap.hypotheses import (
    GEL_SCATTER,
    Hypothesis,
    deviating,
    finish,
    fit_hypotheses,
    fit_null,
    laplace_evidence,
    scatters,
)
from imr_torch.gap.own_gels import as_one_fit, fit_alone, with_gels_of
from imr_torch.gap.parts import closed_by
from imr_torch.gap.prediction import held_out
from imr_torch.gap.report import next_step
from imr_torch.gap.strengths import unusual_strengths, values_of_curves
from imr_torch.goodness.linear import linearise, linearise_at
from imr_torch.material import LIBRARY, PARAMETERS
from imr_torch.observe import Experiment, ExperimentBatch, Scatter, SimulatedLaboratory, predict
from imr_torch.population import GaussianShots, coordinate_units
from tests.gap.synthetic import BASE

SIMULATOR = PolytropicSimulator(threads=1)
STIFF = {"G": 11e3, "mu": 0.09}
SOFT = {"G": 6e3, "mu": 0.09}


def shot(number: int, gel: dict[str, float]) -> Experiment:
    laboratory = SimulatedLaboratory(SIMULATOR, PARAMETERS.pack(gel), repeats=1)
    design = torch.tensor(
        [350.0 + 120.0 * (number % 4), 0.2 + 0.03 * (number % 4)], dtype=torch.float64
    )
    return laboratory.shoot(design, seed=number, label=f"shot {number}")


@pytest.fixture(scope="module")
def two_gels() -> ExperimentBatch:
    return ExperimentBatch((shot(0, SOFT), shot(1, STIFF), shot(2, {"G": 8e3, "mu": 0.09})))


@pytest.fixture(scope="module")
def null(two_gels):
    return fit_null(BASE, two_gels, SIMULATOR, seed=0)


@pytest.fixture(scope="module")
def apart(two_gels, null):
    hypothesis = Hypothesis(BASE, own_gels=True)
    fit = fit_hypotheses([hypothesis], null, two_gels, SIMULATOR, seed=0)[GEL_SCATTER]
    return (
        fit
        if fit.certificate.converged
        else finish(fit, hypothesis.seen(two_gels), SIMULATOR, seed=0)
    )


def test_that_each_experiment_is_seen_with_a_gel_of_its_own(two_gels) -> None:
    batch = Hypothesis(BASE, own_gels=True).seen(two_gels)
    assert batch.nuisance_sds.shape == (3, 5)
    shifts = torch.zeros(3, 5, dtype=torch.float64)
    shifts[:, 3] = torch.tensor([0.4, 0.0, -0.2])
    shifts[:, 4] = torch.tensor([0.0, 0.1, -0.3])
    seen = predict(SIMULATOR, PARAMETERS.pack(SOFT), batch, shifts)
    for e, own in enumerate(shifts[:, 3:].exp().tolist()):
        gel = PARAMETERS.pack({"G": SOFT["G"] * own[0], "mu": SOFT["mu"] * own[1]})
        alone = predict(SIMULATOR, gel, two_gels)[e]
        assert torch.allclose(seen[e], alone, atol=1e-12)


def test_that_the_strength_of_an_effect_stays_in_the_bounds_of_its_prior_in_every_experiment() -> (
    None
):
    own = scatters(BASE, Hypothesis(BASE, (LIBRARY["gas_loss"], LIBRARY["edge_error"])).belief)
    deviations = torch.tensor([-2.0, 0.0, 2.0], dtype=torch.float64)
    loss = own["gas_loss"].moved(torch.tensor(0.1, dtype=torch.float64), deviations)
    assert bool((loss >= 0.0).all() and (loss.diff() > 0.0).all())
    edge = own["edge_error"]  # its prior has a standard deviation of 2 um
    for value, sd in ((0.0, 1e-6), (4e-6, 1.562e-6), (40e-6, 12.04e-6)):
        moved = edge.moved(
            torch.tensor(value, dtype=torch.float64),
            torch.tensor([-0.003, 0.003], dtype=torch.float64),
        )
        assert float(moved.diff()) == pytest.approx(sd * 0.006 / 0.3, rel=1e-3)
    back = own["gas_loss"].deviation(loss[1:2], torch.tensor(0.1, dtype=torch.float64))
    assert float(back) == pytest.approx(0.0, abs=1e-9)


def test_that_sensitivities_to_a_gel_of_its_own_are_those_of_the_bubbles(two_gels) -> None:
    posterior = Posterior(BASE, Hypothesis(BASE, own_gels=True).seen(two_gels), SIMULATOR)
    point = Point(torch.tensor([0.3, -0.1]).double(), posterior.still())
    slopes = posterior.neighbourhood(point).slopes[1]
    step = 1e-3
    for column in (3, 4):
        moved = torch.zeros(2, 3, 5, dtype=torch.float64)
        moved[0, :, column], moved[1, :, column] = step, -step
        up, down = posterior.predict(Point(point.gel.expand(2, -1), moved))
        by_difference = (up - down) / (2.0 * step)
        assert torch.allclose(
            slopes[..., column], by_difference, atol=2e-3 * float(by_difference.abs().max())
        )


def test_that_a_scatter_of_gels_that_is_no_number_is_refused(two_gels) -> None:
    with pytest.raises(InputDataError, match=r"Scatter\.relative is 0"):
        Scatter(0.0)
    with pytest.raises(InputDataError, match="no_such"):
        ExperimentBatch(two_gels.experiments, between={"no_such": Scatter(0.3)})


def test_that_the_evidence_of_gels_that_differ_is_that_of_the_closed_form(
    two_gels, null, apart
) -> None:
    """The closed form has the Gaussian of each curve by itself, integrated over gel and population; both are of first order."""
    assert apart.certificate.converged
    alone = fit_alone(null, two_gels, SIMULATOR, seed=0)
    shots = GaussianShots.of_fits(alone, [laplace_evidence(fit) for fit in alone])
    scatter = torch.tensor(
        [scatters(BASE, BASE)[name].relative for name in BASE.names]
    ) / coordinate_units(BASE)
    exact = float(shots.given(scatter[None], BASE.mean, torch.cholesky_inverse(BASE.chol)).evidence)
    assert laplace_evidence(apart) == pytest.approx(exact, abs=0.1)
    assert laplace_evidence(apart) > laplace_evidence(null) + 30.0


def test_that_deviations_of_gels_are_found(apart) -> None:
    found = apart.nuisances[:, 3] * scatters(BASE, BASE)["G"].relative
    assert float(found[1] - found[0]) == pytest.approx(math.log(STIFF["G"] / SOFT["G"]), abs=0.1)
    assert float(found[1] - found[2]) == pytest.approx(math.log(STIFF["G"] / 8e3), abs=0.1)


def test_that_the_scatter_of_a_medium_and_of_the_shape_of_an_effect_is_none() -> None:
    hypothesis = Hypothesis(BASE, (LIBRARY["sound_field"],), own_gels=True)
    assert set(scatters(BASE, hypothesis.belief)) == {"G", "mu", "sound_field"}
    assert hypothesis.name == "sound_field+gel_scatter"


def test_that_deviations_are_kept_by_name_when_effects_come_and_go(two_gels, apart) -> None:
    more = Hypothesis(BASE, (LIBRARY["gas_loss"],), own_gels=True)
    wider = deviating(apart, more)
    names = list(scatters(BASE, more.belief))
    assert torch.equal(wider[:, 3 + names.index("G")], apart.nuisances[:, 3])
    assert float(wider[:, 3 + names.index("gas_loss")].abs().max()) == 0.0
    assert torch.equal(deviating(apart, Hypothesis(BASE)), apart.nuisances[:, :3])


def test_that_a_start_from_single_curves_sees_what_they_see(two_gels, null) -> None:
    alone = fit_alone(null, two_gels, SIMULATOR, seed=0)
    start = as_one_fit(null, alone, scatters(BASE, BASE))
    posterior = Posterior(BASE, Hypothesis(BASE, own_gels=True).seen(two_gels), SIMULATOR)
    seen = posterior.predict(Point(start.mean, start.nuisances))
    for row, own in zip(seen, alone, strict=True):
        assert torch.allclose(row[: own.prediction.shape[1]], own.prediction[0], atol=1e-3)
    gas_loss = Hypothesis(BASE, (LIBRARY["gas_loss"],), own_gels=True)
    held = fit_hypotheses(
        [Hypothesis(BASE, (LIBRARY["gas_loss"],))], null, two_gels, SIMULATOR, seed=0
    )["gas_loss"]
    moved = with_gels_of(held, start, gas_loss)
    place = held.prior.names.index("gas_loss")
    assert float(moved.mean[place]) == float(held.mean[place])
    assert float(moved.mean[held.prior.names.index("G")]) == float(start.mean[0])


def test_that_the_fit_of_a_curve_that_did_not_converge_is_continued(
    two_gels, null, monkeypatch
) -> None:
    one = ExperimentBatch(two_gels.experiments[1:2], two_gels.noise)
    (right,) = fit_alone(null, one, SIMULATOR, seed=0)
    short = SearchOptions(iterations=1)
    monkeypatch.setattr(own_gels, "assimilate", partial(assimilate, options=short))
    (curve,) = fit_alone(null, one, SIMULATOR, seed=0)
    assert curve.certificate.converged
    assert curve.cost == pytest.approx(right.cost, abs=1e-3)


def test_that_the_error_of_a_strength_is_with_the_differences_between_curves_held(
    two_gels, apart
) -> None:
    batch = Hypothesis(BASE, own_gels=True).seen(two_gels)
    line = linearise(apart, batch, SIMULATOR)
    count = len(two_gels.experiments)
    held = [
        i
        for i in range(line.fitted.shape[1])
        if i < 2 or (i - 2) // count < len(Posterior(BASE, batch, SIMULATOR).uncertain) - 2
    ]
    exact = torch.linalg.inv(line.fitted[:, held].mT @ line.fitted[:, held]).diagonal().sqrt()[:2]
    assert torch.allclose(additions.sds_of_strengths(apart), exact, rtol=1e-3)
    assert bool((additions.sds_of_strengths(apart) < 0.5 * apart.chol.norm(dim=1)).all())


@pytest.fixture(scope="module")
def selected(two_gels):
    effects = library(["gas_loss", "surface_tension"])
    report = diagnose(list(two_gels.experiments), effects=effects, simulator=SIMULATOR)
    gels = (STIFF, SOFT, {"G": 8e3, "mu": 0.09}, STIFF, SOFT)
    unseen = [shot(5 + number, gel) for number, gel in enumerate(gels)]
    return report, closed_by(report, SIMULATOR, unseen)[0]


def test_that_gels_that_differ_are_a_step_and_close_the_gap_on_curves_that_no_fit_saw(
    selected,
) -> None:
    """No effect of one gel does."""
    _, selection = selected
    base, only = selection.steps
    assert only.added == GEL_SCATTER
    assert only.effects == (GEL_SCATTER,)
    assert only.adequate
    assert only.converged
    assert only.misfit < 0.3 * base.misfit
    assert only.closed[1] > 0.9
    assert only.closed[0] > 0.5
    assert only.log_score[0] > 3.0 * only.log_score[1]
    assert str(selection).startswith("differences between curves close")


def test_that_a_report_of_curves_that_differ_sends_to_the_population(selected) -> None:
    report, selection = selected
    said = replace(report, verdict="other")
    assert "characterize --population" in next_step(said, Parts(selection=selection))
    assert "characterize --population" not in next_step(
        said, Parts(selection=replace(selection, steps=selection.steps[:1]))
    )
    assert "differences between curves: misfit" in describe(report, Parts(selection=selection))


def test_that_curves_and_steps_are_shown_where_no_cause_is_named(selected, tmp_path) -> None:
    report, selection = selected
    other = replace(report, verdict="other", cause=())
    parts = Parts(selection=selection)
    misfits = []
    for curve in to_json(other, parts, simulator=SIMULATOR)["curves"]:
        measured, sd, base, beside = (
            np.array(curve[name]) for name in ("R_star", "sd", "base", "with_additions")
        )
        misfits.append([np.square((measured - curve) / sd).mean() for curve in (base, beside)])
        assert curve["with_cause"] is None
        assert set(curve["drawn"]) == {"base", "with_additions"}
        t, drawn = (
            np.array(curve["drawn"]["with_additions"][name]) for name in ("t_star", "R_star")
        )
        error = np.abs(np.interp(curve["t_star"], t, drawn) - curve["with_additions"])
        assert np.quantile(error, 0.9) < 1e-3  # polygons are less exact at collapses
    before, after = np.mean(misfits, 0)
    assert after < 1.5
    assert before > 2.0
    text = write_page(other, tmp_path / "page.html", parts, simulator=SIMULATOR).read_text()
    assert "and the model with differences between curves;" in text
    assert re.search(r"<tr class=marked><td>differences between curves</td><td>0\.\d{4}</td>", text)
    assert "differences between curves: misfit" not in text
    assert "<tr><th>curve</th><th>G (kPa)</th><th>mu (Pa s)</th></tr>" in text
    values = [
        f"{1e-3 * value:.3g}"
        for value in values_of_curves(selection.best.fit, report.null.prior)["G"]
    ]
    assert re.findall(r"<tr><td>shot \d</td><td>([\d.]+)</td>", text) == values
    assert "Curve by curve" in describe(other, parts)
    assert "Curve by curve" not in text


def test_that_descents_of_a_held_out_curve_that_cannot_get_below_the_best_are_given_up(
    two_gels, apart, monkeypatch
) -> None:
    one = replace(ExperimentBatch((shot(3, STIFF),)), between=scatters(BASE, apart.prior))
    counts = []
    ends = []
    for promised in (
        float("inf"),
        0.0,
    ):  # nothing is given up; all that is not below the best at once
        linearised = []

        def counted(*arguments, made=linearised, **options):
            made.append(1)
            return linearise_at(*arguments, **options)

        monkeypatch.setattr(prediction, "linearise_at", counted)
        monkeypatch.setattr(prediction, "_PROMISED", promised)
        ends.append(held_out(apart, one, SIMULATOR))
        counts.append(len(linearised))
    assert counts[1] < counts[0]
    assert ends[1].square == pytest.approx(ends[0].square, rel=0.01)


def test_that_gels_that_differ_are_judged_on_curves_held_out_in_turn(selected) -> None:
    report, _ = selected
    step = closed_by(report, SIMULATOR)[0].steps[1]
    assert step.trained
    assert step.closed[1] > 0.8


def test_that_an_effect_of_one_gel_is_not_taken_for_differences_between_curves() -> None:
    shots = [shot(number, {"G": 8e3, "mu": 0.09, "gas_loss": 0.5}) for number in range(3)]
    report = diagnose(shots, effects=library(["gas_loss", "surface_tension"]), simulator=SIMULATOR)
    selection = closed_by(report, SIMULATOR)[0]
    assert [step.effects for step in selection.steps] == [(), ("gas_loss",)]
    assert selection.steps[1].adequate


def test_that_an_effect_whose_strength_differs_between_curves_is_told_with_them() -> None:
    shots = [
        shot(number, {"G": 8e3, "mu": 0.09, "gas_loss": loss})
        for number, loss in enumerate((0.3, 0.9, 0.5))
    ]
    report = diagnose(shots, effects=library(["gas_loss", "surface_tension"]), simulator=SIMULATOR)
    selection = closed_by(report, SIMULATOR)[0]
    last = selection.steps[-1]
    assert last.effects == ("gas_loss", GEL_SCATTER)
    assert last.adequate
    found = values_of_curves(last.fit, BASE)
    assert set(found) == {"G", "mu", "gas_loss"}
    assert found["gas_loss"] == pytest.approx([0.3, 0.9, 0.5], rel=0.3)
    unusual = unusual_strengths(
        last.fit, BASE
    )  # .9 is 4.5 standard deviations of its prior from 0, of which half is cut off
    assert unusual["gas_loss"] == pytest.approx(4.35, abs=0.5)
    text = describe(report, Parts(selection=selection))
    assert "Curve by curve, with gas_loss and differences between curves: G (kPa) 8" in text
    assert "gas_loss is 4 standard deviations of its prior from what is usual" in text
    (document,) = selection_document(selection)[-1:]
    assert document["curves"] == found
    assert document["unusual"] == unusual


def test_that_repeats_and_a_single_curve_are_not_asked(two_gels, null) -> None:
    inquiry = Inquiry(BASE, (), two_gels, SIMULATOR)
    twice = tuple(
        Experiment(e.label, e.design, e.times, e.radius.expand(2, -1), e.nuisance)
        for e in two_gels.experiments
    )
    for experiments in (two_gels.experiments[:1], twice):
        other = Inquiry(BASE, (), ExperimentBatch(experiments, two_gels.noise), SIMULATOR)
        assert additions.longer_by_one(other, Hypothesis(BASE)) == []
    (longer,) = additions.longer_by_one(inquiry, Hypothesis(BASE))
    assert longer.own_gels
