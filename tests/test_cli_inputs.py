"""Targets are checked before any work, and what was finished is kept. Options that would have no effect: benchmarks/bad_inputs/options.txt."""

import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.bad_inputs.trial import Reached, without_fits
from imr_torch import characterize, example_gel, wide_prior
from imr_torch.cli import main
from imr_torch.files import check_target, read_json, write_json
from imr_torch.float64 import zeros
from imr_torch.material import Belief
from tests.refusals import refused

EXAMPLE = example_gel()
QUICK = ["--physics", "polytropic", "--quiet"]
FIT = [*f"characterize {EXAMPLE} --models nhkv --noise published".split(), *QUICK]


def test_that_a_known_parameter_is_not_inferred():
    part = wide_prior(["nhkv"], known={"mu": 0.1})["nhkv"]
    assert part.names == ("G",)
    assert part.known == {"mu": 0.1}
    assert Belief.from_dict(Belief((part,), zeros(1)).to_dict())["nhkv"].names == ("G",)
    # of qKV alone, which takes it as measured
    both = wide_prior(["nhkv", "qkv"], known={"G": 2770.0})
    assert both["nhkv"].names == ("G", "mu")
    assert both["qkv"].known == {"G": 2770.0}


@pytest.mark.parametrize(
    "spoil",
    [lambda time, radius: (time, 1e6 * radius), lambda time, radius: (1e3 * time, radius)],
    ids=["when it is read", "when it is prepared"],
)
def test_that_one_curve_that_cannot_be_used_is_left_out_as_the_message_says(
    spoil, tmp_path, capsys, said_by
):
    header, *rows = EXAMPLE.read_text().splitlines()
    first = [row.split(",")[1:] for row in rows if row.startswith("shot_1,")]
    spoilt = (spoil(float(time), float(radius)) for time, radius in first)
    rows += [f"bad,{time!r},{radius!r}" for time, radius in spoilt]
    path = tmp_path / "gel.csv"
    path.write_text("\n".join([header, *rows]))
    line = [*f"characterize {path} --models nhkv --medium density=1060".split(), *QUICK]
    said = said_by(line, 2)
    assert "One of several curves can be left out: --exclude bad" in said
    with without_fits(), pytest.raises(Reached):
        main([*line, *said.split()[-2:]])
    assert "bad" not in capsys.readouterr().out.partition("Curves as they are fitted")[2]


def test_that_the_only_curve_of_a_file_can_be_left_out(tmp_path, capsys, said_by):
    header, *rows = EXAMPLE.read_text().splitlines()
    files = []
    for name in ("shot_1", "shot_2"):
        files.append(str(tmp_path / f"{name}.csv"))
        own = [row for row in rows if row.startswith(f"{name},")]
        Path(files[-1]).write_text("\n".join([header, *own]))
    line = [
        *f"characterize {' '.join(files)} --models nhkv --medium density=1060".split(),
        *QUICK,
    ]
    with without_fits(), pytest.raises(Reached):
        main([*line, "--exclude", "shot_1"])
    assert "1 curve(s)" in capsys.readouterr().out
    for wrong in ("--exclude=shot_1,shot_2,none", "--experiments=none"):
        said = said_by([*line, wrong], 2)
        assert "No experiment 'none'" in said
        assert "can be left out" not in said


def test_that_a_fit_keeps_what_is_known_and_takes_the_experiments_that_are_named(tmp_path):
    document = tmp_path / "fit.json"
    some = f"--known mu=0.1 --experiments shot_1,shot_3 --json {document}"
    assert main([*FIT, *some.split()]) == 0
    result = read_json(document)
    assert [e["id"] for e in result["experiments"]] == ["shot_1", "shot_3"]
    assert list(result["models"]["nhkv"]["intervals"]) == ["G"]


def test_that_a_fit_that_has_not_converged_ends_with_its_status(
    tmp_path, said_by, monkeypatch
):
    module = sys.modules[characterize.__module__]
    whole = module.assimilate_estimating_noise

    def stopped(*args, **kwargs):
        found = whole(*args, **kwargs)
        certificate = found.fits[0].certificate
        object.__setattr__(certificate, "converged", False)
        return found

    monkeypatch.setattr(module, "assimilate_estimating_noise", stopped)
    document = tmp_path / "fit.json"
    assert "a fit has not converged" in said_by([*FIT, "--json", str(document)], 1)
    assert document.exists()


@pytest.mark.skipif(
    os.name != "posix", reason="devices, links and file modes are those of POSIX"
)
def test_that_files_have_the_usual_mode_and_devices_and_links_stay(tmp_path):
    write_json(tmp_path / "a.json", {"G": 1.0})
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == 0o666 & ~mask
    (tmp_path / "link.json").symlink_to(tmp_path / "a.json")
    write_json(tmp_path / "link.json", {"G": 2.0})
    assert (tmp_path / "link.json").is_symlink()
    assert json.loads((tmp_path / "a.json").read_text()) == {"G": 2.0}
    write_json(os.devnull, {"G": 1.0})
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    write_json(tmp_path / "pipe", {"G": 1.0})
    assert json.loads(os.read(reader, 100)) == {"G": 1.0}
    os.close(reader)
    assert not [name for name in os.listdir(tmp_path) if name.endswith(".tmp")]


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("", "--json is .* which is a folder; give another name"),
        (300 * "x", "--json has a name of 300 bytes; give one of 200 at most"),
        ("new/fit.json", "may not be written to; give another folder"),
    ],
)
def test_that_a_target_that_cannot_be_written_is_refused(
    tmp_path, monkeypatch, target, message
):
    """By every command: tests/bad_input/test_command_line.py."""
    # as root, permissions do not bind
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with refused(message):
        check_target(tmp_path / target, "--json")


def test_that_letters_a_terminal_lacks_do_not_end_the_command(tmp_path):
    table = EXAMPLE.read_text().replace("shot_1", "Schuss_\u00e4")
    (tmp_path / "gel.csv").write_text(table, encoding="utf-8")
    words = f"-m imr_torch characterize {tmp_path}/gel.csv --experiments nothing".split()
    env = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, *words], env=env, capture_output=True, text=True)
    assert done.returncode == 2
    assert "Schuss_\\xe4" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="needs a device that is always full"
)
def test_that_a_full_disk_and_a_closed_pipe_are_said_in_a_line(said_by):
    simulate = ["simulate", "--set", "G=1e4,mu=0.1", "--physics", "polytropic", "--json"]
    said = said_by([*simulate, "/dev/full"], 1)
    assert "No space left on device" in said
    assert "Traceback" not in said
    command = f"'{sys.executable}' -m imr_torch characterize --help | true"
    piped = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    assert "Traceback" not in piped.stderr


def test_that_an_interruption_is_said_in_a_line(monkeypatch, said_by):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("imr_torch.cli.characterize.load_traces", interrupted)
    assert said_by(FIT, 130) == "imr-torch: stopped; what was written is complete\n"


def test_that_intervals_that_draws_did_not_settle_say_what_to_do(said_by):
    both = [
        *f"characterize {EXAMPLE} --models nhkv,zener --noise published".split(),
        *QUICK,
    ]
    normal = said_by(both)
    thorough = said_by([*both, "--effort", "thorough"])
    (line,) = (line for line in normal.splitlines() if "intervals not reliable" in line)
    assert (
        "it has few draws, since it is improbable; more draws: --effort thorough (effort='thorough' in Python)"
        in line
    )
    assert "intervals not reliable" not in thorough
