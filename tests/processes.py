"""Runs scripts in processes of their own that find the libraries loaded: forked from one process that has imported them.

Loading PyTorch, Numba, SciPy, BoTorch and Matplotlib takes seconds of each process that simulates.
The process that forks, run as ``python tests/processes.py``, imports these and nothing of the
package, so that a script finds the registries as a fresh interpreter would. It also lets Numba read
the types that it compiles for, which it puts off until it first compiles, and leaves all this out
of garbage collections: one that visits the objects of the libraries makes the forked process copy
them. Where processes cannot be forked, a script runs in a fresh interpreter.
"""

import gc
import json
import os
import runpy
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[1]
BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
"""Where Chromium is; None where it is not installed."""
LIBRARIES = (  # dependencies of the package
    "torch",
    "torchdiffeq",
    "jaxtyping",
    "numba",
    "filelock",
    "h5py",
    "pymatreader",
    "arviz_stats.base.array",
    "scipy.stats",
    "scipy.optimize",
    "scipy.integrate",
    "scipy.special",
    "scipy.io",
    "matplotlib.pyplot",
    "gpytorch.mlls",
    "botorch.acquisition.logei",
    "botorch.models",
    "botorch.fit",
    "botorch.optim",
)


class Processes:
    """Starts the process that forks at the first script, and ends it with ``close``."""

    def __init__(self) -> None:
        self._server: subprocess.Popen[str] | None = None

    def run(
        self,
        script: Path | str,
        *arguments: str,
        env: Mapping[str, str] | None = None,
        timeout: int = 600,
    ) -> subprocess.CompletedProcess[str]:
        """A file, or source as of ``python -c``; with variables of the environment beside those of this process.

        One that takes longer than ``timeout`` seconds ends with the status of SIGALRM.
        """
        own = dict(env or {})
        if not hasattr(os, "fork"):
            command = [
                sys.executable,
                *(["-c"] if isinstance(script, str) else []),
                str(script),
                *arguments,
            ]
            return subprocess.run(
                command,
                env=os.environ | own,
                cwd=ROOT,
                capture_output=True,
                text=True,
                timeout=timeout,
            )
        with tempfile.TemporaryDirectory() as folder:
            out, err = (Path(folder) / name for name in ("out", "err"))
            job = {
                "file": str(script) if isinstance(script, Path) else None,
                "source": str(script),
                "arguments": arguments,
            }
            status = self._ask(
                job | {"env": own, "timeout": timeout, "out": str(out), "err": str(err)}
            )
            return subprocess.CompletedProcess(
                [str(script), *arguments], status, out.read_text(), err.read_text()
            )

    def _ask(self, job: dict[str, object]) -> int:
        if self._server is None:
            command = [sys.executable, __file__]
            env = os.environ | {"OMP_NUM_THREADS": "1"}
            self._server = subprocess.Popen(
                command,
                env=env,
                cwd=ROOT,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                bufsize=1,
            )
        self._server.stdin.write(json.dumps(job) + "\n")
        return int(self._server.stdout.readline())

    def close(self) -> None:
        """End the process that forks."""
        if self._server is not None:
            self._server.communicate()
            self._server = None


def serve() -> dict | None:
    """Fork for each line of the standard input and print the status; in a process that was forked,
    return what it has to run.
    """
    while line := sys.stdin.readline():
        child = os.fork()
        if child == 0:
            return json.loads(line)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
    return None


def become(job: dict) -> None:
    """Run a script as the interpreter would; the process ends as the script does."""
    for number, name in enumerate((os.devnull, job["out"], job["err"])):
        os.dup2(os.open(name, os.O_RDWR | os.O_CREAT), number)
    signal.alarm(job["timeout"])
    os.environ.update(job["env"])
    file = job["file"]
    sys.argv = [file or "-c", *job["arguments"]]
    sys.path[0] = str(Path(file).parent) if file else ""
    if file:
        runpy.run_path(file, run_name="__main__")
    else:
        sys.modules["__main__"] = main = ModuleType("__main__")
        exec(job["source"], main.__dict__)


def load(libraries: Sequence[str]) -> None:
    """Import what scripts will need, and keep it."""
    for name in libraries:
        __import__(name)
    target = sys.modules["numba"].core.registry.cpu_target
    target.typing_context.refresh()
    target.target_context.refresh()
    gc.collect()
    gc.freeze()
    assert not [name for name in sys.modules if name.partition(".")[0] == "imr_torch"]


if __name__ == "__main__":
    load(LIBRARIES)
    if (given := serve()) is not None:
        become(given)
