"""Are the intervals from collapse times right? They are compared with quadrature, and with the
truth over gels of the prior.

  python benchmarks/collapse_times.py run --gels 200 --scatter 0 --json collapse.jsonl
  python benchmarks/collapse_times.py run --gels 200 --scatter 0 --fixed 8000,0.1 --json
  collapse_fixed.jsonl python benchmarks/collapse_times.py table --json collapse.jsonl

Eight shots of one NHKV gel by polytropic bubbles, Rmax 200 to 400 um (.3 % error), stretch 5 to 9
(1 %), timing error .001. The gel is drawn from the wide prior, or `--fixed` at G, mu; `--scatter`
adds a further error of the times, which `characterize` estimates and the quadrature integrates
over. The quadrature has 901 x 901 gels (361 x 361 with a further error), by splines through 121 x
121 simulated ones, and linear nuisances. Where a prior is right, 90 % intervals hold 90 % of gels
drawn from it, by `characterize` as by quadrature; at a fixed gel no Bayesian interval need, and the
quadrature says how many an exact one holds.
"""

import argparse
import json
import math
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.interpolate import RectBivariateSpline
from torch import Tensor

from imr_torch import PolytropicSimulator, characterize, wide_prior
from imr_torch.assimilate import SearchOptions
from imr_torch.calibration import coverage
from imr_torch.observe import CollapseShot, TraceSet
from imr_torch.observe.collapse import predict_collapse
from imr_torch.random import child, generator
from imr_torch.units import Surroundings

SHOTS = 8
TIMING = 0.001
RMAX_SD = 0.003
STRETCH_SD = 0.01
NAMES = ("G", "mu")
SIMULATOR = PolytropicSimulator(threads=1)
PRIOR = wide_prior(["nhkv"])["nhkv"]
_REACH, _COARSE, _FINE = (
    4.5,
    121,
    {False: 901, True: 361},
)  # finer where no further error widens the posterior
_SCATTERS = 24
_STEP = 1e-3
_LEVEL = 0.9
_EARLIEST = 0.3  # t* below which a collapse time is refused as one in other units


def measured() -> tuple[Tensor, Tensor, Tensor]:
    """Rmax in m, stretch and (We, R_inf*) of the shots as measured."""
    source = generator(0)
    sizes = 200e-6 + 200e-6 * torch.rand(SHOTS, generator=source, dtype=torch.float64)
    stretch = 5.0 + 4.0 * torch.rand(SHOTS, generator=source, dtype=torch.float64)
    return sizes, stretch, torch.stack((Surroundings().weber(sizes), 1.0 / stretch), 1)


@dataclass(frozen=True)
class Grid:
    """Predicted times over a grid of gels.

    Args:
        axis: ``n`` values of each control.
        times: ``n x n x E`` array; NaN where no collapse is seen.
        variance: ``n x n x E`` array, by the errors of Rmax and stretch.
    """

    axis: np.ndarray
    times: np.ndarray
    variance: np.ndarray

    @staticmethod
    def make(*, scatter: bool) -> "Grid":
        """Simulate it, finely enough for a posterior without or with a further error."""
        designs = measured()[2]
        coarse = torch.linspace(-_REACH, _REACH, _COARSE, dtype=torch.float64)
        gels = PRIOR.to_si(torch.cartesian_prod(coarse, coarse))
        near = torch.full((SHOTS,), 0.92, dtype=torch.float64)
        shifts = torch.zeros(3, SHOTS, 3, dtype=torch.float64)
        shifts[1, :, 0] = shifts[2, :, 2] = _STEP
        own = torch.stack(
            [
                predict_collapse(SIMULATOR, gels, designs, near, s.expand(len(gels), -1, -1))
                for s in shifts
            ]
        )
        slopes = (own[1:] - own[0]) / _STEP
        variance = (slopes[0] * RMAX_SD) ** 2 + (slopes[1] * STRETCH_SD) ** 2
        fine = np.linspace(-_REACH, _REACH, _FINE[scatter])
        parts = [
            _refined(x.reshape(_COARSE, _COARSE, SHOTS).numpy(), coarse.numpy(), fine)
            for x in (own[0], variance)
        ]
        return Grid(fine, parts[0], parts[1].clip(0.0))

    def posterior(self, times: Tensor, *, scatter: bool) -> np.ndarray:
        """Weights ``n x n`` of the gels given the times, with the further error integrated over if
        there may be any.
        """
        square = (self.times - times.numpy()) ** 2
        extra = np.geomspace(1e-4, 0.1, _SCATTERS) if scatter else np.zeros(1)
        logs = []
        for s in extra:
            whole = self.variance + TIMING**2 + s**2
            logs.append(-0.5 * (square / whole + np.log(whole)).sum(-1))
        log = np.logaddexp.reduce(np.stack(logs), 0)
        log = np.where(np.isfinite(log), log, -np.inf) - 0.5 * (
            self.axis[:, None] ** 2 + self.axis**2
        )
        weights = np.exp(log - log.max())
        return weights / weights.sum()


def _refined(values: np.ndarray, coarse: np.ndarray, fine: np.ndarray) -> np.ndarray:
    """Splines through a grid; NaN between simulated gels of which one is NaN."""
    left = (np.searchsorted(coarse, fine, side="right") - 1).clip(0, len(coarse) - 2)
    out = np.empty((len(fine), len(fine), values.shape[2]))
    for e in range(values.shape[2]):
        own = values[..., e].copy()
        for row in own:  # a value is needed beyond the edge: the last one
            known = np.isfinite(row)
            if known.any():
                row[~known] = np.interp(coarse[~known], coarse[known], row[known])
        missing = ~np.isfinite(values[..., e])
        missing = missing[:-1, :-1] | missing[1:, :-1] | missing[:-1, 1:] | missing[1:, 1:]
        own[~np.isfinite(own)] = 1.0
        fitted = RectBivariateSpline(coarse, coarse, own)(fine, fine)
        out[..., e] = np.where(missing[np.ix_(left, left)], np.nan, fitted)
    return out


def quantiles(
    weights: np.ndarray, axis: np.ndarray, truth: float
) -> tuple[float, float, float, float]:
    """5, 50 and 95 % quantiles of a marginal, and the probability below the truth."""
    below = np.concatenate(([0.0], weights.cumsum()))
    edges = np.concatenate(
        (axis - 0.5 * (axis[1] - axis[0]), [axis[-1] + 0.5 * (axis[1] - axis[0])])
    )
    low, middle, high = np.interp((0.05, 0.5, 0.95), below, edges)
    return float(low), float(middle), float(high), float(np.interp(truth, edges, below))


def simulated(
    number: int, args: argparse.Namespace
) -> tuple[Tensor, Tensor, tuple[CollapseShot, ...]]:
    """Controls of the true gel, measured times in t*, and shots.

    Gels of refused times are drawn again.
    """
    source = generator(child(args.seed, "gel", number))
    sizes, stretch, designs = measured()
    scale = Surroundings().time_scale(sizes)
    near = torch.full((SHOTS,), 0.92, dtype=torch.float64)
    while True:
        v = torch.randn(2, generator=source, dtype=torch.float64)
        if args.fixed:
            values = [float(x) for x in args.fixed.split(",")]
            v = torch.stack(
                [
                    m.to_control(torch.tensor(x).double())
                    for m, x in zip(PRIOR.marginals, values, strict=True)
                ]
            )
        shifts = torch.zeros(SHOTS, 3, dtype=torch.float64)
        shifts[:, ::2] = torch.randn(
            SHOTS, 2, generator=source, dtype=torch.float64
        ) * torch.tensor([RMAX_SD, STRETCH_SD])
        t = predict_collapse(SIMULATOR, PRIOR.to_si(v), designs, near, shifts)
        t = t + math.hypot(TIMING, args.scatter) * torch.randn(
            SHOTS, generator=source, dtype=torch.float64
        )
        if bool((t > _EARLIEST).all()):  # NaN is not
            break
    rows = zip(
        sizes,
        stretch,
        t * scale,
        TIMING * scale,
        RMAX_SD * sizes,
        STRETCH_SD * stretch,
        strict=True,
    )
    return v, t, tuple(CollapseShot(f"shot {i}", *map(float, row)) for i, row in enumerate(rows))


def judged(number: int, grid: Grid, args: argparse.Namespace) -> dict[str, Any]:
    """Both answers on one gel."""
    v, t, shots = simulated(number, args)
    weights = grid.posterior(t, scatter=args.scatter > 0.0)
    exact = [quantiles(weights.sum(1 - i), grid.axis, float(v[i])) for i in range(2)]
    row: dict[str, Any] = {
        "number": number,
        "truth": v.tolist(),
        "exact": exact,
        "scatter": args.scatter,
    }
    started = time.process_time()
    result = characterize(
        TraceSet(()),
        shots=shots,
        prior=wide_prior(["nhkv"]),
        simulator=SIMULATOR,
        options=SearchOptions(raw_samples=32, starts=2),
        estimate_noise=args.scatter > 0.0,
        check=False,
        seed=number,
    )
    fit = result.assimilation["nhkv"]
    own = fit.posterior
    levels = torch.tensor((0.05, 0.5, 0.95), dtype=torch.float64)
    bounds = own.quantile(levels.tolist())
    controls = torch.stack([m.to_control(bounds[:, i]) for i, m in enumerate(PRIOR.marginals)], 1)
    row["found"] = controls.mT.tolist()
    row["converged"], row["trust"] = fit.certificate.converged, fit.verdict.name
    row["further"] = result.collapse_times()[0]["scatter"]
    return row | {"cpu": time.process_time() - started}


def run(args: argparse.Namespace) -> None:
    """Append what is missing."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    path = Path(args.json)
    done = {row["number"] for row in rows(path)}
    grid = Grid.make(scatter=args.scatter > 0.0)
    with path.open("a", encoding="utf-8") as stream:
        for number in range(args.gels):
            if number not in done:
                stream.write(json.dumps(judged(number, grid, args)) + "\n")
                stream.flush()


def rows(path: Path) -> list[dict[str, Any]]:
    """The lines of a record; none where there is no file."""
    return (
        [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        if path.exists()
        else []
    )


def table(args: argparse.Namespace) -> None:
    """Print coverage of both, and how far their intervals differ."""
    found = rows(Path(args.json))
    print(f"{len(found)} gels, {sum(row['cpu'] for row in found) / len(found):.2f} s each")
    print(
        f"converged {sum(row['converged'] for row in found)}; draws: "
        f"{dict(_counts(row['trust'] for row in found))}"
    )
    for i, name in enumerate(NAMES):
        for who in ("exact", "found"):
            inside = [row[who][i][0] <= row["truth"][i] <= row[who][i][2] for row in found]
            share = sum(inside) / len(inside)
            below = sum(row["truth"][i] < row[who][i][0] for row in found)
            widths = np.median([row[who][i][2] - row[who][i][0] for row in found])
            print(
                f"  {name}, {who}: 90 % intervals hold {share:.3f} +- "
                f"{math.sqrt(share * (1 - share) / len(found)):.3f}; "
                f"{below} truths below, {len(found) - sum(inside) - below} above; median width "
                f"{widths:.3f} prior sd"
            )
        ratio = [
            (r["found"][i][2] - r["found"][i][0]) / (r["exact"][i][2] - r["exact"][i][0])
            for r in found
        ]
        moved = [
            (r["found"][i][1] - r["exact"][i][1]) / (r["exact"][i][2] - r["exact"][i][0])
            for r in found
        ]
        print(f"    width over exact: {np.quantile(ratio, (0.05, 0.5, 0.95)).round(3)}")
        print(
            "    median less exact, in exact widths: "
            f"{np.quantile(moved, (0.05, 0.5, 0.95)).round(3)}"
        )
        ranks = [row["exact"][i][3] for row in found]
        held = coverage(ranks, _LEVEL)
        print(
            f"    ranks of the exact posterior: 90 % hold {held.share:.3f} ({held.low:.3f} to "
            f"{held.high:.3f})"
        )


def _counts(values: Any) -> list[tuple[str, int]]:
    names = list(values)
    return [(name, names.count(name)) for name in sorted(set(names))]


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    for name, function in (("run", run), ("table", table)):
        command = commands.add_parser(name)
        command.set_defaults(function=function)
        command.add_argument("--json", default="collapse.jsonl")
        command.add_argument("--gels", type=int, default=200)
        command.add_argument(
            "--scatter", type=float, default=0.0, help="further error of the times, in t*"
        )
        command.add_argument(
            "--fixed", help="G,mu of every gel, SI; drawn from the prior when not given"
        )
        command.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    args.function(args)


if __name__ == "__main__":
    main()
