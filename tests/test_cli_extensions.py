"""Extensions of the command line: ``--import``, entry points, and what is refused."""

import shlex
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.characterization.batch import BatchOptions
from imr_torch.cli import build_parser, main
from imr_torch.cli.options import load_extensions
from imr_torch.files import read_json
from imr_torch.reading import READERS
from imr_torch.simulate import process_pool
from tests.refusals import refused

READER = """
import torch
from imr_torch.reading import RadiusTrace, Reader, TraceSet, register_reader

def read(path):
    rows = [[float(x) for x in line.split(";")] for line in path.read_text().split()[1:]]
    time, radius = 1e-6 * torch.tensor(rows, dtype=torch.float64).T
    return TraceSet((RadiusTrace(path.stem, time, radius, str(path)),))

register_reader(Reader("of {name}", lambda path, head: head.startswith(b"{mark}"), read))
"""


@pytest.fixture
def clean(monkeypatch):
    """Modules, their folders and readers of a test end with it."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    modules = {*sys.modules}
    readers = {*READERS}
    yield
    for name in {*sys.modules} - modules:
        if name.startswith("own_"):
            del sys.modules[name]
    for name in {*READERS} - readers:
        del READERS[name]


def written(folder: Path, name: str, mark: str) -> Path:
    path = folder / f"{name}.py"
    path.write_text(READER.format(name=name, mark=mark))
    return path


def test_that_a_file_adds_a_format_that_commands_and_folders_know(
    tmp_path, clean, capsys, said_by
):
    code = written(tmp_path, "own_format", "OWN")
    shots = tmp_path / "shots"
    shots.mkdir()
    rows = [f"{i};{150 + i}" for i in range(12)]
    (shots / "gel.own").write_text("\n".join(["OWN", *rows]))
    (shots / "notes").write_text("of the day")
    command = f"characterize {shots} --physics polytropic --models nhkv".split()
    assert "the folder holds no file of curves" in said_by(command, 2)
    # a curve that only grows is refused
    assert main([*command, "--import", str(code)]) == 2
    printed = capsys.readouterr()
    assert "gel: 12 frames over 11 us, largest radius 161 um" in printed.out
    assert "no such file" not in printed.err


def test_that_a_model_of_a_file_is_simulated(tmp_path, processes):
    """In a process of its own, since a parameter that is registered stays."""
    code = tmp_path / "own_model.py"
    code.write_text(
        "from imr_torch.material import MATERIALS, Material, register\n"
        'register(Material("own_kv", "Own", "this test", MATERIALS["nhkv"].terms))\n'
    )
    bubble = tmp_path / "bubble.json"
    line = f"simulate --physics polytropic --model own_kv --set G=8310,mu=0.093 --json {bubble}"
    script = "import sys\nfrom imr_torch.cli import main\nsys.exit(main(sys.argv[1:]))"
    ran = processes.run(script, *shlex.split(line), "--import", str(code))
    assert ran.returncode == 0, ran.stderr
    assert read_json(bubble)["model"] == "own_kv"


def test_that_an_installed_package_is_an_extension_by_its_entry_point(tmp_path, clean):
    written(tmp_path, "own_package", "PKG")
    sys.path.append(str(tmp_path))
    info = tmp_path / "own_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: own-package\nVersion: 1.0\n"
    )
    (info / "entry_points.txt").write_text("[imr_torch]\nmine = own_package\n")
    assert load_extensions(()) == ("own_package",)
    assert "of own_package" in READERS
    (tmp_path / "own_package.py").write_text("import no_such_module_here\n")
    del sys.modules["own_package"]
    message = r"extension 'mine', line 1: cannot be imported: .*'no_such_module_here'"
    with refused(message):
        load_extensions(())


def test_that_workers_import_extensions_first(tmp_path, clean):
    names = load_extensions([str(written(tmp_path, "own_worker", "WORK"))])
    with process_pool(1, names) as pool:
        known = "list(__import__('imr_torch.reading').reading.READERS)"
        assert "of own_worker" in pool.submit(eval, known).result()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "missing.py",
            None,
            r"missing\.py: no such Python file; name one that ends in \.py",
        ),
        ("time.py", "", r"'time' is the name of another module; rename the file"),
        (
            "own_bad.py",
            "\n\n1 / 0\n",
            r"own_bad\.py, line 3: cannot be imported: ZeroDivisionError",
        ),
        (
            "own_syntax.py",
            "def\n",
            r"own_syntax\.py: cannot be imported: SyntaxError: .*line 1",
        ),
    ],
)
def test_that_a_file_that_cannot_be_imported_is_refused(
    tmp_path, clean, name, text, message
):
    if text is not None:
        (tmp_path / name).write_text(text)
    with refused(message):
        load_extensions([str(tmp_path / name)])


def test_that_every_command_that_computes_takes_it():
    for command in (
        "batch --out o",
        "characterize",
        "diagnose",
        "simulate --set G=1",
        "design",
    ):
        name, *options = command.split()
        files = ["gel.csv"] if name in ("batch", "characterize", "diagnose") else []
        given = ["--import", "a.py", "--import", "b.py"]
        assert build_parser().parse_args([name, *files, *options, *given]).imports == [
            "a.py",
            "b.py",
        ]


def test_that_a_result_of_a_batch_depends_on_the_code_of_its_extensions():
    options = BatchOptions(wide_prior(["nhkv"]), PolytropicSimulator())
    keys = {
        replace(options, code=code).make_key() for code in ((), (b"G = 1",), (b"G = 2",))
    }
    assert len(keys) == 3


@pytest.mark.parametrize("option", ["--driving", "--import"])
def test_that_a_file_that_is_read_is_not_written_over(tmp_path, option, said_by):
    file = tmp_path / "own.py"
    file.write_text("time (us),p (kPa)\n0,0\n1,1\n2,0\n")
    command = f"simulate --set G=8310,mu=0.093 {option} {file} --json {file}"
    assert "which is read as well; give another name" in said_by(command.split(), 2)
