"""The document of a characterisation says which frames were fitted, and holds what its figures and page are drawn from."""

import re
import subprocess
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from imr_torch.cli import main
from imr_torch.files import read_json, write_json
from imr_torch.labels import file_name, plain
from imr_torch.material import PARAMETERS
from imr_torch.results import (
    check_document,
    document_page,
    draw_figures,
    header,
)
from imr_torch.results.figures import curve_figure
from imr_torch.results.intervals import over_time_figure
from tests.processes import BROWSER
from tests.refusals import refusals
from tests.results import documents


@pytest.fixture(scope="module")
def result():
    records = documents.traces(documents.LABELS)
    return documents.fitted(records), records


@pytest.fixture(scope="module")
def document(result):
    found, _ = result
    whole = header("characterize", medium=documents.Surroundings())
    return whole | found.to_document(draws=20)


def test_that_every_frame_is_fitted_or_has_a_reason(result, document):
    found, records = result
    for curve, trace, experiment in zip(
        document["curves"], records, found.experiments, strict=True
    ):
        use = curve["frames"]
        assert use["recorded"] == len(trace) == len(curve["measured"]["fitted"])
        assert use["fitted"] == sum(curve["measured"]["fitted"]) == len(experiment.times)
        assert (
            sum(x["last"] - x["first"] + 1 for x in use["not_fitted"])
            == use["recorded"] - use["fitted"]
        )
        assert [x["reason"].split()[0] for x in use["not_fitted"]] == ["before", "after"]
        assert use["not_fitted"][0]["start_s"] == pytest.approx(float(trace.time_s[0]))
    assert (
        f"{curve['id']}: {use['fitted']} of {use['recorded']} frames fitted"
        in found.report()
    )
    assert "Every row of the files was read." in records.report()


def test_that_fitted_frames_are_the_ones_of_the_experiment(result, document):
    found, _ = result
    for curve, experiment in zip(document["curves"], found.experiments, strict=True):
        seen = curve["measured"]
        fitted = np.array(seen["fitted"])
        assert np.array(seen["R_star"])[fitted] == pytest.approx(
            experiment.radius[0].numpy()
        )
        assert np.array(seen["t_star"])[fitted] == pytest.approx(experiment.times.numpy())


def test_that_the_drawn_curve_goes_through_the_predictions(result, document):
    found, _ = result
    for e, curve in enumerate(document["curves"]):
        times = found.experiments[e].times.numpy()
        predicted = (
            found.assimilation["nhkv"]
            .prediction[e]
            .numpy()[: len(found.experiments[e].times)]
        )
        drawn = np.interp(
            times, curve["models"]["nhkv"]["t_star"], curve["models"]["nhkv"]["R_star"]
        )
        assert drawn == pytest.approx(predicted, abs=2e-3)
        inside = (
            np.interp(times, curve["band"]["t_star"], curve["band"]["high"]) - predicted
        )
        assert (inside > 0.0).all()


def test_that_the_header_names_schema_software_units_and_medium(document):
    assert document["schema"] == {"name": "imr_torch characterize", "version": 1}
    assert set(document["software"]) == {"imr_torch", "torch", "python"}
    density = {
        "value": 1060.0,
        "unit": "kg/m^3",
        "sd": None,
        "stated": True,
        "source": "medium",
    }
    assert document["medium"]["density"] == density
    assert document["units"]["*_s"] == "s"
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00", document["created"])


def test_that_files_come_with_their_hashes_and_those_beside_them(tmp_path):
    (tmp_path / "gel.csv").write_bytes(b"abc")
    (tmp_path / "gel.json").write_bytes(b"{}")
    first, second = header("characterize", files=[tmp_path / "gel.csv"])["files"]
    assert first == {
        "name": "gel.csv",
        "bytes": 3,
        "sha256": "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad",
    }
    assert second["name"] == "gel.json"


test_that_a_document_of_another_kind_or_version_is_refused = refusals(
    (
        lambda: check_document({}),
        "has no 'schema' of imr_torch, .*make it anew with --json",
    ),
    (lambda: check_document([1]), "has no 'schema' of imr_torch"),
    (
        lambda: check_document({"schema": {"name": "imr_torch design", "version": 2}}),
        "schema version is 2; this software reads 1. Install a newer",
    ),
    (
        lambda: check_document({"schema": {"name": "imr_torch design", "version": 0}}),
        "schema version is 0; this software reads 1. Make the result anew",
    ),
)


def test_that_labels_give_file_names_of_their_own_that_fit_a_file_system():
    names = [
        file_name(label) for label in ("a/b", "a_b", "a b", "..", "x" * 300, "x" * 299, "é")
    ]
    assert len(set(names)) == len(names)
    assert max(map(len, names)) < 60
    assert all(set("/. ").isdisjoint(name) for name in names)
    assert file_name("shot_1") == "shot_1"


def test_that_labels_are_drawn_as_they_are():
    for label in ("$x_{bad$", "$a$ and $b$", "a\nb", "\\frac$"):
        figure = plt.figure()
        text = figure.suptitle(plain(label))
        figure.canvas.draw()
        shown, math = text._preprocess_math(text.get_text())
        assert math is False
        assert shown == label.replace("\n", " ")
        plt.close(figure)
    assert len(plain("a" * 300)) == 48


def test_that_every_figure_is_drawn_from_the_file_alone_and_none_overwrites_another(
    rendered, document, tmp_path
):
    write_json(tmp_path / "result.json", document)
    assert (
        main(f"plot {tmp_path}/result.json --out {tmp_path}/again --format png,svg".split())
        == 0
    )
    names = {path.stem for path in (tmp_path / "again").glob("*.png")}
    curves = {f"curve_{file_name(label)}" for label in documents.LABELS}
    assert names == {
        *curves,
        "record",
        "residuals",
        "parts",
        "parameters",
        "parameter_G",
        "parameter_mu",
    }
    assert len(curves) == 5
    assert {path.stem for path in (tmp_path / "again").glob("*.svg")} == names
    drawn = (tmp_path / "again" / f"curve_{file_name('$x_{bad$')}.svg").read_text()
    assert "$x_{bad$" in drawn
    assert "not fitted" in drawn


def test_that_the_figure_marks_unused_frames_and_has_second_axes(document):
    figure = next(f for f in draw_figures(document) if f.name.startswith("curve_")).draw()
    upper, lower = figure.axes[:2]
    labels = {text.get_text() for text in upper.get_legend().get_texts()}
    use = document["curves"][0]["frames"]
    assert {
        f"fitted ({use['fitted']})",
        f"not fitted ({use['recorded'] - use['fitted']})",
        "NHKV",
        "90 % predictive",
    } == labels
    seconds = list(upper.child_axes)
    assert {s.get_xlabel() or s.get_ylabel() for s in seconds} == {"$t$ (µs)", "$R$ (µm)"}
    assert "residual" in lower.get_ylabel()
    plt.close(figure)


def test_that_a_page_escapes_what_it_is_given_and_loads_nothing(document):
    text = document_page(document, title="A < B", report="5 < 6")
    assert "What the records show without a model" in text
    assert "<script" not in text
    assert "&lt;script&gt;" in text
    assert "<h1>A &lt; B</h1>" in text
    assert not re.search(r'(src|href)="(?!data:)', text)
    assert "G, shear modulus" in text
    assert re.search(r"\d\.\d+ kPa \(90 %: \d", text)
    assert (
        text.index("<h2>The gel")
        < text.index("<h2>Figures")
        < text.index("<details><summary>What was assumed")
    )
    assert "What to do next" in text


def test_that_the_title_names_files_of_which_curves_were_fitted(document):
    files = [{"name": name, "bytes": 1, "sha256": ""} for name in ("other.csv", "gel.csv")]
    assert "<h1>Gel in gel.csv</h1>" in document_page(document | {"files": files})


def test_that_the_shape_of_a_bubble_is_drawn_where_two_axes_were_seen(document):
    curve = document["curves"][0]
    frames = len(curve["measured"]["t_star"])
    seen = curve["measured"] | {"asphericity": [0.05] * frames}
    plain, shaped = (
        curve_figure(entry, document) for entry in (curve, curve | {"measured": seen})
    )
    assert len(shaped.axes) == len(plain.axes) + 1
    (points,) = shaped.axes[-1].lines
    assert points.get_ydata().tolist() == seen["asphericity"]


@pytest.mark.skipif(BROWSER is None, reason="no Chromium")
@pytest.mark.parametrize("width", [400, 1200])
def test_that_a_browser_shows_the_page_without_scrolling_sideways(
    document, tmp_path, width
):
    """The page is put into a frame of the width, since browsers' windows are not that narrow, and a script measures it."""
    page = document_page(document, report="x" * 500)
    assert wider_than(page, width, tmp_path) <= 0


def wider_than(page: str, width: int, folder: Path) -> int:
    """By how many pixels a page is wider than its window, as a real browser lays it out."""
    (folder / "page.html").write_text(page)
    script = (
        "const f=document.querySelector('iframe');f.onload=()=>{const r=f.contentDocument.documentElement;"
        f"document.title='over '+(r.scrollWidth-{width})+' high '+r.scrollHeight}};"
    )
    frame = f'<iframe src="page.html" width="{width}" height="900" frameborder="0"></iframe><script>{script}</script>'
    (folder / "frame.html").write_text(frame)
    done = subprocess.run(
        [
            BROWSER,
            *[
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--allow-file-access-from-files",
            ],
            *["--virtual-time-budget=4000", "--dump-dom"],
            f"file://{folder}/frame.html",
        ],
        capture_output=True,
        text=True,
        timeout=120,
    )
    found = re.search(r"over (-?\d+) high (\d+)", done.stdout)
    assert found, done.stderr[-500:]
    assert int(found[2]) > 1000
    return int(found[1])


def test_that_curves_of_the_model_are_explained_and_those_of_an_unmodelled_effect_are_not(
    document,
):
    assert document["fit_test"]["explained"] is True
    assert document["fit_test"]["sentence"].startswith(
        "Fit: the model explains the curves within their noise (p = "
    )
    assert document["fit_test"]["seconds"] < 2.0
    assert document["noise"]["widened"] < 1.5
    lossy = documents.documented(documents.traces(("a", "b", "c"), gas_loss=0.5))
    tested = lossy["fit_test"]
    assert tested["explained"] is False
    assert lossy["noise"]["widened"] > 1.5
    assert tested["p_value"] < 0.01
    assert re.search(
        r"explain the curves \(p [=<] .*, NHKV; strongest test: .*; largest residual .* sd in [abc], ",
        tested["sentence"],
    )
    assert tested["sentence"].endswith("have tried: imr-torch diagnose")


def test_that_the_command_line_writes_json_before_figures_and_the_page(
    rendered, few_deviations, tmp_path, monkeypatch, capsys
):
    documents.write_table(documents.traces(("one",)), tmp_path / "gel.csv")
    monkeypatch.setattr("imr_torch.results.figures.residuals_figure", lambda *_: 1 / 0)
    arguments = (
        f"characterize {tmp_path}/gel.csv --models nhkv --rest-radius 0.2:0.01 --physics polytropic"
    ).split()
    out = tmp_path / "out"
    assert (
        main([*arguments, *f"--quiet --out {out} --html {tmp_path}/page.html".split()]) == 0
    )
    document = read_json(out / "characterize.json")
    assert document["files"][0]["name"] == "gel.csv"
    assert document["command"].startswith("imr-torch characterize ")
    assert document["fit_test"]["command"].startswith("imr-torch diagnose ")
    assert "--rest-radius 0.2:0.01" in document["fit_test"]["command"]
    assert document["physics"] == "polytropic"
    said = capsys.readouterr()
    assert "the figure residuals could not be drawn" in said.err
    assert "one: " in said.out
    assert (out / "curve_one.pdf").exists()
    page = (tmp_path / "page.html").read_text()
    assert "frames fitted" in page
    assert "SHA-256" in page


def test_that_plot_refuses_what_it_cannot_draw(tmp_path, said_by):
    write_json(tmp_path / "r.json", header("diagnose"))
    assert "the result is not whole (KeyError: 'selected')" in said_by(
        ["plot", str(tmp_path / "r.json")], 2
    )
    write_json(tmp_path / "r.json", header("demo"))
    assert "holds no curves or map to draw" in said_by(
        ["plot", str(tmp_path / "r.json")], 2
    )


def test_that_a_page_that_cannot_be_made_fails_before_any_figure(
    document, tmp_path, said_by
):
    damaged = {name: value for name, value in document.items() if name != "models"}
    write_json(tmp_path / "r.json", damaged)
    asked = f"plot {tmp_path}/r.json --html {tmp_path}/p.html --out {tmp_path}/figures"
    assert "the result is not whole" in said_by(asked.split(), 2)
    assert not (tmp_path / "figures").exists()


def test_that_the_gel_over_time_is_drawn_stretch_by_stretch():
    rows = [
        {"t_star": [at, at + 0.5], "intervals": {"G": [3e3, middle, 9e3]}}
        for at, middle in ((0.0, 5e3), (0.5, 6e3), (1.0, 8e3))
    ]
    (axes,) = over_time_figure(rows, {"G": [4e3, 5e3, 6e3]}).axes
    plt.close()
    assert [5.0, 6.0, 8.0] in [list(line.get_ydata()) for line in axes.lines]
    assert axes.get_ylabel() == PARAMETERS["G"].label
