"""Growth of measured bubbles, and later cycles, predicted by fits that did not see them.

  python -m benchmarks.growth run FOLDER OUT.jsonl [--shots 3] [--workers 2]
  python -m benchmarks.growth table OUT.jsonl

FOLDER holds a CSV file a gel and a JSON file beside it, as for `benchmarks.real_gels`. Of every set
whose growth is recorded above .6 Rmax, with NHKV and with NHKV and the drag of size:

- *growth*: fitted to all frames from the maximum on, up to the second collapse; judged on the frames
  before it. Beside it stands what needs no physics: the measured collapse, mirrored in time.
- *later*: fitted to growth and first collapse; judged on the frames after it.

A residual is over .004 in R* and .15 frames of jitter, as in the study that the issue quotes; frames
next to collapses are left out. Rmax, time zero and R_inf are those of the fit.
"""

import argparse
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.real_gels import SEARCH, SETS, standardise
from benchmarks.records import (
    Job,
    Line,
    finish_command,
    start_commands,
    write_table,
)
from imr_torch import load_traces, wide_prior
from imr_torch.assimilate import SearchOptions, assimilate
from imr_torch.assimilate.starts import away_from_collapses
from imr_torch.characterization import medium_of
from imr_torch.errors import InputDataError
from imr_torch.material import LIBRARY, Belief, add_parameters, even_belief
from imr_torch.observe import (
    Experiment,
    ExperimentBatch,
    Noise,
    collapse_time,
    predict,
    prepare,
)
from imr_torch.simulate import Simulator

LOWEST = 0.6
NOISE = Noise(scale=0.004, slope=0.0, drift=0.0, floor=1.0)
DRAG = "nhkv+size_drag"
MODELS = ("nhkv", DRAG)
FEWEST = 5


def residual_of(
    prior: Belief,
    shots: tuple[Experiment, ...],
    fitted: list[Tensor],
    judged: list[Tensor],
    simulator: Simulator,
) -> Line:
    """Root mean square of what a fit to some frames leaves in others."""
    kept = tuple(shot.at(frames) for shot, frames in zip(shots, fitted, strict=True))
    options = SearchOptions(raw_samples=64, starts=3)
    fit = assimilate(
        prior, ExperimentBatch(kept, NOISE), simulator, seed=0, options=options, warn=False
    ).fits[0]
    whole = ExperimentBatch(shots, NOISE)
    shifts = fit.nuisances * whole.nuisance_sds
    seen = predict(simulator, fit.parameters(fit.mean), whole, shifts)
    squares = [
        standardise(shot, row[: len(shot.times)])[frames].square()
        for shot, row, frames in zip(shots, seen, judged, strict=True)
    ]
    every = torch.cat(squares)
    reached = every[every.isfinite()]
    return {
        "frames": len(every),
        "unpredicted": len(every) - len(reached),
        "rms": float(reached.mean().sqrt()) if len(reached) else None,
        "gradient": fit.certificate.gradient,
        "converged": fit.certificate.usable,
    }


def mirror(shot: Experiment, frames: Tensor) -> Tensor:
    """The residual of growth by the measured collapse, mirrored in time."""
    after = shot.times >= 0.0
    copied = np.interp(
        -shot.times.numpy(), shot.times[after].numpy(), shot.mean[after].numpy()
    )
    return standardise(shot, torch.from_numpy(copied))[frames]


def judge_set(path: Path, model: str, most: int) -> Line:
    """Both predictions of one set by one model."""
    traces = load_traces(path)
    medium = medium_of(traces, SETS[path.stem], SEARCH.conditions.surroundings)
    simulator = medium.applied(SEARCH)
    prior = medium.believed(wide_prior(["nhkv"]))
    if model == DRAG:
        nhkv = prior.models[0]
        prior = even_belief((add_parameters(nhkv, LIBRARY["size_drag"].priors),))
    try:
        prepared = prepare(traces, SEARCH.conditions.surroundings, growth=LOWEST)
    except InputDataError as error:  # a record without R_inf
        return {"shots": 0, "refused": str(error).replace(f"{path.parent}/", "")}
    shots = [
        shot for shot in prepared.experiments if int((shot.times < 0.0).sum()) >= FEWEST
    ]
    shots = tuple(shots[:: max(1, len(shots) // most)][:most])
    if not shots:
        return {"shots": 0}
    early = [shot.times < 0.0 for shot in shots]
    first = [shot.times <= collapse_time(shot.times, shot.mean, 1) for shot in shots]
    away = [away_from_collapses(shot.times, shot.mean) for shot in shots]
    late = [~own & free for own, free in zip(first, away, strict=True)]
    after = [~own for own in early]
    return {
        "shots": len(shots),
        "growth": residual_of(prior, shots, after, early, simulator),
        "mirrored": [
            float(mirror(s, f).square().mean().sqrt())
            for s, f in zip(shots, early, strict=True)
        ],
        "later": residual_of(prior, shots, first, late, simulator),
    }


def list_jobs(args: argparse.Namespace) -> dict[str, Job]:
    """Every set with every model."""
    return {
        f"{name}/{model}": partial(judge_set, path, model, args.shots)
        for name in SETS
        for model in MODELS
        if (path := args.folder / f"{name}.csv").exists()
    }


def _write_rms(found: Line) -> str:
    """The residual, and how many frames the fitted bubble does not reach."""
    if found["rms"] is None:
        return "-"
    lost = f" ({found['unpredicted']} not reached)" if found["unpredicted"] else ""
    return f"{found['rms']:.1f}{lost}"


def write_page(lines: list[Line]) -> str:
    """A row a set and model, and the medians."""
    told = [x for x in lines if x.get("shots")]
    rows = [
        (
            x["key"],
            x["shots"],
            _write_rms(x["growth"]),
            f"{np.sqrt(np.mean(np.square(x['mirrored']))):.1f}",
            _write_rms(x["later"]),
        )
        for x in told
    ]
    page = write_table(
        ("set", "shots", "growth", "growth by the mirror", "later cycles"), rows
    )
    for model in MODELS:
        own = [x for x in told if x["key"].endswith(f"/{model}")]
        medians = {
            name: np.median([x[name]["rms"] for x in own if x[name]["rms"] is not None])
            for name in ("growth", "later")
        }
        mirrored = np.median([np.sqrt(np.mean(np.square(x["mirrored"]))) for x in own])
        page += (
            f"\n{model}, {len(own)} sets, medians: growth {medians['growth']:.1f} (mirrored "
            f"collapse {mirrored:.1f}), later cycles {medians['later']:.1f} standard deviations."
        )
    return page


def main() -> None:
    """Run or tabulate."""
    parser, _, runs = start_commands(__doc__, "folder")
    runs.add_argument("--shots", type=int, default=3)
    finish_command(parser, list_jobs, write_page)


if __name__ == "__main__":
    main()
