"""What is registered from outside works from the data to the answer, without a change to the package."""

from pathlib import Path

from imr_torch.observe import (
    READERS,
    Layout,
    Reader,
    TraceSet,
    load_traces,
    register_reader,
)
from tests.refusals import refused


def test_that_a_model_and_effects_of_bubble_and_camera_are_added_from_outside(processes):
    """In a process of its own, since registries are shared by all tests."""
    ran = processes.run(Path(__file__).with_name("extension.py"), timeout=900)
    assert ran.returncode == 0, ran.stderr
    model, *effects = ran.stdout.splitlines()
    assert model == "model two_springs G,mu,G_second"
    for line, cause in zip(effects, ("surge", "creep"), strict=True):
        assert line.split()[0] == "effect"
        assert cause in line


def test_that_a_reader_is_asked_first_and_takes_no_layout(tmp_path):
    file = tmp_path / "a.csv"
    asked = []
    file.write_text("MINE\n1,2\n")

    def read(path: Path) -> TraceSet:
        asked.append(path)
        return TraceSet(())

    register_reader(Reader("mine", lambda path, head: head.startswith(b"MINE"), read))
    try:
        load_traces(file)
        assert asked == [file]
        with refused("is read as 'mine', which takes no layout"):
            load_traces(file, layout=Layout("r", radius_unit="um", time="t"))
        with refused("A reader of the name 'mine' is registered already"):
            register_reader(Reader("mine", lambda path, head: True, read))
    finally:
        del READERS["mine"]
