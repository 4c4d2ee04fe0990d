"""A diagnosis in words, as JSON and as a page:

every part that was run is there, and what was not is said.
"""

import base64
import io
import json
import math
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.image import imread

import imr_torch.gap.parts
from imr_torch.gap import (
    GapReport,
    Parts,
    describe,
    diagnose,
    examine,
    library,
    plots,
    to_json,
    write_page,
)
from imr_torch.gap.report import repeats_needed, sections
from imr_torch.material import PARAMETERS
from imr_torch.observe import SimulatedLaboratory
from imr_torch.results import draw_figures, for_publication
from imr_torch.simulate import PolytropicSimulator
from tests.figures import rendering

FOUND = (
    "gap",
    "p_gap",
    "bias_sigma",
    "verdict",
    "cause",
    "converged",
    "seconds",
    "parameters",
    "headline",
    "next_step",
    "tests",
    "curves",
    "noise",
    "noise_interval",
    "noise_factors",
    "frames_left_out",
    "members",
    "expected_loss",
    "verdict_odds",
    "certificates",
)
PARTS = (
    "first_detected_t",
    "first_detected_phase",
    "acts",
    "shrinkage",
    "best_rival",
    "ladder",
    "ladder_ended",
    "ladder_differing",
    "ladder_unsettled",
    "gel_scatter",
    "next_design",
)
CAUSES = (
    "posterior",
    "explained_nats",
    "unconverged",
    "posterior_at_odds",
    "unknown",
    "look_alikes",
    "evidence_checks",
    "prior_scales",
    "credible_set",
    "adequacy_p",
    "parameter_shift",
    "cause_values",
)
BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


@pytest.fixture(scope="module")
def found() -> tuple[GapReport, Parts]:
    """A gel in a liquid whose speed of sound differs, diagnosed with three effects to choose from."""
    simulator = PolytropicSimulator()
    times = torch.linspace(0.0, 2.6, 53, dtype=torch.float64)
    gel = PARAMETERS.pack({"G": 8e3, "mu": 0.08, "sound_speed": 0.5})
    laboratory = SimulatedLaboratory(simulator, gel, repeats=10, times=times)
    designs = torch.tensor([[200.0, 0.2], [600.0, 0.17]], dtype=torch.float64)
    experiments = [laboratory.shoot(design, seed=i) for i, design in enumerate(designs)]
    report = diagnose(
        experiments,
        effects=library(("sound_speed", "rinf_bias", "refraction")),
        simulator=simulator,
    )
    return report, examine(report, simulator)


@pytest.fixture(scope="module")
def page(found, tmp_path_factory) -> Path:
    report, parts = found
    with rendering():
        return write_page(
            report, tmp_path_factory.mktemp("page") / "page.html", parts, title="A < B"
        )


def test_that_json_has_the_agreed_keys_and_what_was_found(found):
    report, parts = found
    document = to_json(report, parts)
    assert set(document) == {*FOUND, *PARTS, *CAUSES}
    assert document["gap"] is True
    assert document["verdict"] == "effect"
    assert document["cause"] == ["sound_speed"]
    assert document["first_detected_phase"] in ("first collapse", "first rebound")
    assert max(document["acts"], key=lambda phase: document["acts"][phase][1]) in (
        "first collapse",
        "first rebound",
        "second collapse",
    )
    assert sum(middle for _, middle, _ in document["acts"].values()) == pytest.approx(1.0, abs=0.1)
    assert set(document["posterior_at_odds"]) == {"1:9", "1:1"}
    assert document["posterior"] == document["posterior_at_odds"][document["verdict_odds"]]
    assert document["posterior_at_odds"]["1:9"]["other"] <= document["posterior"]["other"]
    assert 0.0 <= document["unknown"]["chance_look_alike"] <= 1.0
    assert set(document["certificates"]) == {"none", "sound_speed"}
    assert sum(document["posterior"].values()) == pytest.approx(1.0)
    assert {"none", "other"} <= set(document["posterior"])
    low, median, high = document["shrinkage"]["sound_speed"]
    assert 0.5 < low <= median <= high
    assert document["best_rival"] in document["shrinkage"]
    shift = document["parameter_shift"]["mu"]
    assert shift["base"][1] < 0.07 < shift["with_cause"][0] < 0.08 < shift["with_cause"][2]


@pytest.mark.parametrize(
    ("p", "words"),
    [(1e-3, "moving window, G, mu change over"), (0.5, "no parameter changes over the event")],
)
def test_that_windows_say_what_changes_or_that_nothing_does(found, p, words):
    report, parts = found
    windows = replace(parts.windows, p_constant=torch.full_like(parts.windows.p_constant, p))
    assert words in describe(report, replace(parts, windows=windows))


def test_that_parts_that_were_not_run_are_null_and_said_to_be_missing(found):
    report, _ = found
    assert {key for key, value in to_json(report).items() if value is None} == set(PARTS)
    document = to_json(replace(report, attribution=None, adequacy_p=None, verdict="none", cause=()))
    assert set(document) == {*FOUND, *PARTS, *CAUSES}
    assert {key for key, value in document.items() if value is None} == {*PARTS, *CAUSES}
    assert "no shrinkage on held-out designs was computed" in describe(report)


def test_that_the_words_name_the_cause_the_onset_the_rival_and_the_shift(found):
    report, parts = found
    text = describe(report, parts)
    assert "its cause is sound_speed (the speed of sound differs)" in text
    assert str(parts.onset) in text
    assert str(parts.acts) in text
    assert "at prior odds 1:1 of an unknown effect, on which the verdict is based" in text
    assert "with 0.5 times the prior scales" in text
    assert f"{parts.shrinkage.rival} (the best rival) removes" in text
    assert re.search(r"mu \(Pa s\): 0\.0[456]\d* becomes 0\.0[78]\d*", text)


def test_that_page_json_and_words_state_the_value_of_the_cause(found, page):
    report, parts = found
    low, middle, high = to_json(report, parts)["cause_values"]["sound_speed"]["sound_speed"]
    assert low < 0.5 < high
    sentence = f"{middle:.4g} (90 %: {low:.4g} to {high:.4g})"
    assert sentence in describe(report, parts)
    assert page.read_text().count(sentence) == 2  # in the verdict and in the table of the gel
    values = to_json(report, parts)["parameters"]
    assert values["mu"] == to_json(report, parts)["parameter_shift"]["mu"]["with_cause"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "Shoot We = "),
        ({"verdict": "none", "cause": ()}, "Use the base model with its intervals"),
        ({"verdict": "other", "cause": ()}, "Do not use the parameters"),
        ({"verdict": "undecided", "cause": ()}, "these do not decide"),
        ({"verdict": "class", "cause": ("a", "b")}, "Measure a, b by other means"),
        ({"verdict": "effect"}, "Use the parameters of the model with sound_speed added"),
    ],
)
def test_that_a_diagnosis_ends_with_one_sentence_on_what_to_do(found, changes, words):
    report, parts = found
    design = parts if not changes else Parts()
    if not changes and parts.next_design is None:
        words = "Use the parameters of the model with sound_speed added"
    text = describe(replace(report, **changes), design)
    assert "easily mistaken" not in text
    last = text.splitlines()[-2:]
    assert last[0] == "What to do next"
    assert words in last[1]
    assert last[1].count(". ") == 0


def test_that_the_next_shot_is_planned_as_the_data_were_and_says_what_it_is_worth(
    found, monkeypatch
):
    report, parts = found
    assert parts.next_design is None  # the cause is sure
    monkeypatch.setattr(imr_torch.gap.parts, "_SURE", 1.0)
    ahead = imr_torch.gap.parts._next(report, PolytropicSimulator(), 0, None)
    parts = replace(parts, next_design=ahead)
    assert ahead is not None
    assert (ahead.plan.repeats, len(ahead.plan.times), float(ahead.plan.times[-1])) == (
        10,
        53,
        pytest.approx(2.6),
    )
    document = to_json(report, parts)["next_design"]
    assert document["p_truth_now"] == ahead.now
    assert document["p_truth_after"] == ahead.after
    text = describe(report, parts)
    assert f"{ahead.after:.2f} +- {ahead.after_error:.2f} after the shot" in text
    assert "repeats: 10, frames: 53 to t* = 2.60" in text
    useless = replace(parts, next_design=replace(ahead, after=ahead.now + ahead.after_error))
    assert "no design helps" in describe(report, useless)
    assert "Shoot We" not in describe(report, useless)


def test_that_sections_with_nothing_to_say_are_folded(found):
    report, _ = found
    silent = replace(report, attribution=None, adequacy_p=None, verdict="none", cause=())
    folded = {s.heading for s in sections(silent) if s.folded}
    assert {
        "Where does it lie?",
        "Which effect causes it?",
        "How far does it shrink?",
        "What to measure next?",
    } <= folded
    assert {s.heading for s in sections(silent) if not s.folded} == {"Verdict", "Is there a gap?"}


def test_that_no_family_is_named_for_other(found):
    report, _ = found
    text = describe(replace(report, verdict="other", cause=()))
    assert "no effect of the library that was offered explains it" in text
    assert "What kind of effect it is" in text
    assert "do not quote them" in text


def test_that_fits_that_were_given_up_are_told_from_those_that_did_not_converge(found):
    report, _ = found
    causes = report.attribution
    best = causes.fits["sound_speed"].cost
    fits = dict(causes.fits)
    for name, behind in (("refraction", 50.0), ("rinf_bias", 5.0)):
        loose = replace(fits[name].certificate, converged=False, gradient=0.1)
        fits[name] = replace(fits[name], cost=best + behind, certificate=loose)
    changed = replace(causes, fits=fits)
    assert changed.given_up == ("refraction",)
    assert set(changed.unconverged) == {"refraction", "rinf_bias"}
    text = describe(replace(report, attribution=changed))
    assert (
        "given up, since by their costs and gradients they cannot come near that of sound_speed: refraction."
        in text
    )
    assert "did not converge, so that their probabilities are lower bounds: rinf_bias." in text
    assert re.search(
        r"Log evidence gained by a single further effect, nats: sound_speed \d+, .*refraction -?\d+ or more",
        text,
    )


def test_that_what_effects_explain_is_drawn_where_their_probabilities_are_zero(found):
    report, _ = found
    causes = report.attribution
    gained = causes.explained
    assert gained["sound_speed"] == causes.log_evidence["sound_speed"] - causes.log_evidence["none"]
    assert next(iter(gained)) == "sound_speed"
    assert set(gained) == set(causes.fits) - {"none"}
    document = json.loads(json.dumps(to_json(*found)))
    labels = []
    for other in (0.5, 1.0):
        document["posterior"] = {"other": other, "sound_speed": 1.0 - other}
        (drawn,) = (figure for figure in draw_figures(document) if figure.name == "causes")
        labels.append(for_publication(drawn.draw, "one").axes[0].get_xlabel())
    assert labels == ["probability", "log evidence gained (nats)"]
    plt.close("all")


def test_that_nothing_is_said_on_a_fit_that_did_not_converge(found):
    report, _ = found
    loose = replace(
        report.null, certificate=replace(report.null.certificate, converged=False, gradient=1.0)
    )
    undecided = replace(
        report, null=loose, attribution=None, verdict="undecided", cause=(), reason="Loose."
    )
    assert "an unconverged fit looks exactly like a gap" in describe(undecided)
    assert to_json(undecided)["gap"] is False
    assert examine(undecided, PolytropicSimulator()) == Parts()


def test_that_a_hidden_effect_comes_with_the_repeats_it_would_take(found):
    report, _ = found
    blocks = tuple(
        replace(b, power=0.3) if b.name == "refraction" else b for b in report.gap.blocks
    )
    text = describe(replace(report, gap=replace(report.gap, blocks=blocks)))
    assert re.search(r"refraction \(power 0\.30; about \d+ x the repeats would show it\)", text)
    blocks = tuple(
        replace(b, power=0.01) if b.name in ("refraction", "rinf_bias") else b for b in blocks
    )
    text = describe(replace(report, gap=replace(report.gap, blocks=blocks)))
    assert re.search(
        r"(refraction, rinf_bias|rinf_bias, refraction) \(more than \d+ x the repeats\)", text
    )


def test_that_repeats_needed_follow_the_normal_approximation_of_a_two_sided_test():
    def z(p: float) -> float:
        return -float(torch.special.ndtri(torch.tensor(p, dtype=torch.float64)))

    expected = ((z(0.001) + z(1.0 - 0.8)) / (z(0.001) + z(1.0 - 0.4))) ** 2
    assert repeats_needed(0.4, 1, 20) == pytest.approx(expected, rel=1e-3)
    assert repeats_needed(0.8, 3, 20) == pytest.approx(1.0)


def test_that_the_phase_map_shows_a_residual_where_it_is(found):
    report, _ = found
    fit = report.null
    batch = report.batch
    noise = batch.sd(batch.mean) / batch.counts.sqrt()
    moved = batch.mean.clone()
    moved[1] -= 3.0 * noise[1]
    values = plots.phase_rms(replace(fit, prediction=moved), batch)
    assert torch.allclose(values[0].nan_to_num(), torch.zeros(5, dtype=torch.float64))
    assert torch.allclose(
        values[1], torch.full_like(values[1], 3.0), rtol=0.15
    )  # sd is taken at the prediction


def test_that_every_plot_draws_into_the_axes_it_is_given(found):
    report, parts = found
    fit = report.null
    batch = report.batch
    after = report.attribution.fits["sound_speed"]
    draws = (
        lambda ax: plots.plot_phase_residual(fit, batch, ax=ax),
        lambda ax: plots.plot_scores(report.gap, ax=ax),
        lambda ax: plots.plot_onset(parts.onset, ax=ax),
        lambda ax: plots.plot_latent_pressure(parts.latent, ax=ax),
        lambda ax: plots.plot_window_parameter(parts.windows, "G", ax=ax),
        lambda ax: plots.plot_causes(report.attribution.posterior, ax=ax),
        lambda ax: plots.plot_explained(report.attribution.explained, ["refraction"], ax=ax),
        lambda ax: plots.plot_curves(batch, 0, fit.prediction, after.prediction, ax=ax),
        lambda ax: plots.plot_residuals(batch, 0, fit.prediction, after.prediction, ax=ax),
        lambda ax: plots.plot_shrinkage(parts.shrinkage, ax=ax),
        lambda ax: plots.plot_shift(fit, after, ax=ax),
    )
    for draw in draws:
        ax: Axes = plt.subplots()[1]
        assert draw(ax) is ax
        assert ax.has_data()
        plt.close(ax.figure)


def test_that_the_figures_of_a_document_hold_its_steps_with_what_each_closes(found):
    document = json.loads(json.dumps(to_json(*found)))
    figures = {figure.name: figure for figure in draw_figures(document)}
    assert {"tests", "causes", "effects_together"} <= set(figures)
    (ax,) = for_publication(figures["effects_together"].draw, "one").axes
    assert [label.get_text() for label in ax.get_yticklabels()] == ["base model", "+ sound_speed"]
    closed = document["ladder"][1]["closed"][1]
    assert f"closes {closed:.2f}" in ax.texts[1].get_text()
    plt.close("all")


class _Reader(HTMLParser):
    def __init__(self):
        super().__init__()
        self.images = []
        self.headings = []
        self.links = []
        self.open = []

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.links += [attributes[key] for key in ("src", "href") if key in attributes]
        if tag == "img":
            self.images.append(attributes)
        if re.fullmatch(r"h\d", tag):
            self.headings.append(tag)
        if tag not in ("img", "meta", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def read(page: Path) -> _Reader:
    reader = _Reader()
    reader.feed(page.read_text())
    assert reader.open == []
    return reader


def test_that_the_page_is_one_file_with_every_figure_decodable_and_described(page):
    reader = read(page)
    assert all(link.startswith("data:") for link in reader.links)
    assert len(reader.images) == 12
    for image in reader.images:
        pixels = imread(
            io.BytesIO(base64.b64decode(image["src"].removeprefix("data:image/png;base64,")))
        )
        assert min(pixels.shape[:2]) > 100
        assert len(image["alt"]) > 20


def test_that_the_page_has_the_sections_of_the_words_in_order(found, page):
    report, parts = found
    text = page.read_text()
    shown = [s.heading for s in sections(report, parts)[1:] if not s.folded]
    folded = [s.heading for s in sections(report, parts) if s.folded]
    assert read(page).headings == ["h1"] + ["h2"] * (
        len(shown) + 3
    )  # the gel, the curves, what to do next
    places = [
        text.index(f"<h2>{heading}</h2>")
        for heading in ("The gel", "The curves", *shown, "What to do next")
    ]
    places += [text.index(f"<details><summary>{heading}</summary>") for heading in folded]
    assert places == sorted(places)
    assert "<h1>A &lt; B</h1>" in text


def test_that_a_page_without_parts_has_the_figures_of_the_diagnosis_alone(found, tmp_path):
    report, _ = found
    silent = replace(report, attribution=None, verdict="none", cause=())
    assert len(read(write_page(silent, tmp_path / "page.html")).images) == 4


def test_that_figures_do_not_stay_open(found, tmp_path):
    before = plt.get_fignums()
    write_page(found[0], tmp_path / "page.html", found[1])
    assert plt.get_fignums() == before


@pytest.mark.skipif(BROWSER is None, reason="no Chromium here to open the page in")
def test_that_a_browser_draws_every_figure_without_a_complaint(page, tmp_path):
    probe = "<script>addEventListener('load', () => {for (const i of document.images) i.dataset.width = i.naturalWidth})</script>"
    copy = tmp_path / "probe.html"
    copy.write_text(page.read_text().replace("</body>", f"{probe}</body>"))
    options = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--enable-logging=stderr",
        f"--user-data-dir={tmp_path / 'profile'}",
    ]
    done = subprocess.run(
        [BROWSER, *options, "--dump-dom", copy.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
    )
    widths = re.findall(r'data-width="(\d+)"', done.stdout)
    assert len(widths) == 12
    assert all(int(width) > 100 for width in widths)
    assert "CONSOLE" not in done.stderr


def test_that_an_unstarted_nan_power_is_not_printed(found):
    assert "nan" not in describe(*found)
    assert any(math.isnan(b.power) for b in found[0].gap.blocks)
