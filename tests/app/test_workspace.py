"""The folder of the application keeps every file, and says of each whether it can be used."""

import pytest

from imr_torch import example_gel, load_traces
from imr_torch.app.workspace import LARGEST_FILE, Workspace, check_name
from imr_torch.errors import InputDataError
from imr_torch.files import read_json
from imr_torch.observe import prepare, state
from tests.refusals import refused


@pytest.fixture
def made(tmp_path):
    made = Workspace(tmp_path / "gel")
    made.add_example()
    return made


@pytest.mark.parametrize(
    ("name", "size", "text"),
    [
        ("run.exe", 10, r"run\.exe: files of curves end in \.csv"),
        ("..", 10, "is no name of a file"),
        (".hidden.csv", 10, "is no name of a file"),
        ("a\nb.csv", 10, "is no name of a file"),
        (f"{'x' * 200}.csv", 10, "is no name of a file"),
        ("gel.csv", 0, "has 0 bytes; expected 1 to"),
        ("gel.csv", LARGEST_FILE + 1, "bytes; expected 1 to"),
    ],
)
def test_that_names_and_sizes_are_checked(name, size, text):
    with refused(text):
        check_name(name, size)


def test_that_no_name_leaves_the_folder(made, tmp_path):
    made.add_file("../../elsewhere/a.csv", b"x")
    made.add_file("C:\\gels\\b.csv", b"x")
    assert {path.name for path in made.files_folder.iterdir()} == {
        "example_gel.csv",
        "example_gel.json",
        "a.csv",
        "b.csv",
    }
    assert not (tmp_path / "elsewhere").exists()


def test_that_a_file_that_cannot_be_used_is_named_and_costs_no_other(made, tmp_path):
    made.add_file("bad.csv", b"time,radius\n0,1\n")
    made.add_file("bad.json", b"{}")
    made.add_file("lone.json", b"{}")
    bad, good, lone = made.list_files()
    assert (lone.name, "there is none" in lone.problem) == ("lone.json", True)
    assert (bad.name, good.name, good.curves) == ("bad.csv", "example_gel.csv", 4)
    assert "bad.csv" in bad.problem
    assert str(tmp_path) not in bad.problem
    assert made.list_usable() == ["files/example_gel.csv"]
    assert len(made.load_curves()) == 4


def test_that_a_replaced_file_is_set_aside(made):
    before = (made.files_folder / "example_gel.csv").read_bytes()
    assert made.add_file("example_gel.csv", before) == "example_gel.csv is there already."
    said = made.add_file("example_gel.csv", before + b"\n")
    (kept,) = (made.folder / "set_aside").iterdir()
    assert kept.name in said
    assert kept.read_bytes() == before


def test_that_what_is_taken_out_is_kept_with_the_json_beside_it(made):
    made.take_out("example_gel.csv")
    assert not list(made.files_folder.iterdir())
    assert len(list((made.folder / "set_aside").iterdir())) == 2


def test_that_a_folder_is_found_again_as_it_was_left(made):
    made.change_setting("medium", "water,temperature=310")
    made.change_setting("layout", "")
    again = Workspace(made.folder)
    assert again.settings == {"layout": "", "medium": "water,temperature=310"}
    assert again.find_medium().surroundings.temperature == 310.0


def test_that_wrong_statements_change_nothing(made):
    with refused("density is 1; expected"):
        made.change_setting("medium", "density=1")
    with pytest.raises(InputDataError):
        made.change_setting("layout", "radius")
    assert made.settings == {"layout": "", "medium": ""}


def test_that_a_curve_is_shown_as_the_commands_fit_it(made):
    view = made.view_curve("shot_2", 2)
    prepared = prepare(load_traces(example_gel()).select(["shot_2"]))
    assert view.fitted[1] - view.fitted[0] + 1 == len(prepared.experiments[0].times)
    assert view.report == prepared.report().splitlines()[1].strip()


def test_that_what_is_stated_is_what_the_commands_read(made):
    view = made.view_curve("shot_2", 2)
    state(
        view.trace.source, "shot_2", {"Rinf_m": 6e-5, "Rinf_sd_m": 1e-6}, alone=view.alone
    )
    assert made.view_curve("shot_2", 2).landmarks.rest_method == "as stated"
    (entry,) = [
        e
        for e in read_json(made.files_folder / "example_gel.json")["experiments"]
        if "override" in e
    ]
    assert (entry["experiment_id"], entry["override"]) == (
        "shot_2",
        {"Rinf_m": 6e-5, "Rinf_sd_m": 1e-6},
    )
    state(view.trace.source, "shot_2", {"window_end_s": 1e-9}, alone=view.alone)
    broken = made.view_curve("shot_2", 2)
    assert broken.fitted is None
    assert "State a later window_end_s" in broken.report
