"""Fixtures shared by all tests: one thread, float64 tensors made explicitly, and the reference data
where they exist.
"""

import gc
import os
from pathlib import Path

import pytest
import torch
from matplotlib.figure import Figure

from tests import figures
from tests.processes import Processes

torch.set_num_threads(1)

ROOT = Path(__file__).resolve().parents[1]

SLOWEST = (
    "test_tutorials.py",
    "test_browser.py",
    "test_compiled.py",
    "test_within_misfit.py",
    "test_frame_noise.py",
    "test_cli.py",
    "test_parts.py",
    "test_batch.py",
    "test_policies.py",
    "test_runs.py",
    "test_polytropic.py",
)
"""Files of a minute and more, which begin first: no processor then waits for one of them at the end."""


@pytest.fixture(scope="session")
def shared():
    """Folder of the real experiments and reference curves, which the project may use and not ship.

    Looked for at ``$IMR_TORCH_SHARED``, else in ``shared`` beside the checkout; tests that need it
    skip without it.
    """
    folder = Path(os.environ.get("IMR_TORCH_SHARED", ROOT.parent / "shared"))
    if not (folder / "data").is_dir():
        pytest.skip(
            f"reference data not found at {folder}; set IMR_TORCH_SHARED to the folder that holds data/ and reference/"
        )
    return folder


@pytest.fixture(scope="session")
def processes():
    """Runs scripts in processes of their own that need not load the libraries first."""
    starting = Processes()
    yield starting
    starting.close()


@pytest.fixture(autouse=True)
def keep_threads():
    """Commands set the number of threads of the process."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def rendered():
    """Figures are rendered in this test; in others each is saved as one pixel."""
    with figures.rendering():
        yield


@pytest.fixture
def said_by(capsys):
    """What a command says: on its standard output, or on its standard error where it ends with a status other than 0."""
    from imr_torch.cli import main  # not before shapes are checked

    def run_command(words, status=0):
        assert main(words) == status
        said = capsys.readouterr()
        return said.err if status else said.out

    return run_command


@pytest.fixture
def few_deviations(monkeypatch):
    """See :func:`tests.fewer.sum_few_deviations`."""
    from tests.fewer import sum_few_deviations  # not before shapes are checked

    sum_few_deviations(monkeypatch)


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--check-shapes``: every call checks the annotated shapes."""
    parser.addoption(
        "--check-shapes",
        action="store_true",
        help="check the annotated tensor shapes in every call",
    )


def pytest_xdist_auto_num_workers() -> int:
    """One more than there are processors: some tests wait for a browser or another process."""
    return 1 + (os.cpu_count() or 1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The slowest files first."""
    items.sort(key=lambda item: item.path.name not in SLOWEST)


def pytest_collection_finish() -> None:
    """What was imported stays, so that garbage collections need not visit it, and they are fewer."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


def pytest_configure(config: pytest.Config) -> None:
    """Before a test imports the package."""
    Figure.savefig = figures.save_one_pixel
    if config.getoption("--check-shapes"):
        from tests import shape_check

        shape_check.install()
