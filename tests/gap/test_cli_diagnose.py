"""The command ``imr-torch diagnose``: results in words, JSON and HTML, and messages before any
work.
"""

import json
import re

import numpy as np
import pytest

from imr_torch.cli import main
from imr_torch.float64 import linspace, tensor
from imr_torch.gap import load_set
from imr_torch.material import PARAMETERS
from imr_torch.observe import SimulatedLaboratory
from imr_torch.simulate import PolytropicSimulator

FAST = [
    "--physics",
    "polytropic",
    "--effects",
    "sound_speed,rinf_bias,refraction",
    "--quiet",
]


@pytest.fixture(scope="module")
def matched(tmp_path_factory):
    """A set of two designs that the base model describes."""
    simulator = PolytropicSimulator()
    outer = simulator.conditions.surroundings
    times = linspace(0.0, 2.6, 53)
    laboratory = SimulatedLaboratory(
        simulator, PARAMETERS.pack({"G": 8e3, "mu": 0.08}), repeats=5, times=times
    )
    designs = tensor([[200.0, 0.2], [600.0, 0.17]])
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


@pytest.fixture
def arrays(matched):
    """What that set holds."""
    with np.load(matched) as document:
        return dict(document)


@pytest.fixture(scope="module")
def single(matched, tmp_path_factory):
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


def test_that_single_curves_are_judged_by_the_noise_of_their_frames(
    single, tmp_path, said_by
):
    target = tmp_path / "result.json"
    said = said_by(
        [
            "diagnose",
            str(single),
            *FAST,
            *f"--rest-radius 0.185:0.02 --json {target}".split(),
        ]
    )
    result = json.loads(target.read_text())
    assert "negative or smaller than a camera sees" in said
    assert "Frames far off their neighbours were left out: 15 of shot 0 (0 is" in said
    assert "Radius error of one frame: about " in said
    assert result["frames_left_out"] == {"shot 0": [15]}
    low, middle, high = result["noise_interval"]
    assert 0.003 < low < middle < high < 0.03
    assert (result["gap"], result["verdict"], result["converged"]) == (False, "none", True)
    assert "everything (chi-square)" not in {test["name"] for test in result["tests"]}
    assert [shot["id"] for shot in result["record"]["shots"]] == ["shot 0", "shot 1"]
    assert "What the records show without a model" in said


def test_that_missing_frames_and_missing_repeats_are_left_out_and_no_others(
    arrays, tmp_path
):
    arrays["radius_m"][0, 1] = np.nan  # a repeat that was not shot
    arrays["radius_m"][0, 2, 5:7] = np.nan
    arrays["radius_m"][1, :, 50:] = np.nan  # a shorter film
    np.savez(tmp_path / "gaps.npz", **arrays)
    first, second = load_set(tmp_path / "gaps.npz")
    assert first.radius.shape == (4, 53)
    assert first.counts.tolist() == [4] * 5 + [3] * 2 + [4] * 46
    assert (second.radius.shape, second.has_gaps) == ((5, 50), False)


def test_that_noise_may_make_a_collapsed_radius_negative(arrays, tmp_path):
    arrays["radius_m"][0, 2, 20] = -0.05 * arrays["radius_m"].max()
    np.savez(tmp_path / "noisy.npz", **arrays)
    assert float(load_set(tmp_path / "noisy.npz")[0].radius[2, 20]) < 0.0


def test_that_matched_data_give_silence_in_words_json_and_html(matched, tmp_path, capsys):
    paths = {"json": tmp_path / "result.json", "html": tmp_path / "page.html"}
    said = "--json {json} --html {html} --heldout".format(**paths)
    assert main(["diagnose", str(matched), *FAST, *said.split(), "design 2"]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    assert "No gap was found" in captured.out
    document = json.loads(paths["json"].read_text())
    assert (document["gap"], document["verdict"], document["cause"]) == (False, "none", [])
    assert document["converged"] is True
    assert document["seconds"] > 0.0
    assert (
        main(
            ["plot", str(paths["json"]), *f"--out {tmp_path}/figures --format png".split()]
        )
        == 0
    )
    names = {path.stem for path in (tmp_path / "figures").iterdir()}
    assert {"tests", "parameters"} < names
    assert len(names) == 3  # and the curve
    page = paths["html"].read_text()
    assert "No gap was found" in page
    assert "radius over time of design 1" in page
    # the one that is held out is not looked at
    assert "radius over time of design 2" not in page


@pytest.mark.parametrize(
    ("options", "words"), [((), False), (("--noise", "estimated"), True)]
)
def test_that_a_set_has_the_published_noise_however_few_its_repeats(
    options, words, arrays, tmp_path, said_by
):
    np.savez(tmp_path / "one.npz", **arrays | {"radius_m": arrays["radius_m"][:, :1]})
    assert (
        "x the published law"
        in said_by(["diagnose", str(tmp_path / "one.npz"), *FAST, *options])
    ) is words


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{good}", "{csv}"], "cannot be mixed"),
        (
            ["{good}", "--base", "gen_qkv", "--effects", "strain_stiffening"],
            "cannot be put on the base model 'gen_qkv'",
        ),
        (
            ["{good}", "--heldout", "design 7"],
            "--heldout: no experiment 'design 7' among the 2 loaded: design 1, design 2",
        ),
        (
            ["{good}", "--heldout", "design 1,design 2"],
            "--heldout leaves none of the 2 experiments to fit",
        ),
    ],
)
def test_that_bad_input_ends_with_a_message_before_any_work(
    arguments, message, matched, single, said_by
):
    files = {"good": matched, "csv": single}
    captured = said_by(["diagnose", *(a.format(**files) for a in arguments)], 2)
    assert re.search(message, captured), captured
    assert captured.startswith("imr-torch: ")
    assert "assimilation" not in captured


def test_that_every_labelled_set_of_the_other_generator_is_read(shared):
    files = sorted((shared / "blind" / "dev").glob("*.npz"))
    if not files:
        pytest.skip("the labelled sets are not there")
    for file in files:
        assert all(e.radius.shape[0] >= 1 and len(e.times) > 20 for e in load_set(file))
