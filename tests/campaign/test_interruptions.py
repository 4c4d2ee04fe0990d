"""Killed or out of disk at any operation on any file, a campaign is resumed to the journal of an uninterrupted one, bit for bit."""

import os
import shutil
import signal
from contextlib import suppress

import pytest

from benchmarks.interruptions import Disk, compare, forked, left_over
from imr_torch.campaign import Campaign
from tests.campaign.test_telling import campaign, shoot
from tests.journals import cut, needs_fork
from tests.linear import tensor


def simulated(folder) -> int:
    """Three experiments, two of which are chosen and told together."""
    campaign(folder).run(shoot, 3, q=2)
    return 0


CURVES = [shoot(tensor(300.0 + 100.0 * n, 0.2), n) for n in range(3)]


def told(folder) -> int:
    """A user who tells a curve, tells two, forgets one and tells it again, and does each only once it is not in the journal."""
    run = campaign(folder)
    if run.told < 1:
        run.tell(CURVES[0])
    if run.told < 3:
        run.tell(CURVES[1], CURVES[2])
    if run.told == 3:
        if 2 in run.numbers:
            run.learn_outstanding()
            run.forget(2)
        run.tell(CURVES[1])
    if run.outstanding:
        run.learn_outstanding()
    run.ask()
    return 0


EVERY = int(
    os.environ.get("IMR_TORCH_INTERRUPT_EVERY", "11")
)  # operations; 1 for all of them, which takes minutes
WORK = {"simulated": simulated, "told": told}


@pytest.fixture(scope="module", params=WORK)
def whole(request, tmp_path_factory):
    """What is done, its uninterrupted folder and the number of its operations."""
    folder = tmp_path_factory.mktemp("interruptions") / "whole"
    work = WORK[request.param]
    with Disk().watched() as disk:
        work(folder)
    assert left_over(folder) == []
    return work, folder, disk.done


@needs_fork
def test_that_a_campaign_killed_at_any_operation_is_resumed_to_the_same_journal(
    whole, tmp_path
):
    work, folder, count = whole
    assert count > 80
    for at in range(1, count + 1, EVERY):
        trial = tmp_path / "trial"
        shutil.rmtree(trial, ignore_errors=True)
        assert forked(lambda: work(trial), Disk(at, "kill")).code == -signal.SIGKILL  # noqa: B023
        work(trial)
        assert compare(trial, folder) is None, at
        assert campaign(trial).belief.to_dict() == campaign(folder).belief.to_dict()


def test_that_a_campaign_whose_disk_is_full_from_any_operation_on_is_resumed_to_the_same_journal(
    whole, tmp_path
):
    work, folder, count = whole
    for at in range(2, count + 1, EVERY):
        trial = tmp_path / "trial"
        shutil.rmtree(trial, ignore_errors=True)
        with suppress(OSError), Disk(at, "full").watched():
            work(trial)
        campaign(trial)
        work(trial)
        assert compare(trial, folder) is None, at


def test_that_a_campaign_cut_within_any_line_is_resumed_to_the_same_journal(
    whole, tmp_path
):
    work, folder, _ = whole
    lines = (folder / "journal.jsonl").read_bytes().splitlines()
    for events in range(len(lines)):
        for torn in (0.0, 0.5, 1.0):
            trial = cut(folder, tmp_path / f"{events}_{torn}", events, torn)
            work(trial)
            assert compare(trial, folder) is None, (events, torn)


def test_that_ctrl_c_is_one_line_that_says_what_is_kept_and_how_to_go_on(
    tmp_path, said_by, monkeypatch
):
    out = tmp_path / "gel"
    shots = "--case soft-pa --policy random --designs 1"
    base = f"campaign {shots} --physics polytropic --quiet --out {out}".split()

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(Campaign, "learn_outstanding", interrupted)
    said = said_by(base, 130)
    assert (
        said
        == f"imr-torch: interrupted; what was finished is in {out / 'journal.jsonl'}, continue with --resume\n"
    )
    text = (out / "journal.jsonl").read_text()
    assert [kind in text for kind in ('"ask"', '"observed"', '"learnt"')] == [
        True,
        True,
        False,
    ]
