"""The job script of the documentation, as SLURM would run it: only ``srun`` is replaced, by one
that starts two tasks here.
"""

import os
import shutil
import subprocess
import sys

import pytest

from imr_torch import example_gel
from imr_torch.characterization.saved import SavedCharacterization
from tests.docs.test_sources import ROOT

OPTIONS = "--models nhkv --physics polytropic --noise published --quiet"
SCRIPT = ROOT / "docs" / "howto" / "slurm_batch.sh"
BASH = shutil.which("bash")


@pytest.mark.skipif(
    BASH is None or os.name != "posix", reason="job scripts are for a POSIX shell"
)
def test_that_the_job_script_fits_every_shot_on_the_workers(tmp_path):
    pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    tools = tmp_path / "bin"
    tools.mkdir()
    (tools / "srun").write_text('#!/usr/bin/env bash\n"$@" & "$@" & wait\n')
    (tools / "imr-torch").write_text(
        f'#!/usr/bin/env bash\nexec "{sys.executable}" -m imr_torch "$@" {OPTIONS}\n'
    )
    (tools / "dask").write_text(
        f'#!/usr/bin/env bash\nexec "{sys.executable}" -m dask "$@"\n'
    )
    for path in tools.iterdir():
        path.chmod(0o755)
    (tmp_path / "day1").mkdir()
    for path in (example_gel(), example_gel().with_suffix(".json")):
        shutil.copy(path, tmp_path / "day1")
    place = {
        **os.environ,
        "PATH": f"{tools}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
    }
    place["DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT"] = "60s"
    command = [str(BASH), str(SCRIPT), "day1", "results"]
    job = subprocess.run(
        command, cwd=tmp_path, env=place, capture_output=True, text=True, timeout=240
    )
    assert job.returncode == 0, job.stderr
    assert "1 shot(s): 1 done" in job.stdout
    shot = tmp_path / "results" / "shots" / "example_gel.json"
    # a polytropic bubble is biased: no more is asked of it
    assert SavedCharacterization.load(shot).intervals()["G"][0] < 12e3
