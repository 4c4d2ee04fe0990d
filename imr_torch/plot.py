"""Figures: curves with their posterior predictive band, parameters, model probabilities, the information map.

Every ``plot_*`` draws into ``ax`` (a new figure when None) and returns the axes; nothing is shown or saved here.
"""

from collections.abc import Mapping, Sequence

import matplotlib

matplotlib.use("Agg", force=False)
import matplotlib.pyplot as plt
import torch
from matplotlib.axes import Axes
from torch import Tensor

from imr_torch.calibration import Reliability, envelope
from imr_torch.design import DesignSearch
from imr_torch.material import Belief, ModelBelief
from imr_torch.observe import Experiment
from imr_torch.simulate import Solution

DATA, MODEL, SECOND, TRUTH = "#222222", "#0072B2", "#E69F00", "#D55E00"  # safe for colour-blind readers
_CURVES_SHOWN = 12


def _axes(ax: Axes | None, size: tuple[float, float] = (5.2, 3.4)) -> Axes:
    if ax is not None:
        return ax
    return plt.subplots(figsize=size, layout="constrained")[1]


def plot_solution(solution: Solution, *, ax: Axes | None = None, labels: Sequence[str] | None = None) -> Axes:
    """Radius over time of each bubble of a flat batch (``B x n_t``)."""
    ax = _axes(ax)
    for i, (times, radius) in enumerate(zip(solution.times, solution.radius, strict=True)):
        ax.plot(times, radius, lw=1.5, label=labels[i] if labels else None)
    ax.set(xlabel="t* = t U_c / Rmax", ylabel="R* = R / Rmax", ylim=(0.0, None))
    if labels:
        ax.legend(frameon=False, fontsize=8)
    return ax


def plot_experiment(
    experiment: Experiment, band: tuple[Tensor, Tensor, Tensor] | None = None, *, ax: Axes | None = None
) -> Axes:
    """Measured curves of one experiment and, if given, the 5, 50 and 95 % posterior predictive quantiles (``n_t`` each)."""
    ax = _axes(ax)
    style = {"ms": 3, "color": DATA, "alpha": 0.5 if experiment.repeats == 1 else 0.15, "ls": "none", "marker": "."}
    for curve in experiment.radius[:_CURVES_SHOWN]:
        ax.plot(experiment.times, curve, **style)
    if band is not None:
        low, middle, high = (x[: len(experiment.times)] for x in band)
        ax.fill_between(experiment.times, low, high, color=MODEL, alpha=0.25, lw=0, label="90 % predictive")
        ax.plot(experiment.times, middle, color=MODEL, lw=1.5, label="median")
        ax.legend(frameon=False, fontsize=8)
    ax.set(xlabel="t* = t U_c / Rmax", ylabel="R* = R / Rmax", ylim=(0.0, None))
    ax.set_title(experiment.label, fontsize=9)
    return ax


def plot_parameter(
    beliefs: Sequence[tuple[str, ModelBelief]], name: str, *, truth: float | None = None, ax: Axes | None = None
) -> Axes:
    """Density of one parameter under several beliefs of a model (for example prior and posterior)."""
    ax = _axes(ax, (3.4, 2.8))
    levels = torch.linspace(0.002, 0.998, 400, dtype=torch.float64)
    for (label, belief), color in zip(beliefs, (SECOND, MODEL, TRUTH, DATA), strict=False):
        column = belief.names.index(name)
        entry = belief.material.parameters[belief.material.names.index(name)]
        values = belief.quantile(levels)[:, column] * entry.display_scale
        density = levels.diff() / values.diff().clamp_min(1e-300)
        ax.plot(0.5 * (values[1:] + values[:-1]), density / density.max(), color=color, label=label)
        ax.set_xlabel(entry.label)
        if truth is not None:
            ax.axvline(truth * entry.display_scale, color=TRUTH, ls="--", lw=1)
    ax.set(yticks=[], ylabel="density (scaled)")
    ax.legend(frameon=False, fontsize=8)
    return ax


def plot_probabilities(beliefs: Sequence[tuple[str, Belief]], *, ax: Axes | None = None) -> Axes:
    """Model probabilities as grouped bars, one group per belief."""
    ax = _axes(ax, (4.2, 2.8))
    keys = beliefs[0][1].keys
    width = 0.8 / len(keys)
    for i, key in enumerate(keys):
        heights = [belief.probabilities[key] for _, belief in beliefs]
        places = [j + (i - (len(keys) - 1) / 2) * width for j in range(len(beliefs))]
        ax.bar(places, heights, width, label=beliefs[0][1][key].material.title)
    ax.set(xticks=range(len(beliefs)), xticklabels=[label for label, _ in beliefs], ylim=(0, 1.02), ylabel="probability")
    ax.legend(frameon=False, fontsize=8)
    return ax


def plot_information(search: DesignSearch, *, ax: Axes | None = None) -> Axes:
    """Map of the expected information gain over designs, with the evaluated designs and the chosen one."""
    ax = _axes(ax, (5.0, 3.6))
    low, high = search.optimizer.space.bounds
    weber = torch.linspace(float(low[0]), float(high[0]), 60, dtype=torch.float64)
    rest = torch.linspace(float(low[1]), float(high[1]), 60, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(weber, rest, indexing="xy"), dim=-1)
    model = search.optimizer.model()
    with torch.no_grad():
        mean = model.posterior(grid.reshape(-1, 2)).mean.reshape(60, 60)
    filled = ax.contourf(weber, rest, mean, levels=15, cmap="viridis")
    ax.figure.colorbar(filled, ax=ax, label="expected information gain (nats)")
    ax.plot(search.designs[:, 0], search.designs[:, 1], "o", ms=3, color="white", mec="black", mew=0.4)
    design = search.recommendation.design
    ax.plot(float(design[0]), float(design[1]), "*", ms=16, color=TRUTH, mec="white")
    ax.set(xlabel="We", ylabel="R_inf*", title="chosen design: star")
    return ax


def plot_places(places: Mapping[str, Sequence[float]], *, ax: Axes | None = None) -> Axes:
    """Empirical distribution of where truths lie in their posteriors, less the diagonal; in the band 95 % of the time."""
    ax = _axes(ax)
    for name, values in places.items():
        at = torch.as_tensor(sorted(values), dtype=torch.float64)
        share = torch.arange(1, len(at) + 1, dtype=torch.float64) / len(at)
        ax.step(at, share - at, where="post", lw=1.2, label=f"{name} ({len(at)})")
    if places:
        width = envelope(min(len(values) for values in places.values()))
        ax.axhspan(-width, width, color=DATA, alpha=0.12, lw=0)
    ax.set(xlim=(0, 1), xlabel="place of the truth in its posterior", ylabel="share below, less uniform")
    ax.legend(frameon=False, fontsize=8)
    return ax


def plot_reliability(result: Reliability, *, ax: Axes | None = None) -> Axes:
    """Share of cases that came true over the probability that was stated, with 95 % intervals."""
    ax = _axes(ax, (4.0, 3.6))
    share = torch.tensor(result.share)
    reach = torch.stack((share - torch.tensor(result.low), torch.tensor(result.high) - share)).clamp_min(0.0)
    ax.plot((0, 1), (0, 1), color=DATA, lw=1, alpha=0.4)
    ax.errorbar(result.stated, result.share, yerr=reach, fmt="o", color=MODEL, ms=4, capsize=2)
    for x, y, count in zip(result.stated, result.share, result.counts, strict=True):
        ax.annotate(str(count), (x, y), xytext=(5, -9), textcoords="offset points", fontsize=7)
    title = f"calibration error {result.error:.3f}, by chance {result.by_chance:.3f}"
    ax.set(xlabel="stated probability", ylabel="share that came true", xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    ax.set_title(title, fontsize=9)
    return ax
