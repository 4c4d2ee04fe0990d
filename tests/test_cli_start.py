"""The command line before any work: help, version and mistakes answer without PyTorch; the demo;
start.
"""

import subprocess
import sys
from importlib.metadata import version
from inspect import signature
from typing import get_args

import pytest

import imr_torch
from imr_torch import example_gel
from imr_torch.campaign import Journal, Optimal
from imr_torch.characterization import EFFORTS
from imr_torch.cli import build_parser, demo, main
from imr_torch.cli.common import METHODS, SIMULATORS
from imr_torch.cli.options import MEDIA, MODELS, PARTS, read_settings
from imr_torch.design import Target
from imr_torch.files import read_json
from imr_torch.gap import diagnose
from imr_torch.material import CASES, MATERIALS
from imr_torch.material import PARTS as KNOWN_PARTS
from imr_torch.material.media import NAMED
from imr_torch.simulate import ENGINES, LIQUIDS, RADIAL_EQUATIONS

HEAVY = ("torch", "numpy", "botorch", "matplotlib", "numba", "scipy")
BUILT_IN = [
    key
    for key, model in MATERIALS.items()
    if all(term.law.__module__.startswith("imr_torch.") for term in model.terms)
]


@pytest.mark.parametrize(
    ("arguments", "status"),
    [
        (["--help"], 0),
        (["--version"], 0),
        (["characterize", "--help"], 0),
        (["chracterize"], 2),
        (["design", "--targt", "x"], 2),
    ],
)
def test_that_help_version_and_mistakes_import_nothing_heavy(arguments, status):
    script = (
        "import sys\nfrom imr_torch.cli import main\n"
        f"try:\n    status = main({arguments!r})\nexcept SystemExit as stop:\n    status = stop.code\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules], status)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == f"[] {status}"


def test_that_the_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit):
        main(["--version"])
    assert capsys.readouterr().out == f"imr-torch {imr_torch.__version__}\n"


def test_that_a_checkout_that_is_not_installed_says_so_before_any_work(
    monkeypatch, said_by
):
    build_parser.cache_clear()
    monkeypatch.setattr("imr_torch.cli.version", lambda name: version(f"{name}-absent"))
    assert (
        said_by(["design"], 2)
        == "imr-torch: imr-torch-absent is not installed: run pip install . in its folder.\n"
    )


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        (MODELS, BUILT_IN),
        (PARTS.replace(";", ",").split(", "), KNOWN_PARTS),
        (MEDIA, NAMED),
        (read_settings("design", "--case")["choices"], CASES),
        (read_settings("design", "--physics")["choices"], SIMULATORS),
        (read_settings("design", "--engine")["choices"], ENGINES),
        (read_settings("design", "--radial")["choices"], RADIAL_EQUATIONS),
        (read_settings("design", "--liquid")["choices"], LIQUIDS),
        (read_settings("design", "--target")["choices"], get_args(Target)),
        (read_settings("characterize", "--method")["choices"], METHODS),
        (read_settings("batch", "--method")["choices"], METHODS),
        (read_settings("characterize", "--effort")["choices"], EFFORTS),
        (
            [
                read_settings("design", "--evaluations")["default"],
                read_settings("diagnose", "--most")["default"],
            ],
            (Optimal.evaluations, signature(diagnose).parameters["most"].default),
        ),
    ],
)
def test_that_names_written_out_for_help_are_those_of_the_registries(written, meant):
    assert tuple(written) == tuple(meant)


def test_that_public_names_of_the_package_are_what_their_modules_define():
    assert imr_torch.characterize is sys.modules["imr_torch.characterization"].characterize
    assert set(imr_torch.__all__) <= set(dir(imr_torch))
    with pytest.raises(AttributeError, match="no attribute 'charcterize'"):
        imr_torch.charcterize  # noqa: B018


def test_that_the_demo_refuses_a_folder_with_files_and_keeps_them(tmp_path, said_by):
    mine = tmp_path / "thesis.txt"
    mine.write_text("years of work")
    assert "--again" in said_by(["demo", "--out", str(tmp_path)], 2)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
    assert mine.read_text() == "years of work"


def test_that_the_demo_passes_options_on_resumes_and_keeps_other_files(
    tmp_path, monkeypatch, capsys
):
    ran = []
    monkeypatch.setattr("imr_torch.cli.main", lambda command: ran.append(command) or 0)
    out = tmp_path / "first look"
    kept = tmp_path / "first look" / "notes.txt"
    words = ["demo", "--out", str(out), "--threads", "1", "--quiet"]
    args = build_parser().parse_args(words)
    args.argv = words
    demo.run_command(args)
    assert [command[0] for command in ran] == ["characterize", "campaign"]
    assert all(
        command[-5:] == ["--seed", "0", "--threads", "1", "--quiet"] for command in ran
    )
    assert (out / "example_gel.csv").read_bytes() == example_gel().read_bytes()
    assert "--resume" not in ran[1]
    assert len(read_json(out / "demo.json")["commands"]) == 2
    kept.write_text("mine")
    Journal(out / "campaign").append("begin")
    args.again = True
    demo.run_command(args)
    assert "--resume" in ran[3]
    assert kept.read_text() == "mine"
    assert "gel.html" in capsys.readouterr().out


def test_that_the_demo_says_which_command_failed(tmp_path, monkeypatch, said_by):
    args = f"demo --out {tmp_path}/new --quiet".split()
    monkeypatch.setattr("imr_torch.cli.main", lambda command: 1)
    assert "ended at command 1 of 2" in said_by(args, 1)
