"""The command line as a user meets it: results, JSON, figures, and messages that say what to do."""

import functools
import json
import re
import shutil

import pytest

from benchmarks.interruptions import Disk
from imr_torch.campaign import Journal
from imr_torch.cli import COMMANDS, build_parser, main
from imr_torch.cli.campaign_settings import settings_of
from imr_torch.cli.characterize import choose_base
from imr_torch.cli.common import read_options
from imr_torch.cli.design import plan_of
from imr_torch.files import read_json
from imr_torch.float64 import tensor
from imr_torch.material import Belief, wide_prior
from imr_torch.observe import Nuisance
from imr_torch.results import draw_figures
from imr_torch.simulate import Status, explain_growth
from tests.docs.test_sources import ROOT
from tests.journals import cut
from tests.results.documents import GEL, shot, write_table

QUICK = ["--physics", "polytropic", "--quiet"]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_teaches_with_an_example(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    assert (
        f"imr-torch {command} "
        in capsys.readouterr().out.split("options:")[0].split("\n\n", 1)[1]
    )


def test_that_a_result_says_with_which_equation_and_liquid_it_was_made(tmp_path, capsys):
    out = tmp_path / "bubble.json"
    bubble = f"simulate --set G=8310,mu=0.093 --physics polytropic --frames 41 --json {out}".split()
    ends = {}
    for motion in (
        (),
        ("--radial", "gilmore"),
        ("--radial", "gilmore", "--liquid", "noble_abel"),
    ):
        assert main([*bubble, *motion]) == 0
        made = read_json(out)
        ends[made["radial"], made["liquid"]] = made["R_star"][-1]
    assert list(ends) == [
        ("keller_miksis", "constant_density"),
        ("gilmore", "tait"),
        ("gilmore", "noble_abel"),
    ]
    assert len(set(ends.values())) == 3
    assert "A change of" not in capsys.readouterr().out


def test_that_an_ill_conditioned_bubble_says_so(monkeypatch, said_by):
    """Bubbles in which a change grows a thousandfold are driven for long; here the limit is lower."""
    low = functools.partial(explain_growth, limit=1.0)
    monkeypatch.setattr("imr_torch.cli.simulate.explain_growth", low)
    bubble = "simulate --set G=8310,mu=0.093 --physics polytropic --frames 41"
    assert Status.ILL_CONDITIONED.sentence in said_by(bubble.split())


def test_simulate_writes_the_curve_and_a_figure(rendered, tmp_path, capsys):
    out = tmp_path / "bubble"
    gel = ["--set", "G=8310,mu=0.093"]
    assert (
        main(["simulate", *gel, *f"--we 300 --rinf 0.2 --out {out} --frames 41".split()])
        == 0
    )
    result = read_json(out / "simulate.json")
    assert len(result["R_star"]) == len(result["time_s"]) == 41
    assert result["R_star"][0] == 1.0
    assert 0.0 < min(result["R_star"]) < 0.2
    assert result["design"]["Rmax_m"] == pytest.approx(300 * 2 * 0.056 / 101325)
    assert (out / "radius.png").stat().st_size > 5000
    assert "NHKV, Rmax 331.6 um" in capsys.readouterr().out


def test_that_the_demo_finds_its_gel_and_prints_what_the_pages_say(
    tmp_path, monkeypatch, capsys
):
    """Its first command with one of the two models, which leaves the fit of that model as it is."""
    asked = []

    def run_first(command: list[str]) -> int:
        asked.append(command)
        return (
            0
            if command[0] == "campaign"
            else main([x.split(",gen_qkv")[0] for x in command])
        )

    monkeypatch.setattr("imr_torch.cli.main", run_first)
    assert main(f"demo --out {tmp_path}/demo --quiet".split()) == 0
    assert "nhkv,gen_qkv" in asked[0]
    out = tmp_path / "demo" / "characterize"
    result = read_json(out / "characterize.json")
    shots = [e["id"] for e in result["experiments"]]
    fit = result["models"]["nhkv"]
    assert fit["certificate"]["converged"]
    assert fit["rmse"] == pytest.approx(0.003, rel=0.2)
    for name, (low, middle, high) in fit["intervals"].items():
        assert low < GEL[name] < high
        assert middle == pytest.approx(GEL[name], rel=0.1)
    names = {"record", "residuals", "parts", "parameters", "parameter_G", "parameter_mu"}
    names |= {f"curve_{shot}" for shot in shots}
    assert {path.stem for path in out.glob("*.png")} == names
    assert {path.stem for path in out.glob("*.pdf")} == names
    said = re.findall(
        r"^Fit: .*", (out / "report.txt").read_text(), re.DOTALL | re.MULTILINE
    )[0]
    head, found, _ = capsys.readouterr().out.partition(said)
    assert found
    assert head.count("Curves as they are fitted") == 1
    for page in (ROOT / "README.md", ROOT / "docs" / "start" / "index.md"):
        written = re.findall(r"```text\n(Fit: .*?)```", page.read_text(), re.DOTALL)[0]
        written = re.sub(r"probability [\d.]+ \+- [\d.]+", "the only candidate", written)
        for number, lines in enumerate(
            zip(written.splitlines(), said.splitlines(), strict=False)
        ):
            text, printed = (
                re.split(r"(-?\d+(?:\.\d+)?(?:e[-+]\d+)?)", line) for line in lines
            )
            assert text[::2] == printed[::2]
            if (
                number < 5
            ):  # below are those of the computation, which differ between machines
                figures, found = (
                    [float(x) for x in parts[1::2]] for parts in (text, printed)
                )
                assert figures == pytest.approx(found, rel=0.002, abs=0.1 * (number == 0))


def test_design_names_several_designs_and_what_each_adds(tmp_path, capsys):
    out = tmp_path / "day"
    options = "--we-range 200:400 --rinf-range 0.18:0.24 --evaluations 3 --draws 3 --q 2"
    assert main(f"design --case soft-pa {options} --out {out}".split() + QUICK) == 0
    result = read_json(out / "design.json")
    said = capsys.readouterr().out
    assert result["joint_eig"] == pytest.approx(result["eig"] + result["further"][0]["eig"])
    assert 200.0 <= result["further"][0]["design"]["We"] <= 400.0
    assert (out / "information_2.png").exists()
    assert said.count("Shoot We") == 2
    assert f"together {result['joint_eig']:.3f} nats" in said


def test_design_can_ask_about_the_model_alone(tmp_path):
    target = tmp_path / "model.json"
    options = f"--target model --evaluations 3 --draws 3 --repeats 1 --json {target}"
    assert main(f"design --case soft-pa {options}".split() + QUICK) == 0
    evaluated = read_json(target)["evaluations"]
    assert all(row["parameters"] == 0.0 and row["eig"] <= 0.6932 for row in evaluated)


def test_design_says_how_many_shots_a_target_needs_and_which(rendered, tmp_path, capsys):
    out = tmp_path / "shots"
    page = tmp_path / "shots.html"
    options = "--evaluations 2 --draws 2 --shots 4 --until G:300%,mu:20%"
    assert (
        main(f"design --models nhkv {options} --out {out} --html {page}".split() + QUICK)
        == 0
    )
    forecast = read_json(out / "design.json")["forecast"]
    assert [row["what"] for row in forecast["rows"]][:2] == [
        "one design repeated",
        "designs chosen",
    ]
    assert len(forecast["designs"]) == 4
    said = capsys.readouterr().out
    assert "Shots until G:300%,mu:20%, predicted:\n  one design repeated: " in said
    first = forecast["designs"][0]
    assert f"in their order: We {first['We']:.0f}, R_inf* {first['R_inf*']:.3f}; We" in said
    assert "How many shots" in page.read_text()


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    out = tmp_path_factory.mktemp("cli") / "demo"
    arguments = (
        f"campaign --case soft-pa --designs 1 --evaluations 4 --out {out}".split() + QUICK
    )
    assert main(arguments) == 0
    return arguments, out


def test_campaign_reports_designs_errors_probabilities_intervals_and_cost(simulated):
    _, out = simulated
    result = read_json(out / "campaign.json")
    assert len(result["designs"]) == 1
    assert set(result["relative_error"]) == {"G", "mu"}
    assert all(error < 0.03 for error in result["relative_error"].values())
    assert result["model_probabilities"]["nhkv"] > 0.99
    low, _, high = result["intervals"]["nhkv"]["G"]
    assert low < high < 1e5
    assert result["cpu_seconds"] > 0
    assert {"information_001.png", "curve_001.png", "models.png", "parameter_G.png"} <= {
        p.name for p in out.glob("*.png")
    }


def test_that_the_page_and_the_figures_of_a_campaign_come_from_its_json_alone(
    rendered, simulated, tmp_path, said_by
):
    document = read_json(simulated[1] / "campaign.json")
    assert [curve["number"] for curve in document["curves"]] == [1]
    names = {figure.name for figure in draw_figures(document)}
    assert names == {
        "models",
        "parameter_G",
        "parameter_mu",
        "information_001",
        "curve_001",
    }
    copy = tmp_path / "campaign.json"
    copy.write_text(json.dumps(document))
    assert (
        main(f"plot {copy} --format png --html {tmp_path}/page.html --quiet".split()) == 0
    )
    assert {path.stem for path in tmp_path.glob("*.png")} == names
    page = (tmp_path / "page.html").read_text()
    assert re.search(r"After 1 experiment\(s\) NHKV, (probability|the only)", page)
    assert 'class="verdict">Simulated: the shots' in page
    assert "converged (gradient" in page
    assert page.count("data:image/png;base64,") == len(names)
    assert "<script" not in page
    del document["history"][0]["belief"]
    copy.write_text(json.dumps(document))
    assert "campaign.json: the result is not whole (KeyError: 'belief')" in said_by(
        ["plot", str(copy), "--quiet"], 2
    )


def test_campaign_does_not_overwrite_and_resumes(simulated, said_by):
    arguments, out = simulated
    before = (out / "campaign.json").read_text()
    assert "give --resume to continue it, or another --out" in said_by(arguments, 2)
    assert "simulator" in said_by([*arguments, "--resume", "--radial", "herring"], 2)
    assert main([*arguments, "--resume"]) == 0
    after = read_json(out / "campaign.json")
    first = json.loads(before)
    assert after["belief"] == first["belief"]
    assert after["designs"] == first["designs"]


def test_campaign_shoots_without_a_search_and_stops_when_enough_is_known(tmp_path):
    out = tmp_path / "unsearched"
    shots = "--designs 3 --policy random --we-range 299:301 --rinf-range 0.199:0.201"
    arguments = f"campaign --case soft-pa {shots} --out {out}".split() + QUICK
    assert (
        main([*arguments, "--stop", "sd=.01,probability=.99", "--stop", "designs=2"]) == 0
    )
    result = read_json(out / "campaign.json")
    ((weber, rest),) = result["designs"]
    assert (weber, rest) == (pytest.approx(300.0, abs=1.0), pytest.approx(0.2, abs=0.001))
    assert not list(out.glob("information_*.png"))
    assert "and NHKV has a probability above 0.99" in (out / "journal.jsonl").read_text()


def test_a_real_campaign_asks_learns_from_told_files_and_asks_again(tmp_path, said_by):
    out = tmp_path / "gel"
    told = write_table(shot(), tmp_path / "shot.csv")
    base = f"campaign --models nhkv --evaluations 4 --repeats 1 --out {out}".split() + QUICK
    first = said_by(base)
    assert "Shoot next: We = " in first
    rest = ["--rest-radius", "0.21:0.005"]
    second = said_by([*base, *rest, "--resume", "--tell", str(told)])
    assert "1 curve(s)" in second
    assert "Shoot next: We = " in second
    result = read_json(out / "campaign.json")
    assert len(result["designs"]) == 1
    assert result["noise"]["scale"] * result["noise"]["floor"] == pytest.approx(
        0.003, rel=0.4
    )
    assert "x the published law" in second
    assert "converged (gradient" in second
    assert "Simulated" not in second
    low, _, high = result["intervals"]["nhkv"]["G"]
    assert low < GEL["G"] < high
    ending = real(tmp_path / "other", "--stop", "designs=1", "--tell", told)
    assert "Enough: 1 designs were shot" in said_by(ending)


def real(out, *more) -> list[str]:
    """A campaign with one's own gel whose designs cost nothing."""
    base = f"campaign --models nhkv --policy space-filling --repeats 1 --out {out}".split()
    rest = ["--rest-radius", "0.21:0.005"] if "--tell" in more else []
    return [*base, *QUICK, *rest, *map(str, more)]


@pytest.fixture(scope="module")
def told_once(tmp_path_factory):
    """The folder of a real campaign after one tell, and the file that was told."""
    folder = tmp_path_factory.mktemp("told")
    told = write_table(shot(), folder / "shot.csv")
    assert main(real(folder / "gel", "--tell", told)) == 0
    return folder / "gel", told


def belief_of(out):
    return read_json(out / "campaign.json")["belief"]


def test_that_resume_learns_what_a_killed_tell_did_not(told_once, tmp_path, said_by):
    whole, told = told_once
    out = cut(whole, tmp_path / "gel", 2)
    (out / "campaign.json").unlink()
    assert "not learnt yet; resuming without telling it again does so" in said_by(
        real(out, "--resume", "--tell", told), 2
    )
    assert main(real(out, "--resume")) == 0
    assert (out / "journal.jsonl").read_bytes() == (whole / "journal.jsonl").read_bytes()
    assert belief_of(out) == belief_of(whole)


def test_that_a_campaign_is_resumed_without_naming_its_models_again(
    told_once, tmp_path, said_by
):
    whole, _ = told_once
    out = tmp_path / "gel"
    shutil.copytree(whole, out)
    words = real(out, "--resume")
    at = words.index("--models")
    said = said_by(words[:at] + words[at + 2 :])
    assert "Shoot next: We = " in said
    assert re.search(r"^  G \d.* kPa \(90 %:", said, re.MULTILINE)


def test_that_a_campaign_for_a_cause_is_resumed_without_naming_its_goal_again(
    tmp_path, said_by
):
    begun = f"campaign --physics polytropic --seed 2 --out {tmp_path / 'hunt'}".split()
    goal = ["--goal", "cause", "--models", "nhkv", "--effects", "sound_speed,gas_loss"]
    first = said_by([*begun, *goal])
    said = said_by([*begun, "--resume"])
    assert re.findall("Shoot next: .*", said) == re.findall("Shoot next: .*", first) != []


def test_that_a_file_is_told_once_and_forgotten_by_its_number(told_once, tmp_path, said_by):
    whole, told = told_once
    out = tmp_path / "gel"
    other = write_table(shot(seed=4), tmp_path / "other.csv")
    shutil.copytree(whole, out)
    before = (out / "journal.jsonl").read_bytes()
    assert "has the curve of experiment 1 ('a')" in (
        said := said_by(real(out, "--resume", "--tell", told), 2)
    )
    assert "--resume --forget 1" in said
    assert (out / "journal.jsonl").read_bytes() == before
    assert main(real(out, "--resume", "--forget", 1, "--tell", other)) == 0
    assert main(real(tmp_path / "alone", "--tell", other)) == 0
    assert belief_of(out) == belief_of(tmp_path / "alone") != belief_of(whole)
    assert read_json(out / "campaign.json")["experiments"] == [2]
    assert (out / "curve_002.png").exists()
    assert (out / "journal.jsonl").read_bytes().startswith(before)
    assert "There is no experiment 1 to forget" in said_by(
        real(out, "--resume", "--forget", 1), 2
    )


def radii_above(rows: list[str], largest_um: float) -> list[str]:
    """Rows of a bubble that leaves the picture where it is larger."""
    return [row for row in rows if 1e6 * float(row.split(",")[2]) < largest_um]


@pytest.mark.parametrize(
    ("kept", "reason"),
    [
        (lambda rows: rows[:6], "has 6 frames to fit, and at least 10 are needed"),
        (lambda rows: radii_above(rows, 250.0), "begins after its maximum radius"),
        (lambda rows: rows[:20], "shows no collapse"),
    ],
    ids=["six frames", "cut off by the edge", "no collapse"],
)
def test_that_a_told_shot_that_cannot_be_used_is_recorded_as_failed_and_asked_for_again(
    told_once, tmp_path, said_by, kept, reason
):
    whole, told = told_once
    out = tmp_path / "gel"
    short = tmp_path / "short.csv"
    shutil.copytree(whole, out)
    before = belief_of(out)
    (first,) = re.findall("Shoot next: .*", said_by(real(out, "--resume")))
    header, *rows = told.read_text().splitlines()
    short.write_text("\n".join([header, *kept(rows)]) + "\n")
    said = said_by(real(out, "--resume", "--tell", short))
    assert re.search(
        rf"short\.csv failed: Experiment 'a' {reason}.* It is recorded as failed", said
    )
    assert first in said
    assert belief_of(out) == before
    document = read_json(out / "campaign.json")
    assert [x["file"] for x in document["failed_shots"]] == ["short.csv"]
    assert document["experiments"] == [1]
    assert main(real(out, "--resume", "--tell", tmp_path / "none.csv")) == 2


def test_that_a_folder_in_use_and_a_full_disk_are_one_line_each(
    told_once, tmp_path, capsys
):
    out = tmp_path / "gel"
    shutil.copytree(told_once[0], out)
    before = (out / "journal.jsonl").read_bytes()
    with Journal(out).hold_lock():
        assert main(real(out, "--resume", "--forget", 1)) == 2
    assert "is in use by another campaign (process" in capsys.readouterr().err
    with Disk(2, "full").watched():
        assert main(real(out, "--resume", "--forget", 1)) == 1
    said = capsys.readouterr().err
    assert (
        "journal.jsonl cannot be read or written: No space left on device; the last event was not recorded"
        in said
    )
    assert said.count("\n") == 1
    assert (out / "journal.jsonl").read_bytes() == before


def test_a_saved_belief_is_the_prior_of_the_next_design(tmp_path):
    saved = tmp_path / "belief.json"
    wide_prior(("nhkv",)).save(saved)
    shared = ["--evaluations", "3", "--draws", "3", *QUICK, "--json"]
    assert main(["design", "--belief", str(saved), *shared, str(tmp_path / "a.json")]) == 0
    assert main(["design", "--models", "nhkv", *shared, str(tmp_path / "b.json")]) == 0
    first, second = (read_json(tmp_path / name) for name in ("a.json", "b.json"))
    assert {key for key in first if first[key] != second[key]} <= {
        "created",
        "command",
        "files",
    }
    assert (first["schema"], first["medium"]) == (second["schema"], second["medium"])
    assert [entry["name"] for entry in first["files"]] == ["belief.json"]


def test_that_a_reference_case_is_observed_as_published_and_a_gel_of_ones_own_as_in_a_laboratory():
    published = plan_of(build_parser().parse_args(["design", "--case", "soft-pa"]))
    assert (published.repeats, published.nuisance) == (100, Nuisance())
    own = plan_of(build_parser().parse_args(["design", "--models", "nhkv"]))
    assert own.repeats == 10
    assert (own.nuisance.sds() > 0.0).all()
    for gel in (["--case", "soft-pa"], ["--models", "nhkv"]):
        assert (
            plan_of(build_parser().parse_args(["design", *gel, "--repeats", "3"])).repeats
            == 3
        )


def test_that_an_elastic_model_is_the_base_of_a_diagnosis():
    prior = wide_prior(["nhkv", "newtonian"])
    liquid = [0.9 if part.model == "newtonian" else 0.1 for part in prior.models]
    assert choose_base(Belief(prior.models, tensor(liquid).log())).model == "nhkv"


@pytest.mark.parametrize(
    ("about", "rounds"), [(["--case", "soft-pa"], 0), (["--models", "nhkv"], 2)]
)
def test_that_the_noise_of_told_files_is_estimated_and_that_of_a_simulated_camera_known(
    about, rounds
):
    args = build_parser().parse_args(["campaign", *about, "--out", "x"])
    read_options(args)
    assert settings_of(args).learner.noise_rounds == rounds
