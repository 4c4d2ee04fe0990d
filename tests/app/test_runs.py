"""Commands of the application: what they write is kept, how they end is known, and they can be
stopped.
"""

import io
import json
import os
import signal
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from imr_torch.app.commands import (
    FORMS,
    OF_THE_FOLDER,
    OPTIONS,
    command_arguments,
    list_defaults,
    read_arguments,
)
from imr_torch.app.runs import Result, Run, Runs
from imr_torch.app.workspace import Workspace
from imr_torch.cli import build_parser


def runs(tmp_path: Path) -> Runs:
    return Runs(Workspace(tmp_path).folder)


def simulate(folder: str) -> list[str]:
    values = "--set G=5000,mu=0.1 --we 300 --physics polytropic"
    return f"simulate --model nhkv {values} --json {folder}/simulate.json".split()


def slow(folder: str) -> list[str]:
    return (
        f"design --case stiff-pa --evaluations 400 --physics polytropic --json {folder}/design.json"
    ).split()


def begun(all_runs: Runs, arguments: Callable[[str], list[str]], kind: str) -> Run:
    all_runs.add_run(arguments, kind)
    return all_runs.current


def finished(run: Run) -> None:
    run.join(120.0)
    assert not run.is_alive()


def result_of(all_runs: Runs, name: str) -> Result:
    return all_runs.list_results()[name]


def wait_while(condition: Callable[[], object]) -> None:
    until = time.monotonic() + 120.0
    while condition() and time.monotonic() < until:
        time.sleep(0.1)


def recorded(tmp_path: Path, name: str, record: str) -> Path:
    """The folder of a run of an earlier session."""
    folder = tmp_path / "results" / name
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(record)
    return folder


def test_that_a_refused_command_keeps_its_message(tmp_path):
    all_runs = runs(tmp_path)
    finished(begun(all_runs, lambda _: ["characterize", "files/none.csv"], "characterize"))
    (result,) = all_runs.list_results().values()
    assert (result.status, result.outcome) == (2, "the input cannot be used")
    assert "none.csv" in result.read_text_of("messages.txt")


@dataclass(frozen=True)
class Seen:
    """What was seen of one run that was stopped, of one taken back that waited for it, and of one
    that went on twice in a folder that it was told.
    """

    runs: Runs
    part: float | None
    waiting: list[str]
    before: list[str]
    ended: dict[str, str]
    taken_back: Path


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """Each run loads the libraries anew, so that few serve several tests."""
    all_runs = runs(tmp_path_factory.mktemp("runs"))
    first = begun(all_runs, slow, "design")
    second = all_runs.add_run(simulate, "simulate")
    all_runs.add_run(simulate, "simulate", "results/007_simulate")
    assert all_runs.current is first
    waiting = [result.name for result in all_runs.waiting]
    wait_while(lambda: first.part is None and first.is_alive())
    part = first.part
    before = list(all_runs.list_results())
    all_runs.take_back(second)
    first.stop()
    finished(first)
    wait_while(lambda: all_runs.current or all_runs.waiting)
    ended = {name: x.outcome for name, x in all_runs.list_results().items()}
    return Seen(all_runs, part, waiting, before, ended, second.folder)


def test_that_a_run_shows_progress_and_can_be_stopped(seen):
    assert 0.0 < seen.part < 1.0
    assert result_of(seen.runs, "001_design").status == 130


def test_that_runs_wait_for_those_before_them_and_can_be_taken_back(seen):
    assert seen.waiting == ["002_simulate", "007_simulate"]
    assert seen.before == []
    names = ("001_design", "002_simulate", "007_simulate")
    assert seen.ended == dict(zip(names, ("stopped", "stopped", "done"), strict=True))
    assert not (seen.taken_back / "simulate.json").exists()


def test_that_a_run_leaves_its_files_output_and_record(seen):
    result = result_of(seen.runs, "007_simulate")
    assert result.status == 0
    assert "smallest sampled R*" in result.read_text_of("output.txt")
    assert result.arguments[:3] == ("simulate", "--model", "nhkv")
    with zipfile.ZipFile(io.BytesIO(result.zip_files())) as file:
        assert {"007_simulate/simulate.json", "007_simulate/run.json"} <= set(
            file.namelist()
        )
        assert json.loads(file.read("007_simulate/simulate.json"))["model"] == "nhkv"


def test_that_a_run_goes_on_in_an_earlier_folder_where_it_is_told_to(seen):
    all_runs = seen.runs
    all_runs.add_run(simulate, "simulate", "results/007_simulate")
    finished(all_runs.current)
    assert sorted(all_runs.list_results()) == sorted(seen.ended)


def test_that_a_run_stopped_before_it_began_leaves_no_trace_of_its_code(tmp_path):
    all_runs = runs(tmp_path)
    run = begun(all_runs, slow, "design")
    run.stop()
    finished(run)
    (result,) = all_runs.list_results().values()
    assert (result.outcome, "Traceback" in result.read_text_of("messages.txt")) == (
        "stopped",
        False,
    )


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs a system with signals")
def test_that_a_run_that_the_system_ended_is_not_called_stopped(tmp_path):
    all_runs = runs(tmp_path)
    run = begun(all_runs, slow, "design")
    os.kill(run._process.pid, signal.SIGKILL)
    finished(run)
    (result,) = all_runs.list_results().values()
    assert result.outcome == "ended by the system (signal 9); it may have run out of memory"


def test_that_a_run_that_ended_with_the_application_is_known_as_interrupted(tmp_path):
    record = '{"arguments": ["diagnose"], "started": "2026-01-01", "status": null}'
    recorded(tmp_path, "007_diagnose", record)
    all_runs = runs(tmp_path)
    assert [x.outcome for x in all_runs.list_results().values()] == ["interrupted"]
    assert all_runs.next_folder("design") == "results/008_design"


FILES = ["files/a.csv", "files/b.csv"]


def arguments_of(command: str, values: dict) -> list[str]:
    files = FILES if FORMS[command].reads_files else []
    needed = {"compare": {"a": "a.json", "b": "b.json"}}.get(command, {})
    return command_arguments(command, needed | values, "results/001", files=files)


@pytest.mark.parametrize(
    ("command", "values"),
    [
        (
            "characterize",
            {
                "layout": "radius=R,radius_unit=um",
                "medium": "water,temperature=310",
                "experiments": ["x", "y"],
                "models": ["nhkv"],
                "known": "G=2770",
                "physics": "polytropic",
                "collapses": 1,
                "rest_radius": "0.2:0.05",
                "population": True,
            },
        ),
        (
            "diagnose",
            {
                "base": "zener",
                "known": "G=1",
                "physics": "polytropic",
                "collapses": 3,
                "rest_radius": "0.2:0",
                "most": 2,
            },
        ),
        (
            "design",
            {
                "belief": "results/1/characterize.json",
                "medium": "water",
                "physics": "polytropic",
                "we_range": "200:300",
                "rinf_range": "0.15:0.2",
                "target": "model",
                "q": 3,
                "evaluations": 7,
            },
        ),
        (
            "characterize",
            {"models": ["nhkv", "gent+cross"], "growth": 0.6, "over_time": True},
        ),
        ("diagnose", {"without": ["wall"], "most": 2, "experiments": ["x", "y"]}),
        ("batch", {"each": True, "noise": "published"}),
        ("compare", {"model": "nhkv"}),
        ("design", {"until": "G:5%", "shots": 6, "models": ["nhkv"]}),
        ("campaign", {"tell": FILES, "stop": "G:5%,mu:5%"}),
        *(
            (command, values)
            for command in FORMS
            for values in FORMS[command].presets.values()
        ),
    ],
)
def test_that_a_command_takes_what_its_form_makes_and_it_is_read_back(command, values):
    def joined(value: object) -> object:
        return ",".join(value) if isinstance(value, list) else value

    words = arguments_of(command, values)
    taken = vars(build_parser().parse_args(words))
    assert taken["out"] == "results/001"
    assert command == "batch" or taken["html"] == "results/001/page.html"
    read = read_arguments(words)
    for name, value in values.items():
        assert joined(taken[name]) == joined(value)
        if name in OF_THE_FOLDER:
            read[name] = value
        assert read[name] == value
    again = {name: value for name, value in read.items() if name not in ("a", "b")}
    assert arguments_of(command, again) == words


@pytest.mark.parametrize("command", FORMS)
def test_that_options_left_out_are_those_that_say_what_the_command_does_anyhow(command):
    read = vars(build_parser().parse_args(arguments_of(command, {})))
    defaults = list_defaults(command)
    assert not FORMS[command].reads_files or read["files"] == FILES
    for name in (
        OPTIONS[command].keys()
        - OF_THE_FOLDER
        - {*("models", "collapses", "continued", "a", "b")}
    ):
        assert (read[name] or "") == (defaults[name] or "")


@pytest.mark.parametrize("command", FORMS)
def test_that_every_option_of_a_command_is_in_its_form_or_that_of_the_folder(command):
    shown = {name for row in FORMS[command].rows for name in row}
    assert shown <= OPTIONS[command].keys()
    assert not shown & OF_THE_FOLDER


def test_that_a_campaign_goes_on_in_its_folder():
    values = {"continued": "results/003_campaign", "tell": ["files/shot.csv"]}
    words = command_arguments("campaign", values, "results/003_campaign")
    out = "results/003_campaign"
    told = f"campaign --tell files/shot.csv --resume --out {out} --html {out}/page.html"
    assert words == told.split()


def test_that_the_shots_of_a_batch_are_rows_with_numbers_that_can_be_read(tmp_path):
    record = '{"arguments": ["batch"], "started": "", "status": 0}'
    folder = recorded(tmp_path, "001_batch", record)
    (folder / "batch.json").write_text(
        '{"shots": [{"shot": "a", "curves": 1, "G": 8123.456789}]}'
    )
    (result,) = runs(tmp_path).list_results().values()
    assert result.read_shots() == [{"shot": "a", "curves": 1, "G": 8123.0}]


def test_that_fields_of_models_read_no_results():
    pytest.importorskip("nicegui", reason="the extra 'app' is not installed")
    view = pytest.importorskip("imr_torch.app.view_run").RunView(None, None, print)
    assert "nhkv" in view._list_names("models")
