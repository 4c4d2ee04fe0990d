"""Progress as a person meets it: one line with stage, step and time left; details only when asked
for.
"""

import io
import itertools
import json
import re
import sys
from types import SimpleNamespace

import pytest

from imr_torch.assimilate import NOISE_ROUNDS
from imr_torch.cli import main
from imr_torch.cli.progress import Terminal
from imr_torch.progress import ProgressLine, within


def iteration(number: int, detail: str = "nhkv cost 1") -> ProgressLine:
    step = f"iteration {number}"
    return ProgressLine(f"assimilation: {step}, {detail}", step=step)


def stage(key: str, text: str) -> ProgressLine:
    return ProgressLine(text, stage=key)


LONG = iteration(4, ", ".join(f"model{i} cost -606.92 gradient 5.6e+01" for i in range(30)))


def terminal(command="simulate", *, live=False, figures=True, **options):
    stream = io.StringIO()
    clock = SimpleNamespace(now=0.0)
    options |= {"stream": stream, "clock": lambda: clock.now}
    made = Terminal(command, live=live, **options)
    made.plan_stages(noise=True, curves=True, figures=figures)
    return made, stream, clock


def test_that_stage_step_and_time_left_are_said():
    made, stream, clock = terminal("characterize")
    assert [x.key for x in made.stages].count("noise") == NOISE_ROUNDS
    made(LONG)
    clock.now = 20.0
    made(stage("noise", "noise 0.09 x the published law"))
    made(iteration(2))
    assert (
        made.describe_state()
        == "characterize, stage 2 of 6, 0:20, 10 %, about 3:02 left: fit with the estimated noise (round 1 of 2), iteration 2"
    )
    clock.now = 25.0
    # less, though nothing was counted meanwhile
    assert "about 2:57 left" in made.describe_state()
    clock.now = 60.0  # longer than planned: the stages that follow will be too
    assert "about 4:37 left" in made.describe_state()
    made(stage("noise", "noise 0.06 x the published law"))
    made(stage("fit test", "fit test: does the model explain the curves?"))
    assert "stage 5 of 6, " in made.describe_state()
    assert max(map(len, stream.getvalue().splitlines())) <= 116
    assert "cost" not in stream.getvalue()


def test_that_no_time_left_is_said_where_the_last_stage_lasts_longer_than_planned():
    made, _, clock = terminal("characterize", figures=False)
    clock.now = 20.0
    made(stage("noise", "noise 1"))
    made(stage("fit test", "fit test: does the model explain the curves?"))
    clock.now = 500.0
    assert "left" not in made.describe_state()


def test_that_counted_steps_give_the_time_left():
    made, _, clock = terminal("design")
    clock.now = 10.0
    text = "design 5/25: We  300.0  R_inf* 0.200  EIG 1.0 +- 0.1 nats"
    made(ProgressLine(text, step="design", done=5, of=25))
    assert (
        made.describe_state()
        == "design, 0:10, 20 %, about 0:40 left: search of designs, design 5 of 25"
    )


def test_that_a_stage_that_is_skipped_is_passed_over_and_leaves_its_time_out():
    made, _, clock = terminal("diagnose")
    clock.now = 10.0
    made(stage("figures", "gap test: p = 0.5"))
    assert "stage 4 of 4, 0:10, 71 %, about 0:04 left" in made.describe_state()


def test_that_more_selections_than_were_expected_take_more_time_and_less_are_done_with():
    made, _, clock = terminal("diagnose")
    clock.now = 10.0
    made(stage("effects", "attribution"))
    search = ProgressLine("search", step="16 of 32 models fitted", part=0.5)
    clock.now = 40.0
    within(made, 0.0, 1.0, name="first cause")(search)  # half of a selection of 7.5 shares
    assert (
        "0:40, 37 %, about 1:09 left: causes (longer if none is enough), first cause, 16 of"
        in made.describe_state()
    )
    # the first one and a half
    within(made, 0.5, 1.0, name="second cause", size=2.0)(search)
    assert (
        "0:40, 60 %, about 0:27 left: causes (longer if none is enough), second"
        in made.describe_state()
    )
    within(made, 0.2, 0.4, size=5.0)(search)  # what is done stays done
    assert "0:40, 29 %, about 1:40 left" in made.describe_state()
    made(stage("location", "location"))
    assert "stage 3 of 4, 0:40, 74 %, about 0:14 left" in made.describe_state()


def test_that_a_log_gets_a_line_per_stage_and_one_every_half_minute():
    made, stream, clock = terminal("characterize")
    for second in range(65):
        clock.now = float(second)
        made(iteration(second + 1))
    made(stage("noise", "noise 1"))
    assert len(stream.getvalue().splitlines()) == 4  # at 0, 30, 60 s, and the second stage


def test_that_a_log_says_a_stage_when_it_begins_though_time_passes_meanwhile():
    made, stream, _ = terminal("characterize")
    made.clock = itertools.count().__next__
    made(LONG)
    made(stage("noise", "noise 0.09 x the published law"))
    assert "stage 2 of 6" in stream.getvalue()


def test_that_verbose_prints_every_line_as_it_is_and_quiet_none():
    made, stream, _ = terminal(verbose=True)
    made(LONG)
    assert stream.getvalue() == f"[   0.0 s] {LONG}\n"
    made, stream, _ = terminal(quiet=True)
    made(LONG)
    assert stream.getvalue() == ""


def test_that_the_line_rewrites_itself_and_is_wiped_before_results(monkeypatch):
    out = io.StringIO()
    monkeypatch.setattr(sys, "stdout", out)
    made, stream, _ = terminal("diagnose", live=True)
    with made:
        made(iteration(1))
        made(iteration(12))
        print("result")
        assert stream.getvalue().endswith(" \r")
    assert sys.stdout is out
    assert out.getvalue() == "result\n"
    assert "\n" not in stream.getvalue()
    assert len(re.findall("\rdiagnose", stream.getvalue())) >= 2


def test_that_the_line_moves_while_nothing_is_reported():
    made, stream, clock = terminal("diagnose", live=True, every=0.01)
    with made:
        made(iteration(1))
        clock.now = 61.0
        for _ in range(200):
            if "1:01" in stream.getvalue():
                break
            made._stop.wait(0.01)
    assert "stage 1 of 4, 1:01: fit" in stream.getvalue()


def test_that_a_program_gets_events_with_the_part_that_is_done():
    made, stream, clock = terminal("design", events=True)
    made("evidence of each model")
    clock.now = 10.0
    made(ProgressLine("design 5/25: We  300.0", step="design", done=5, of=25))
    first, second = map(json.loads, stream.getvalue().splitlines())
    assert first["part"] is None
    assert second == {"line": made.describe_state(), "part": 0.2}


@pytest.mark.parametrize(("option", "shown"), [([], False), (["--verbose"], True)])
def test_that_a_command_shows_details_only_when_asked(option, shown, capsys):
    design = "design --case soft-pa --we-range 200:400 --evaluations 3 --draws 2"
    assert main([*f"{design} --physics polytropic".split(), *option]) == 0
    said = capsys.readouterr().err
    assert ("EIG" in said) is shown
    assert (": search of designs, design 1 of 3" in said) is not shown
