"""Many shots: every file has a result or a reason, runs resume, and pools that break cost only
their shot.
"""

import copy
import csv
import json
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import pytest
from torch.testing import assert_close

import imr_torch.characterization.batch as batch
from imr_torch import PolytropicSimulator, characterize, wide_prior
from imr_torch.assimilate import SearchOptions
from imr_torch.characterization.batch import (
    BatchOptions,
    BatchSummary,
    characterize_shot,
    run_batch,
)
from imr_torch.characterization.saved import SavedCharacterization
from imr_torch.cli import main
from imr_torch.files import read_json
from imr_torch.float64 import linspace
from imr_torch.observe import Statement, load_traces
from imr_torch.random import generator
from imr_torch.results import document_page, header
from imr_torch.results.intervals import is_usable, plot_shots
from imr_torch.simulate import process_pool
from tests.filmed import film
from tests.workers import fatal

SIZE = 221e-6
OPTIONS = BatchOptions(
    wide_prior(["nhkv"]),
    PolytropicSimulator(threads=1),
    rest_radius=(0.2, 0.002),
    estimate_noise=False,
    options=SearchOptions(raw_samples=16, starts=2),
    medium=Statement.from_text("density=1060"),
)


run_shots = partial(run_batch, options=OPTIONS)


def curve(stiffness: float) -> str:
    """A table of one simulated bubble."""
    gel = {"G": stiffness, "mu": 0.093}
    times = linspace(0.0, 2.2, 23)
    trace = film(gel, SIZE, 0.2, times, generator(0), noise=0.0)
    rows = zip(trace.time_s.tolist(), trace.radius_m.tolist(), strict=True)
    return "t (us),R (um)\n" + "".join(f"{1e6 * t},{1e6 * r}\n" for t, r in rows)


@pytest.fixture
def shots(tmp_path):
    """A folder with three curves and a file that is none."""
    folder = tmp_path / "in"
    folder.mkdir()
    for i, stiffness in enumerate((4e3, 8e3, 1.6e4)):
        (folder / f"gel_{i}.csv").write_text(curve(stiffness))
    (folder / "bad.csv").write_text("nothing")
    return folder


@pytest.fixture
def calls(monkeypatch):
    """Ids of the shots that were characterised; the same curve is fitted once."""
    done: list[str] = []
    found: dict[tuple, dict] = {}

    def counted(traces, options):
        done.append(traces.ids[0])
        key = tuple(x.radius_m.numpy().tobytes() for x in traces)
        if key not in found:
            found[key] = characterize_shot(traces, options)
        return copy.deepcopy(found[key])

    monkeypatch.setattr(batch, "characterize_shot", counted)
    return done


def test_that_every_file_has_a_result_or_a_reason(shots, tmp_path):
    summary = run_shots(shots, folder=tmp_path / "out")
    assert [(row["shot"], row["status"]) for row in summary.rows] == [
        ("bad", "failed"),
        ("gel_0", "done"),
        ("gel_1", "done"),
        ("gel_2", "done"),
    ]
    assert "bad.csv: has the header nothing and no rows" in summary.rows[0]["error"]
    for row, truth in zip(summary.rows[1:], (4e3, 8e3, 1.6e4), strict=True):
        assert row["G_low"] < truth < row["G_high"]
        assert row["We"] == pytest.approx(200.0, rel=0.01)
        saved = SavedCharacterization.load(
            tmp_path / "out" / "shots" / f"{row['shot']}.json"
        )
        assert saved.intervals()["G"] == [row["G_low"], row["G"], row["G_high"]]
        assert saved.draws().weighted
    with (tmp_path / "out" / "summary.csv").open() as stream:
        read = list(csv.DictReader(stream))
    assert [float(row["G"]) for row in read[1:]] == [row["G"] for row in summary.rows[1:]]
    assert (
        summary.report().splitlines()[0] == "4 shot(s): 3 done, 0 not converged, 1 failed"
    )


def test_that_a_result_reopens_with_its_posterior_its_draws_and_its_table(shots, tmp_path):
    result = characterize(
        load_traces(shots / "gel_1.csv"),
        prior=OPTIONS.prior,
        simulator=OPTIONS.simulator,
        rest_radius=OPTIONS.rest_radius,
        estimate_noise=False,
        options=OPTIONS.options,
        medium=OPTIONS.medium,
    )
    result.save(tmp_path / "gel.json")
    assert main(f"plot {tmp_path}/gel.json --format png --quiet".split()) == 0
    assert (tmp_path / "parameter_G.png").exists()
    saved = SavedCharacterization.load(tmp_path / "gel.json")
    assert saved.posterior.to_dict() == result.posterior.to_dict()
    assert saved.prior.to_dict() == OPTIONS.prior.to_dict()
    fit = result.assimilation["nhkv"]
    draws = saved.draws()
    assert_close(draws.weights, fit.sample.weights)
    mean = draws.weights @ draws.values
    assert_close(mean, result.posterior["nhkv"].means, rtol=0.02, atol=0.0)
    assert saved.verdict() == fit.verdict.name.lower()
    assert saved.converged() == fit.certificate.converged
    frame = result.to_dataframe()
    assert list(frame["parameter"]) == ["G", "mu"]
    assert frame.equals(saved.to_dataframe())


def test_that_the_workbook_holds_the_table(shots, tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    summary = run_shots(shots / "gel_1.csv", folder=tmp_path)
    (sheet,) = openpyxl.load_workbook(tmp_path / "summary.xlsx").worksheets
    head, line = sheet.iter_rows(values_only=True)
    assert head == summary.columns
    wanted = [summary.rows[0].get(name) for name in head]
    for found, value in zip(line, wanted, strict=True):  # a workbook keeps 16 digits
        assert found == (pytest.approx(value) if isinstance(value, float) else value)


def test_that_a_run_goes_on_with_what_is_missing_or_has_changed(shots, tmp_path, calls):
    out = tmp_path / "out"
    first = run_shots(shots, folder=out)
    assert calls == ["gel_0", "gel_1", "gel_2"]
    again = run_shots(shots, folder=out)
    assert len(calls) == 3
    assert again == first
    (out / "shots" / "gel_1.json").unlink()
    (out / "shots" / "gel_0.json").write_text('{"key": "cut off')
    run_shots(shots, folder=out)
    assert sorted(calls[3:]) == ["gel_0", "gel_1"]
    (shots / "gel_2.csv").write_text(curve(2e4))
    changed = run_shots(shots, folder=out)
    assert calls[5:] == ["gel_2"]
    assert changed.rows[3]["G"] > first.rows[3]["G"]
    (shots / "gel_2.json").write_text(json.dumps({"medium": "agarose"}))
    run_shots(shots, folder=out)
    assert calls[6:] == ["gel_2"]
    other = replace(OPTIONS, seed=1)
    run_shots(shots, folder=out, options=other)
    assert calls[7:] == ["gel_0", "gel_1", "gel_2"]


def test_that_an_interrupted_run_keeps_what_is_done(shots, tmp_path, monkeypatch):
    out = tmp_path / "out"
    done = []

    def interrupted(traces, options):
        if len(done) == 1:
            raise KeyboardInterrupt
        done.append(traces.ids[0])
        return characterize_shot(traces, options)

    monkeypatch.setattr(batch, "characterize_shot", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_shots(shots, folder=out)
    assert [path.name for path in (out / "shots").iterdir()] == ["gel_0.json"]
    assert len((out / "summary.csv").read_text().splitlines()) == 3


def test_that_a_file_that_turns_bad_loses_its_old_result(shots, tmp_path):
    run_shots(shots / "gel_0.csv", folder=tmp_path)
    (shots / "gel_0.csv").write_text("t,R\n")
    summary = run_shots(shots / "gel_0.csv", folder=tmp_path)
    assert summary.rows[0]["status"] == "failed"
    assert list((tmp_path / "shots").iterdir()) == []


def test_that_any_executor_gives_the_same_results(shots, tmp_path):
    alone = run_shots(shots, folder=tmp_path / "a")
    with ThreadPoolExecutor(2) as executor:
        together = run_shots(shots, folder=tmp_path / "b", executor=executor)
    drop = {"cpu_seconds"}
    for a, b in zip(alone.rows, together.rows, strict=True):
        assert {k: v for k, v in a.items() if k not in drop} == {
            k: v for k, v in b.items() if k not in drop
        }


def test_that_a_worker_that_dies_costs_its_own_shot_alone(shots, tmp_path, monkeypatch):
    monkeypatch.setattr(batch, "characterize_shot", fatal)
    summary = run_shots(
        shots, folder=tmp_path / "out", executor=partial(process_pool, 1), window=2
    )
    errors = {row["shot"]: row["error"] for row in summary.rows}
    assert errors["gel_0"] == "gel_0 was here"
    assert errors["gel_2"] == "gel_2 was here"
    assert "the worker that had it ended; give it more memory" in errors["gel_1"]


def test_that_an_error_of_any_kind_in_a_shot_is_its_own(shots):
    broken = replace(OPTIONS, simulator=object())
    document = characterize_shot(load_traces(shots / "gel_0.csv"), broken)
    assert list(document) == ["error"]


def test_that_curves_of_a_file_are_one_shot_or_each_its_own(tmp_path, calls):
    lines = curve(8e3).splitlines()[1:]
    (tmp_path / "gel.csv").write_text(
        "t (us),R1 (um),R2 (um)\n" + "".join(f"{x},{x.split(',')[1]}\n" for x in lines)
    )
    together = run_shots(tmp_path / "gel.csv", folder=tmp_path / "a")
    assert [(row["shot"], row["curves"]) for row in together.rows] == [("gel", 2)]
    each = run_shots(
        tmp_path / "gel.csv",
        folder=tmp_path / "b",
        options=replace(OPTIONS, each=True),
    )
    assert [(row["shot"], row["curves"]) for row in each.rows] == [
        ("gel_R1__um_", 1),
        ("gel_R2__um_", 1),
    ]
    first = read_json(tmp_path / "b" / "shots" / "gel_R1__um_.json")
    command = f"diagnose {tmp_path}/gel.csv --experiments 'R1 (um)' --html diagnosis.html"
    assert first["fit_test"]["command"] == f"imr-torch {command}"
    failed = replace(OPTIONS, collapses=0)
    error = characterize_shot(load_traces(tmp_path / "gel.csv"), failed)["error"]
    assert "None of the 2 curves of the file was fitted; with --each every one is" in error
    assert each.rows[0]["G_high"] - each.rows[0]["G_low"] > 1.2 * (
        together.rows[0]["G_high"] - together.rows[0]["G_low"]
    )


def test_that_files_of_one_name_have_results_of_their_own(tmp_path, calls):
    for day in ("day1", "day2"):
        (tmp_path / day).mkdir()
        (tmp_path / day / "gel.csv").write_text("t,R\n")
    summary = run_shots(
        tmp_path / "day1", tmp_path / "day2", folder=tmp_path / "out", options=OPTIONS
    )
    assert [row["shot"] for row in summary.rows] == ["day1_gel_csv", "day2_gel_csv"]


ROWS = (
    {
        "shot": "a<b",
        "status": "done",
        "file": "a",
        "curves": 1,
        "frames": 9,
        "We": 300.0,
        "R_inf*": 0.2,
        "model": "nhkv",
    }
    | {
        "probability": 1.0,
        "rmse": 0.01,
        "G_low": 4e3,
        "G": 5e3,
        "G_high": 6e3,
        "mu_low": 0.1,
        "mu": 0.2,
        "mu_high": 0.3,
    },
    {"shot": "b", "status": "failed", "file": "b", "error": "no <bubble>"},
)


def test_that_the_page_has_a_line_a_shot_and_a_plot_a_parameter():
    text = document_page(header("batch") | BatchSummary(ROWS).to_dict())
    # two tables of a head and a row
    assert text.partition("<details>")[0].count("<tr") == 4
    assert text.count("data:image/png;base64,") == 2
    assert "a&lt;b" in text
    assert "no &lt;bubble&gt;" in text
    assert "5 (4 to 6)" in text  # kPa
    ax = plot_shots(ROWS, "G")
    assert ax.get_ylabel() == "$G$ (kPa)"
    assert [label.get_text() for label in ax.get_xticklabels()] == ["a<b"]


def test_that_shots_whose_curves_the_model_does_not_explain_are_not_to_be_quoted():
    misfit = ROWS[0] | {"explained": "no"}
    assert is_usable(ROWS[0])
    assert not is_usable(misfit)
    summary = BatchSummary((misfit,))
    times = ROWS[1] | {"error": "x.csv: holds collapse times and no curves"}
    page = document_page(header("batch") | BatchSummary((misfit, times)).to_dict())
    advice = page.partition("What to do next")[2]
    assert "Give the 1 file(s) of collapse times to imr-torch characterize" in advice
    assert "Look at the 1 orange shot(s)" in advice
    assert "Correct the" not in advice
    assert '<tr class="marked">' in page
    said = "the model does not explain the curves of 1, whose numbers are not to be quoted"
    assert said in summary.report()


COMMAND = [
    "--models",
    "nhkv",
    "--physics",
    "polytropic",
    "--quiet",
    "--rest-radius",
    "0.2:0.002",
    "--noise",
    "published",
]


def test_that_the_command_writes_all_and_tells_of_failures(
    shots, tmp_path, capsys, said_by
):
    out = tmp_path / "out"
    command = [*f"batch {shots} --out {out} --workers 1".split(), *COMMAND]
    command += ["--medium", "density=1060"]
    assert main(command) == 2
    captured = capsys.readouterr()
    assert "4 shot(s): 3 done, 0 not converged, 1 failed" in captured.out
    assert (
        "1 of 4 shots have no result, for the reasons above; the others are written"
        in captured.err
    )
    figures = {f"shots_{name}.{kind}" for name in ("G", "mu") for kind in ("png", "pdf")}
    tables = {path.name for path in out.glob("summary.xlsx")}
    assert {path.name for path in out.iterdir()} == figures | tables | {
        "shots",
        "summary.csv",
        "summary.html",
        "batch.json",
    }
    assert len(read_json(out / "batch.json")["shots"]) == 4
    (shots / "bad.csv").unlink()
    assert "3 shot(s): 3 done, 0 not converged, 0 failed" in said_by(command)
    results = [str(out / "shots" / f"gel_{i}.json") for i in (0, 2)]
    said = said_by(["compare", *results, "--json", str(tmp_path / "compare.json")])
    found = read_json(tmp_path / "compare.json")
    ratio = f"{found['parameters'][0]['ratio_median']:.3g}"
    assert f"The gels differ: G of a is {ratio} (90 %: " in said
    assert found["verdict"] == "different"
    assert found["parameters"][0]["ratio_median"] == pytest.approx(0.25, rel=0.1)


def test_that_a_scheduler_that_does_not_answer_is_named(
    shots, tmp_path, said_by, monkeypatch
):
    pytest.importorskip("distributed")
    monkeypatch.setattr("imr_torch.cli.batch.ANSWER_WITHIN", 1)
    assert "--cluster: no scheduler answers at 'tcp://127.0.0.1:9'" in said_by(
        [
            *f"batch {shots} --out {tmp_path}/out --cluster tcp://127.0.0.1:9".split(),
            *COMMAND,
        ],
        2,
    )


def test_that_no_more_shots_than_the_window_are_in_hand(shots, tmp_path, calls):
    class Counting(ThreadPoolExecutor):
        handed = most = 0

        def submit(self, *args, **kwargs) -> Future:
            self.handed += 1
            self.most = max(self.most, self.handed)
            future = super().submit(*args, **kwargs)
            future.add_done_callback(lambda _: setattr(self, "handed", self.handed - 1))
            return future

    with Counting(1) as executor:
        run_shots(shots, folder=tmp_path / "out", executor=executor, window=2)
    assert executor.most <= 2
    assert sorted(calls) == ["gel_0", "gel_1", "gel_2"]


def test_that_the_workers_of_a_dask_cluster_do_it(shots, tmp_path, capsys):
    distributed = pytest.importorskip("distributed")
    place = {
        "n_workers": 1,
        "threads_per_worker": 1,
        "processes": False,
        "dashboard_address": None,
    }
    with distributed.LocalCluster(protocol="tcp://", host="127.0.0.1", **place) as cluster:
        arguments = [
            *f"batch {shots} --out {tmp_path}/out --cluster".split(),
            cluster.scheduler_address,
        ]
        assert main([*arguments, *COMMAND]) == 2
    assert "4 shot(s): 3 done, 0 not converged, 1 failed" in capsys.readouterr().out
