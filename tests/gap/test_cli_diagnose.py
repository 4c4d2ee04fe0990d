"""The command ``imr-torch diagnose``: results in words, JSON and HTML, and messages before any
work.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from imr_torch.cli import diagnose as commands
from imr_torch.cli import main
from imr_torch.gap import load_set
from imr_torch.material import PARAMETERS
from imr_torch.observe import SimulatedLaboratory
from imr_torch.simulate import PolytropicSimulator

FAST = ["--physics", "polytropic", "--effects", "sound_speed,rinf_bias,refraction", "--quiet"]


@pytest.fixture(scope="module")
def matched(tmp_path_factory) -> Path:
    """A set of two designs that the base model describes."""
    simulator = PolytropicSimulator()
    outer = simulator.conditions.surroundings
    times = torch.linspace(0.0, 2.6, 53, dtype=torch.float64)
    laboratory = SimulatedLaboratory(
        simulator, PARAMETERS.pack({"G": 8e3, "mu": 0.08}), repeats=5, times=times
    )
    designs = torch.tensor([[200.0, 0.2], [600.0, 0.17]], dtype=torch.float64)
    shots = [laboratory.shoot(design, seed=i) for i, design in enumerate(designs)]
    sizes = [float(outer.max_radius(float(we))) for we in designs[:, 0]]
    path = tmp_path_factory.mktemp("set") / "matched.npz"
    np.savez(
        path,
        time_s=np.stack([times.numpy() * float(outer.time_scale(size)) for size in sizes]),
        radius_m=np.stack(
            [size * shot.radius.numpy() for size, shot in zip(sizes, shots, strict=True)]
        ),
        we=designs[:, 0].numpy(),
        rinf_star=designs[:, 1].numpy(),
    )
    return path


def test_that_a_set_comes_back_as_it_was_shot(matched):
    first, second = load_set(matched)
    assert first.design == pytest.approx((200.0, 0.2))
    assert second.radius.shape == (5, 53)
    assert float(first.radius[:, 0].mean()) == pytest.approx(1.0, abs=0.005)
    assert float(second.times[-1]) == pytest.approx(2.6)


@pytest.fixture(scope="module")
def single(matched, tmp_path_factory) -> Path:
    """The first repeat of each design as a file of curves, with one negative radius and one frame far off its neighbours."""
    with np.load(matched) as document:
        times = document["time_s"]
        radii = document["radius_m"][:, 0].copy()
    radii[0, 15] *= 1.3
    radii[1, 18] = -1e-6
    rows = [
        f"shot {k},{t!r},{r!r}"
        for k in range(2)
        for t, r in zip(times[k].tolist(), radii[k].tolist(), strict=True)
    ]
    path = tmp_path_factory.mktemp("curves") / "single.csv"
    path.write_text("\n".join(["experiment_id,time_s,radius_m", *rows]) + "\n")
    return path


def test_that_single_curves_are_judged_by_the_noise_of_their_frames(single, tmp_path, capsys):
    target = tmp_path / "result.json"
    assert (
        main(["diagnose", str(single), *FAST, "--rest-radius", "0.185:0.02", "--json", str(target)])
        == 0
    )
    said = capsys.readouterr().out
    result = json.loads(target.read_text())
    assert "negative or smaller than a camera sees" in said
    assert "Frames that stand alone, far off their neighbours, were left out: 15 of shot 0." in said
    assert "Noise of single frames, inferred: " in said
    assert result["frames_left_out"] == {"shot 0": [15]}
    low, middle, high = result["noise_interval"]
    assert 0.003 < low < middle < high < 0.03
    assert (result["gap"], result["verdict"], result["converged"]) == (False, "none", True)
    assert "everything (chi-square)" not in {test["name"] for test in result["tests"]}
    assert [shot["id"] for shot in result["record"]["shots"]] == ["shot 0", "shot 1"]
    assert "The record before any gel" in said


def test_that_a_document_is_saved_with_null_for_a_number_that_is_not_finite(
    single, tmp_path, monkeypatch
):
    original = commands.to_json
    monkeypatch.setattr(
        commands,
        "to_json",
        lambda *a, **k: original(*a, **k) | {"ladder": [{"closed": [0.5, float("nan")]}]},
    )
    target = tmp_path / "result.json"
    assert (
        main(["diagnose", str(single), *FAST, "--rest-radius", "0.185:0.02", "--json", str(target)])
        == 0
    )
    result = json.loads(target.read_text())
    assert result["ladder"] == [{"closed": [0.5, None]}]
    assert result["not_finite"] == ["ladder.0.closed.1"]


def test_that_missing_frames_and_missing_repeats_are_left_out_and_no_others(matched, tmp_path):
    with np.load(matched) as document:
        arrays = dict(document)
    arrays["radius_m"][0, 1] = np.nan  # a repeat that was not shot
    arrays["radius_m"][0, 2, 5:7] = np.nan
    arrays["radius_m"][1, :, 50:] = np.nan  # a shorter film
    np.savez(tmp_path / "gaps.npz", **arrays)
    first, second = load_set(tmp_path / "gaps.npz")
    assert first.radius.shape == (4, 53)
    assert first.counts.tolist() == [4] * 5 + [3] * 2 + [4] * 46
    assert (second.radius.shape, second.has_gaps) == ((5, 50), False)


def test_that_matched_data_with_gaps_give_silence(matched, tmp_path):
    with np.load(matched) as document:
        arrays = dict(document)
    lost = np.random.default_rng(0).random(arrays["radius_m"].shape) < 0.2
    arrays["radius_m"][lost] = np.nan
    np.savez(tmp_path / "gaps.npz", **arrays)
    assert (
        main(
            ["diagnose", str(tmp_path / "gaps.npz"), *FAST, "--json", str(tmp_path / "result.json")]
        )
        == 0
    )
    result = json.loads((tmp_path / "result.json").read_text())
    assert (result["gap"], result["verdict"], result["converged"]) == (False, "none", True)


def test_that_noise_may_make_a_collapsed_radius_negative(matched, tmp_path):
    with np.load(matched) as document:
        arrays = dict(document)
    arrays["radius_m"][0, 2, 20] = -0.05 * arrays["radius_m"].max()
    np.savez(tmp_path / "noisy.npz", **arrays)
    assert float(load_set(tmp_path / "noisy.npz")[0].radius[2, 20]) < 0.0


def test_that_matched_data_give_silence_in_words_json_and_html(matched, tmp_path, capsys):
    paths = {"json": tmp_path / "result.json", "html": tmp_path / "page.html"}
    options = [
        *FAST,
        "--heldout",
        "design 1",
        "--json",
        str(paths["json"]),
        "--html",
        str(paths["html"]),
    ]
    assert main(["diagnose", str(matched), *options]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    assert "No gap was found" in captured.out
    document = json.loads(paths["json"].read_text())
    assert (document["gap"], document["verdict"], document["cause"]) == (False, "none", [])
    assert document["converged"] is True
    assert document["seconds"] > 0.0
    assert (
        main(["plot", str(paths["json"]), "--out", str(tmp_path / "figures"), "--format", "png"])
        == 0
    )
    names = {path.stem for path in (tmp_path / "figures").iterdir()}
    assert {"tests", "parameters"} < names
    assert len(names) == 3  # and the curve
    page = paths["html"].read_text()
    assert "No gap was found" in page
    assert "radius over time of design 0" in page
    assert "radius over time of design 1" not in page  # the one that is held out is not looked at


@pytest.mark.parametrize(("options", "words"), [((), False), (("--noise", "estimated"), True)])
def test_that_a_set_has_the_published_noise_however_few_its_repeats(
    options, words, matched, tmp_path, capsys
):
    with np.load(matched) as document:
        arrays = dict(document)
    np.savez(tmp_path / "one.npz", **arrays | {"radius_m": arrays["radius_m"][:, :1]})
    assert main(["diagnose", str(tmp_path / "one.npz"), *FAST, *options]) == 0
    assert ("x the published law" in capsys.readouterr().out) is words


@pytest.fixture
def broken(tmp_path, matched) -> dict[str, Path]:
    """Files that are no good, by what is wrong with them."""
    with np.load(matched) as document:
        good = dict(document)
    changes = {
        "keyless": {"we": None},
        "short": {"we": good["we"][:1]},
        "flat": {"radius_m": good["radius_m"][:, 0]},
        "frames": {"time_s": good["time_s"][:, 1:]},
        "empty": {"radius_m": np.full_like(good["radius_m"], np.nan)},
        "negative": {"we": -good["we"]},
        "hole": {"radius_m": np.where(np.arange(53) == 3, -1.0, good["radius_m"])},
        "millimetres": {"radius_m": 1e3 * good["radius_m"]},
        "microseconds": {"time_s": 1e6 * good["time_s"]},
        "words": {"we": np.array(["a", "b"])},
    }
    files = {"good": matched, "text": tmp_path / "text.npz", "csv": tmp_path / "curve.csv"}
    files["text"].write_text("not a set")
    files["csv"].write_text("experiment_id,time_s,radius_m\n")
    for name, change in changes.items():
        files[name] = tmp_path / f"{name}.npz"
        np.savez(
            files[name],
            **{key: value for key, value in (good | change).items() if value is not None},
        )
    return files


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.npz"], r"nowhere\.npz: no such file"),
        (["nowhere.csv"], r"nowhere\.csv.*no such file"),
        (["{text}"], r"text\.npz: cannot be read as \.npz"),
        (["{keyless}"], r"no array 'we'; expected time_s, radius_m, we, rinf_star, got time_s"),
        (["{short}"], r"time_s has shape \(2, 53\); expected 2 dimensions, the first of 1 designs"),
        (["{flat}"], r"radius_m has shape \(2, 53\); expected 3 dimensions"),
        (["{frames}"], "radius_m has 53 frames, time_s 52"),
        (["{empty}"], "design 0 has 0 frames with a finite time and radius; at least 2 are needed"),
        (["{negative}"], "expected We > 0"),
        (["{hole}"], "design 0: radius_m holds -1; expected metres, from about 0"),
        (
            ["{millimetres}"],
            r"radius_m holds 0\.\d+; expected metres, from about 0 to not far above Rmax",
        ),
        (["{microseconds}"], r"time_s ends at \d+.*; expected seconds"),
        (["{words}"], "cannot be read as .npz arrays of numbers"),
        (["{good}", "{csv}"], "cannot be mixed"),
        (
            ["{good}", "--base", "maxwell9"],
            "--base: unknown model 'maxwell9'; known are newtonian, nhe, nhkv",
        ),
        (["{good}", "--effects", "magic"], "Unknown effect 'magic'; known are strain_stiffening"),
        (["{good}", "--without", "magic"], "Unknown effect 'magic'"),
        (
            ["{good}", "--base", "gen_qkv", "--effects", "strain_stiffening"],
            "cannot be put on the base model 'gen_qkv'",
        ),
        (
            ["{good}", "--heldout", "design 7"],
            "--heldout: no experiment 'design 7' among the 2 loaded: design 0, design 1",
        ),
        (["{good}", "--experiments", "x"], "--experiments: no experiment 'x'"),
        (
            ["{good}", "--heldout", "design 0,design 1"],
            "--heldout leaves none of the 2 experiments to fit",
        ),
    ],
)
def test_that_bad_input_ends_with_a_message_before_any_work(arguments, message, broken, capsys):
    assert main(["diagnose", *(a.format(**broken) for a in arguments)]) == 2
    captured = capsys.readouterr().err
    assert re.search(message, captured), captured
    assert captured.startswith("imr-torch: ")
    assert "assimilation" not in captured


def test_that_every_labelled_set_of_the_other_generator_is_read(shared):
    files = sorted((shared / "blind" / "dev").glob("*.npz"))
    if not files:
        pytest.skip("the labelled sets are not there")
    for file in files:
        assert all(e.radius.shape[0] >= 1 and len(e.times) > 20 for e in load_set(file))
