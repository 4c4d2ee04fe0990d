"""A journal is append-only: what was cut off is repaired, what was changed is refused by line, and
one process writes at a time.
"""

import os
import signal

import pytest

from benchmarks.interruptions import Disk, forked
from imr_torch.campaign import Journal
from imr_torch.errors import InputDataError
from tests.journals import cut, needs_fork
from tests.refusals import refused
from tests.tables import for_each

COUNT = 5


@pytest.fixture
def folder(tmp_path):
    journal = Journal(tmp_path / "whole")
    for number in range(COUNT):
        journal.append("note", step=number, value=0.1 * number)
    return journal.folder


def swapped(lines):
    return [lines[0], lines[2], lines[1], *lines[3:]]


CHANGES = {
    "edited": (
        lambda x: [*x[:2], x[2].replace(b'"step": 2', b'"step": 7'), *x[3:]],
        "line 3: its checksum does not fit",
    ),
    "swapped": (swapped, "line 2: its checksum does not fit"),
    "removed": (lambda x: [*x[:2], *x[3:]], "line 3: its checksum does not fit"),
    "five": (
        lambda x: [x[0], b"5\n", *x[2:]],
        r"line 2: not a journal entry \(expected an object with an 'event', got '5'",
    ),
    "no text": (lambda x: [*x, b"\xff\xfe\n"], "line 6: not a journal entry"),
}


@for_each(("change", "message"), CHANGES)
def test_a_changed_journal_is_refused_by_line_and_with_a_remedy(folder, change, message):
    path = folder / "journal.jsonl"
    path.write_bytes(b"".join(change(path.read_bytes().splitlines(keepends=True))))
    before = path.read_bytes()
    with pytest.raises(InputDataError, match=message) as refused:
        Journal(folder)
    assert "journal.jsonl" in str(refused.value)
    assert "Restore it from a copy" in str(refused.value)
    assert path.read_bytes() == before


def test_that_all_but_lines_removed_at_the_end_is_found(folder):
    path = folder / "journal.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:3]))
    assert len(Journal(folder).events) == 3
    path.write_bytes(b"".join(lines[1:]))
    with refused("line 1: its checksum"):
        Journal(folder)


def test_that_a_line_cut_at_any_byte_is_left_out_and_then_repaired(folder, tmp_path):
    whole = (folder / "journal.jsonl").read_bytes()
    last = whole.splitlines(keepends=True)[-1]
    for cut_at in range(len(last)):
        copy = cut(
            folder, tmp_path / f"cut{cut_at}", COUNT - 1, torn=(cut_at + 0.5) / len(last)
        )
        before = (copy / "journal.jsonl").read_bytes()
        journal = Journal(copy)
        assert (
            (copy / "journal.jsonl").read_bytes()
            == before
            == whole[: len(whole) - len(last) + cut_at]
        )
        if len(journal.events) < COUNT:
            journal.append("note", step=COUNT - 1, value=0.1 * (COUNT - 1))
        else:  # nothing but the end of the line was missing
            assert cut_at == len(last) - 1
            with journal.hold_lock():
                pass
        assert (copy / "journal.jsonl").read_bytes() == whole
        assert len(Journal(copy).events) == COUNT


def test_that_a_second_writer_is_told_who_holds_the_folder(folder):
    first = Journal(folder)
    second = Journal(folder)
    with first.hold_lock(), first.hold_lock():
        with refused(rf"whole is in use by another campaign \(process {os.getpid()} on "):
            second.append("note")
        first.append("note", text="mine")
    assert len(Journal(folder).events) == COUNT + 1


def test_that_what_was_opened_before_another_wrote_must_be_opened_again(folder):
    first = Journal(folder)
    second = Journal(folder)
    first.append("note")
    with refused("was written to since it was opened here; open the campaign again"):
        second.append("note")
    first.append("note")
    assert len(Journal(folder).events) == COUNT + 2
    first.path.unlink()
    with refused("was written to since it was opened"):
        first.append("note")


@needs_fork
def test_that_the_lock_ends_with_a_killed_process(folder):
    def work() -> int:
        with Journal(folder).hold_lock():
            os.kill(os.getpid(), signal.SIGKILL)
        return 0

    assert forked(work).code == -signal.SIGKILL
    assert ".journal.owner" in os.listdir(folder)
    Journal(folder).append("note")


def test_that_temporary_files_of_a_killed_process_are_removed_and_others_are_not(folder):
    left = [".experiment_002.npz.ab.tmp", ".experiment_003.npz.cd.tmp"]
    mine = [".notes.tmp", "experiment_003.npz"]
    for name in left + mine:
        (folder / name).touch()
    Journal(folder)
    assert set(left) <= set(os.listdir(folder))
    Journal(folder).append("note")
    assert not set(left) & set(os.listdir(folder))
    assert set(mine) <= set(os.listdir(folder))


def test_that_a_disk_that_is_full_from_any_operation_on_leaves_the_journal_as_before_or_with_the_event(
    folder,
):
    with Disk().watched() as counted:
        Journal(folder).append("note")
    assert counted.done == 4  # owner, line, its flush, owner
    for at in range(1, counted.done + 1):
        journal = Journal(folder)
        known = len(Journal(folder).events)
        before = journal.path.read_bytes()
        said = None
        try:
            with Disk(at, "full").watched():
                journal.append("note", text=f"try {at}")
        except OSError as error:
            said = str(error)
        assert said is None or (
            "the last event was not recorded" in said
            and journal.path.read_bytes() == before
        )
        assert [len(x.events) for x in (journal, Journal(folder))] in (
            [known] * 2,
            [known + 1] * 2,
        )
        # the same object may go on once there is room
        journal.append("note", text=f"again {at}")


def test_that_an_interrupt_in_a_write_leaves_the_journal_as_before(folder, monkeypatch):
    journal = Journal(folder)
    before = (folder / "journal.jsonl").read_bytes()

    def interrupted(_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", interrupted)
        with pytest.raises(KeyboardInterrupt):
            journal.append("note")
    assert journal.path.read_bytes() == before
    journal.append("note")


def test_that_a_number_that_is_not_finite_is_refused_before_anything_is_written(folder):
    before = (folder / "journal.jsonl").read_bytes()
    with refused("Event 'note' holds a number that is not finite"):
        Journal(folder).append("note", value=float("nan"))
    assert (folder / "journal.jsonl").read_bytes() == before
