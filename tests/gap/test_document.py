"""The document of a diagnosis, and what is made of it alone: words, figures and page, which agree."""

import base64
import io
import json
import math
import re
import sys
from xml.etree import ElementTree

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.image import imread

from imr_torch.errors import ConvergenceError
from imr_torch.float64 import linspace, tensor
from imr_torch.gap import MediumSensitivity, describe, examine, to_json
from imr_torch.gap.document import _fill_template, sections, title
from imr_torch.gap.figures import gap_figures, plot_intervals
from imr_torch.material import LIBRARY, PARAMETERS
from imr_torch.observe import SimulatedLaboratory
from imr_torch.results import document_page, draw_figures, write_page
from tests.figures import rendering
from tests.gap.synthetic import SIMULATOR, diagnose_offered

OFFERED = ("sound_speed", "rinf_bias", "refraction")


def shots(effect: dict[str, float], repeats: int, stiffness: tuple[float, ...]):
    """Shots of gels with an effect, one a stiffness."""
    times = linspace(0.0, 2.6, 53)
    made = []
    for number, stiff in enumerate(stiffness):
        gel = PARAMETERS.pack({"G": stiff, "mu": 0.08} | effect)
        laboratory = SimulatedLaboratory(SIMULATOR, gel, repeats=repeats, times=times)
        design = tensor([200.0 + 200.0 * number, 0.2 - 0.015 * number])
        made.append(laboratory.shoot(design, seed=number, label=f"shot {number}"))
    return made


def document_of(experiments, offered=OFFERED) -> dict:
    report = diagnose_offered(experiments, offered)
    made = to_json(report, examine(report, SIMULATOR), simulator=SIMULATOR)
    return json.loads(json.dumps(made, allow_nan=False))


@pytest.fixture(scope="module")
def documents():
    """Diagnoses of each kind of answer."""
    slower = {"sound_speed": 0.5}
    return {
        "named": document_of(shots(slower, 10, (8e3, 8e3, 8e3))),
        "other": document_of(shots(slower, 10, (8e3, 8e3, 8e3)), OFFERED[1:]),
        "none": document_of(shots({}, 5, (8e3, 8e3))),
        "differ": document_of(shots({}, 1, (6e3, 11e3, 8e3))),
        "one shot": document_of(shots(slower, 10, (8e3,))),
    }


def test_that_every_kind_of_answer_is_among_them(documents):
    assert documents["named"]["cause"] == ["sound_speed"]
    assert documents["other"]["verdict"] == "other"
    assert documents["none"]["verdict"] == "none"
    assert documents["differ"]["cause"] == ["gel_scatter"]
    assert documents["one shot"]["gap"]


def test_that_probabilities_and_numbers_are_consistent(documents):
    for document in documents.values():
        if document["posterior"] is not None:
            assert sum(document["posterior"].values()) == pytest.approx(1.0)
            assert set(document["members"]) <= set(document["posterior"])
        for name, (low, middle, high) in document["parameters"].items():
            assert low < middle < high
            wide = document["parameters_with_model_error"][name]
            assert wide[0] < wide[1] < wide[2]
        for curve in document["curves"]:
            assert len(curve["t_star"]) == len(curve["R_star"]) == len(curve["base"])


ANSWERS = {
    "effect": ("effect", ["sound_speed"], {"sound_speed": 0.97}),
    "effect or unknown": ("effect", ["sound_speed"], {"sound_speed": 0.8, "other": 0.17}),
    "two effects": ("effect", ["clock", "wall"], {"clock+wall": 0.98}),
    "gels": ("effect", ["gel_scatter"], {"gel_scatter": 0.99}),
    "gels and effect": ("effect", ["clock", "gel_scatter"], {"clock+gel_scatter": 0.95}),
    "class": ("class", ["wall", "damage"], {"wall": 0.5, "damage": 0.45}),
    "class or unknown": (
        "class",
        ["wall", "clock"],
        {"wall": 0.4, "clock": 0.4, "other": 0.2},
    ),
    "other": ("other", [], {"other": 0.98}),
    "other or nothing": ("other", [], {"other": 0.58, "none": 0.25}),
    "other or nothing more": ("other", [], {"other": 0.52, "none": 0.35}),
    "other or blur": ("other", [], {"other": 0.6, "exposure_blur": 0.3}),
    "slow noise": ("other", [], {"slow_noise": 0.6, "other": 0.35}),
    "undecided": ("undecided", ["wall"], {"wall": 0.5, "none": 0.3, "other": 0.15}),
    "nobody": ("undecided", [], {"none": 0.5, "other": 0.45}),
}
"""Verdict, cause and members of a document."""
SHARED = {
    "closed": {"share": [0.8, 0.9, 0.95], "later": [0.7, 0.9, 1.0], "word": "closed"},
    "partly": {"share": [0.1, 0.4, 0.6], "later": None, "word": "partly closed"},
    "by chance": {
        "share": [0.3, 0.6, 0.8],
        "later": [-1.5, -0.3, 0.1],
        "word": "partly closed, not told from chance",
    },
    "not": {"share": [-1.0, -0.2, 0.3], "later": None, "word": "not closed"},
    "no gap": {
        "share": None,
        "later": None,
        "word": "no gap left",
        "placebo_median": None,
        "placebo_95": None,
        "placebos": 0,
    },
}
"""Shrinkage of a document, beside what it holds of placebos."""


def answered(document: dict, answer: str, shared: str, *, helps: bool | None) -> dict:
    """A document as a diagnosis with another answer makes it."""
    verdict, cause, members = ANSWERS[answer]
    named = verdict in ("effect", "class")
    beside = verdict == "other" and answer != "other or nothing"
    parts = next(iter(members)).split("+") if named else ["sound_speed"]
    shrinkage = document["shrinkage"] | SHARED[shared] | {"selected": [parts, parts]}
    ahead = None
    if helps is not None:
        ahead = {
            "We": 300.0,
            "R_inf*": 0.2,
            "gain": 0.3,
            "gain_sd": 0.05,
            "entropy": 0.6,
            "tells_apart": ["wall", "damage"],
            "p_truth_now": 0.5,
            "p_truth_after": 0.8,
            "p_truth_after_sd": 0.01,
            "helps": helps,
            "plan": dict.fromkeys(
                ("end_t", "max_radius_sd", "time_zero_sd", "rest_radius_sd"), 1.0
            )
            | {"repeats": 1, "frames": 80},
        }
    made = document | {
        "verdict": verdict,
        "cause": cause,
        "members": members,
        # another verdict rests on what was asked about beside the parts that were selected
        "posterior": {"other": 1.0} if beside else members,
        "members_held": parts if beside else document["held"],
        "selected": parts,
        "given_up": [*parts, "refraction"],
        "shrinkage": None if parts == ["gel_scatter"] else shrinkage,
        "next_design": ahead,
        "parameter_shift": document["parameter_shift"] if named else None,
        "cause_values": document["cause_values"]
        if cause == ["sound_speed"] and named
        else None,
        "gels": {"G": [6e3, 8e3, 11e3]} if "gel_scatter" in parts else None,
        "missing": None if named else document["missing"],
    }
    words = {"headline": "diagnosis_headline.txt", "next_step": "diagnosis_next_step.txt"}
    return made | {key: _fill_template(name, made) for key, name in words.items()}


def contradictions(document: dict) -> list[str]:
    """What headline, sentences and values of a document say against each other."""
    text = describe(document)
    quote = text.splitlines()[-1].strip()
    head, _, nearest = document["headline"].partition("; nearest comes")
    cause = document["cause"]
    members = document["members"] or {}
    verdict = document["verdict"]
    named = verdict in ("effect", "class")
    doubted = verdict == "other" and "none" in members and not document["members_held"]
    titles = {name: title(name) for name in (*LIBRARY, "gel_scatter")}
    in_head = {name for name, words in titles.items() if words in head}
    likely = {part for name in members for part in name.split("+")} & set(titles)
    if verdict == "other" and "none" in members:
        likely |= set(document["members_held"])
    shrunk = document["shrinkage"]
    found = {
        "a number that is none": re.search(r"\b(nan|inf)\b", text) is not None
        or not _all_finite(document),
        "a gap and none": ("There is a gap" in head)
        != (verdict in ("effect", "class", "other") and not doubted)
        or ("There may be a gap" in head) != doubted
        or doubted != (f"nothing is missing (probability {members.get('none')})" in head)
        or ("No gap was found" in text) != (verdict == "none")
        or (verdict == "none" and (document["gap"] or bool(cause) or shrunk is not None)),
        "what is nearest is not said, or is beside a cause": (
            {name for name, words in titles.items() if words in nearest}
            != (set(document["selected"]) if verdict == "other" else set())
        ),
        "the headline names another cause": bool(in_head - likely - set(cause)),
        "the headline lacks a cause": verdict != "other" and not set(cause) <= in_head,
        "other has a cause": verdict == "other" and bool(cause),
        "a named cause and no effect that explains": named
        and "no effect of the library" in text,
        "a named cause changes no parameter": named
        and "so the parameters do not change" in text.lower(),
        "an unknown effect is not said": named
        and ("other" in members)
        != (
            f"unknown effect that looks like it (probability {members.get('other', 0):.2f})"
            in head
        ),
        "a probability behind the headline is not printed": verdict == "other"
        and any(f"{name} {p:.3f}" not in text for name, p in members.items())
        and len(members) > 1,
        "a likely effect beside other is not said": verdict == "other"
        and "slow_noise" not in members
        and in_head != likely,
        "something is missing beside a named cause": named
        and document["missing"] is not None,
        "what is missing is not said": verdict == "other"
        and document["missing"] is not None
        and "better than the base model" not in text
        and "explains it" not in text,
        "closed by what is not named": "the gap is closed" in text and verdict == "other",
        "a shot that is not designed": ("Shoot We" in document["next_step"])
        != bool(document["next_design"] and document["next_design"]["helps"]),
        "what was selected is given up": bool(
            set(
                re.findall(
                    r"[\w+]+", "".join(re.findall(r"were given up.* of [^:]*:(.*)", text))
                )
            )
            & set(document["selected"])
        ),
        "nothing is said of what to quote": not quote.startswith("Quote ")
        or text.count(quote) != 2,
        "a gap without a cause is said too surely": verdict == "other"
        and re.search(r" becomes | is \S+ (kPa|Pa s) \(", text) is not None,
        "a cause is certain": named and "most probable cause" not in head,
        "an interval outside the other is not explained": (
            "need not contain the first" in text
        )
        != any(
            low < document["parameters_with_model_error"][name][0]
            or high > document["parameters_with_model_error"][name][2]
            for name, (low, _, high) in document["parameters"].items()
        ),
        "a wrong model is quoted": quote.startswith("Quote for")
        and (
            verdict in ("other", "class")
            or (verdict == "undecided" and document["test_rejects"])
        ),
        "a right model is not quoted": not quote.startswith("Quote for")
        and (verdict == "none" or (verdict == "effect" and "gel_scatter" not in cause)),
        "one gel is quoted though they differ": cause == ["gel_scatter"]
        and verdict == "effect"
        and "Use the parameters" in document["next_step"],
    }
    if shrunk is not None:
        later = shrunk["later"] or [1.0]
        found["a forecast reaches zero in silence"] = (later[0] < 0.0 < later[-1]) != (
            "which may as well be no change" in text
        )
        closes = [
            line
            for line in text.splitlines()
            if "what was selected from the other curves" in line
        ]
        found["no gap is left, and some is closed"] = (shrunk["share"] is None) == bool(
            closes
        )
        found["shrinkage is another in words"] = any(
            f"the gap is {shrunk['word']}: what" not in line
            or f"removes {shrunk['share'][1]:.2f} (" not in line
            or not all(
                titles[part] in line for parts in shrunk["selected"] for part in parts
            )
            for line in closes
        )
    for name, values in document["parameters"].items():
        said = PARAMETERS[name].interval(*values)
        unit = PARAMETERS[name].display_unit or PARAMETERS[name].unit
        found[f"{name} without its unit"] = f"{unit} (" not in said
        missed = document["gap"] and verdict != "effect"
        told = f"{name} {'would be' if missed else 'is'} {said}"
        found[f"{name} is another in words"] = told not in text
    for row in document["hidden"]:
        effect = row["effect"]
        entry = PARAMETERS[LIBRARY[effect].names[0]]
        lines = re.findall(rf"\({effect}\): (.*) would be found", text)
        size = rf"none of a usual size|[\d.e-]+ ?{re.escape(entry.shown_unit)}( .*)? \(.+\)"
        found[f"{effect} hides without its unit"] = any(
            not re.fullmatch(size, x) for x in lines
        )
        found[f"{effect} hides beside a gap without a cause"] = (
            bool(lines) and verdict == "other"
        )
    return [what for what, holds in found.items() if holds]


def _all_finite(value: object) -> bool:
    if isinstance(value, dict):
        return all(map(_all_finite, value.values()))
    if isinstance(value, list):
        return all(map(_all_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def test_that_headline_sections_and_values_of_a_diagnosis_agree(documents):
    for name, document in documents.items():
        assert contradictions(document) == [], name
        text = describe(document)
        assert re.search(r"[a-z]_[0-9a-f]{8}", text) is None


# a gap that is closed leaves an adequate fit, and is not called other
POSSIBLE = [
    (a, s) for a in ANSWERS for s in SHARED if (ANSWERS[a][0], s) != ("other", "closed")
]


@pytest.mark.parametrize(("answer", "shared"), POSSIBLE)
@pytest.mark.parametrize("helps", [None, True, False])
def test_that_they_agree_whatever_the_answer(documents, answer, shared, helps):
    document = answered(documents["named"], answer, shared, helps=helps)
    assert contradictions(document) == []


def test_that_a_named_cause_closes_the_gap_and_one_shot_says_why_nothing_is_judged(
    documents,
):
    named = documents["named"]["shrinkage"]
    assert named["word"] == "closed"
    assert named["share"][0] > named["placebo_95"]
    assert named["selected"] == [["sound_speed"]] * 3
    assert (
        "what was selected from the other curves (the speed of sound differs (sound_speed)) removes"
        in describe(documents["named"])
    )
    assert documents["one shot"]["shrinkage"] is None
    assert not any(
        "all experiments" in test["name"] for test in documents["one shot"]["tests"]
    )
    assert "give two curves or more" in describe(documents["one shot"])
    assert "no effect was selected" in describe(documents["differ"])


def test_that_what_these_data_would_not_show_stands_beside_every_verdict(documents):
    for document in documents.values():
        lines = describe(document).count(" would be found; ")
        assert lines == (0 if document["verdict"] == "other" else len(document["hidden"]))
    assert {row["effect"] for row in documents["none"]["hidden"]} == set(OFFERED)


def test_that_values_are_in_units_of_a_laboratory(documents):
    field = {"sound_frequency": [1.5, 1.57, 1.6], "sound_phase": [0.0, 0.2, 0.4]}
    moved = {"density": {"base": [-0.1, 0.0, 0.1], "with_cause": [-0.1, 0.01, 0.1]}}
    assert all(
        1e-5 < curve["time_scale_s"] < 1e-4 for curve in documents["named"]["curves"]
    )
    text = describe(
        documents["named"]
        | {"cause_values": {"sound_field": field}, "parameter_shift": moved}
        | {"curves": [{"time_scale_s": 2e-5}]}
        | {"medium": {"density": {"value": 1060.0, "unit": "kg/m^3"}}}
    )
    assert (
        f"frequency is {math.exp(1.57) / (2 * math.pi * 2e-5) / 1e3:.4g} kHz in the" in text
    )
    assert "its phase is 0.2 rad (90 %: 0 to 0.4)" in text
    assert "density: 1060 kg/m^3 becomes 1071 kg/m^3 (90 %: 959.1 to 1171)" in text


def test_that_gels_that_differ_are_listed_shot_by_shot(documents):
    gels = documents["differ"]["gels"]
    assert gels["G"] == pytest.approx([6e3, 11e3, 8e3], rel=0.15)
    assert "G of each shot:" in describe(documents["differ"])
    assert "characterize --population" in documents["differ"]["next_step"]
    assert documents["named"]["gels"] is None


def test_that_text_and_page_begin_and_end_with_what_to_quote(documents):
    moves = (("far_field_pressure", "101 kPa", 2.1), ("sound_speed", "1430 m/s", 0.9))
    found = [
        MediumSensitivity(n, x, 1.02, {"G": -0.1}, {"G": -sd}).to_dict()
        for n, x, sd in moves
    ]
    medium = {"medium_unstated": "Not stated: density.", "medium_sentence": "M."}
    for name, document in documents.items():
        unstated = document | medium | {"medium_sensitivities": found}
        last = describe(unstated).splitlines()[-1].strip()
        page = document_page(unstated).partition("<section>")[0]
        assert last in page
        assert "Not stated: density." in page
        for said in (
            "density was not",
            "for the assumed pressure 101 kPa;",
            "the model may lack)",
        ):
            assert (said in last) is last.startswith("Quote for")
        assert ("does not explain these curves" in describe(document)) is (
            document["gap"] and document["verdict"] != "effect"
        ), name


def test_that_titles_are_words_with_the_code_name_behind():
    assert title("gel_scatter") == "the gel differs between shots"
    assert title("clock+wall").count(" and ") == 1
    assert all(title(name).endswith(f"({name})") for name in LIBRARY)


def test_that_drawn_curves_pass_through_the_predictions(documents):
    for curve in documents["named"]["curves"]:
        for name in ("base", "selected"):
            drawn = curve["drawn"][name]
            t, r = (np.array(drawn[key], dtype=float) for key in ("t_star", "R_star"))
            known = np.isfinite(r)
            error = np.abs(np.interp(curve["t_star"], t[known], r[known]) - curve[name])
            assert np.quantile(error, 0.9) < 1e-3  # polygons are less exact at collapses


def test_that_every_figure_of_a_document_is_drawn_by_plot_too(documents):
    for document in documents.values():
        with rendering():
            names = [figure.name for figure in gap_figures(document)]
            drawn = draw_figures(document)
            assert [figure.name for figure in drawn] == names
            for figure in drawn:
                made = figure.draw()
                assert all(ax.has_data() for ax in made.axes[:1])
                assert len(figure.alt) > 20
                plt.close(made)
    assert "shrinkage" in [figure.name for figure in gap_figures(documents["named"])]


def test_that_the_log_of_a_density_is_drawn_as_a_factor():
    own, wide = [-0.02, 0.001, 0.03], [-0.1, 0.0, 0.1]
    ax = plot_intervals(
        {"parameters": {"density": own}, "parameters_with_model_error": {"density": wide}}
    )
    for bar, ends in zip(ax.containers, (own, wide), strict=True):
        drawn = bar.lines[2][0].get_segments()[0][:, 0]
        assert drawn == pytest.approx(np.exp(np.array(ends)[::2] - own[1]))
    assert "ln" not in ax.get_yticklabels()[0].get_text()


@pytest.fixture(scope="module")
def page(documents, tmp_path_factory):
    with rendering():
        target = tmp_path_factory.mktemp("page") / "page.html"
        write_page(documents["named"], target, title="A < B")
    return target


def test_that_the_page_is_one_file_with_every_figure_decodable_and_described(
    documents, page
):
    text = re.sub(
        r"<((img|meta|link)\b[^>]*)>", r"<\1/>", page.read_text().partition("\n")[2]
    )
    elements = list(ElementTree.fromstring(text).iter())  # fails unless all are nested
    assert all(
        e.get(key, "data:").startswith("data:") for e in elements for key in ("src", "href")
    )
    images = [element.attrib for element in elements if element.tag == "img"]
    assert len(images) == len(list(gap_figures(documents["named"])))
    for image in images:
        pixels = imread(
            io.BytesIO(
                base64.b64decode(image["src"].removeprefix("data:image/png;base64,"))
            )
        )
        assert min(pixels.shape[:2]) > 100
        assert len(image["alt"]) > 20


def test_that_the_page_has_the_sections_of_the_words_in_order(documents, page):
    document = documents["named"]
    text = page.read_text()
    shown = [s.heading for s in sections(document)[1:] if not s.folded]
    folded = [s.heading for s in sections(document) if s.folded]
    places = [
        text.index(f"<h2>{heading}</h2>")
        for heading in ("The gel", "The curves", *shown, "What to do next")
    ]
    places += [text.index(f"<details><summary>{heading}</summary>") for heading in folded]
    assert places == sorted(places)
    assert "<h1>A &lt; B</h1>" in text


def test_that_bubbles_that_cannot_be_simulated_elsewhere_cost_the_next_design_alone(
    monkeypatch,
):
    def failing(*_, **__):
        raise ConvergenceError("too few designs")

    # its name in the package is the function's
    module = sys.modules["imr_torch.gap.examine"]
    monkeypatch.setattr(module, "identity_design", failing)
    monkeypatch.setattr(module, "_SURE", 1.1)
    experiments = shots({"sound_speed": 0.5}, 10, (8e3, 8e3))
    report = diagnose_offered(experiments, OFFERED)
    parts = examine(report, SIMULATOR)
    assert parts.next_design is None
    assert parts.onset is not None
