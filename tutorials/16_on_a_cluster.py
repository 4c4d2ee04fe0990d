# %% [markdown]
# # On a cluster
# You will be able to characterise many shots at once on a Dask cluster or on the nodes of a batch system, and continue after an
# interruption. Takes about a minute; needs the extra `cluster`.
#
# Shots are independent, so they can be fitted in parallel. The scheduler hands out curves, not files: the workers need the
# package, and no shared disk. What comes back is written by the process that asked.

# %%
import os
import tempfile
from pathlib import Path

import torch

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.characterization.batch import BatchOptions, run_batch
from imr_torch.material import PARAMETERS
from imr_torch.random import generator

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"
HOME = Path(tempfile.mkdtemp())

# %% [markdown]
# ## Shots
# A folder of shots, as in "From a folder of shots to a table".

# %%
simulator = PolytropicSimulator()
scale = float(simulator.conditions.surroundings.time_scale(3e-4))
weber = float(simulator.conditions.surroundings.weber(3e-4))
noise = generator(4)
times = torch.arange(0.0, 2.8 * scale, 1e-6, dtype=torch.float64)
(HOME / "day1").mkdir()
for number in range(2 if SMOKE else 8):
    gel = PARAMETERS.pack({"G": 6000.0 + 300.0 * number, "mu": 0.1})
    radius = simulator(
        gel[None], torch.tensor([weber, 0.2], dtype=torch.float64), times / scale
    ).radius[0]
    radius = radius + 0.003 * torch.randn(len(times), generator=noise, dtype=torch.float64)
    lines = [
        f"{1e6 * t:.2f},{300.0 * r:.3f}"
        for t, r in zip(times.tolist(), radius.tolist(), strict=True)
    ]
    (HOME / "day1" / f"shot_{number + 1}.csv").write_text(
        "time (us),R (um)\n" + "\n".join(lines)
    )

# %% [markdown]
# ## A cluster
# Here it is one of two workers on this machine, which is enough to try everything. Elsewhere, run `dask scheduler` once and
# `dask worker tcp://SCHEDULER:8786 --nthreads 1 --nworkers 8` on every node, and give the address of the scheduler to `Client`.
# One thread a worker is best: each shot is one job, and the bubble solver of a job uses the threads of its simulator.

# %%
from distributed import Client, LocalCluster

place = {
    "n_workers": 2,
    "threads_per_worker": 1,
    "processes": not SMOKE,
    "dashboard_address": None,
}
cluster = LocalCluster(host="127.0.0.1", protocol="tcp://", **place)
client = Client(cluster)
print(f"{len(client.scheduler_info()['workers'])} workers")

# %% [markdown]
# ## The same call
# `run_batch` takes any executor of `concurrent.futures`; a Dask client makes one. On the command line the whole of this is
# `imr-torch batch day1/ --out results --cluster tcp://SCHEDULER:8786`.

# %%
options = BatchOptions(
    wide_prior(["nhkv"]), simulator, rest_radius=(0.2, 0.01), estimate_noise=False
)
with client.get_executor() as executor:
    summary = run_batch(
        HOME / "day1",
        folder=HOME / "results",
        options=options,
        executor=executor,
        window=64,
    )
print(summary.report())
for row in summary.rows:
    interval = f"{row['G']:.0f} Pa (90 %: {row['G_low']:.0f} to {row['G_high']:.0f})"
    print(f"{row['shot']}, {row['model']} (RMSE in R* {row['rmse']:.4f}): G {interval}")

# %% [markdown]
# Cut off? The same call computes only what is missing. With nothing missing it needs no cluster.

# %%
client.close()
cluster.close()
again = run_batch(HOME / "day1", folder=HOME / "results", options=options)
assert [row["G"] for row in again.rows] == [row["G"] for row in summary.rows]
print(again.report())

# %% [markdown]
# ## With SLURM
# Without Dask, one job of an array for each file is enough, because each fits by itself:
#
# ```shell
# sbatch --array=1-$(ls day1/*.csv | wc -l) --cpus-per-task=1 --mem=4G --time=00:20:00 --wrap '
#   FILE=$(ls day1/*.csv | sed -n "${SLURM_ARRAY_TASK_ID}p")
#   imr-torch batch "$FILE" --out "results/$SLURM_ARRAY_TASK_ID" --workers 1'
# ```
#
# Compile the bubble solver once before (`imr-torch demo --short` on one node), or every job does so by itself. If nodes
# see no common home, point `IMR_TORCH_CACHE` at a folder that they do see.
