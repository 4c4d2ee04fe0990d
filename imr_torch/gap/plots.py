"""Figures of a diagnosis: residuals, tests, first detection, latent pressure, causes, and fits
without and with the cause.

Every ``plot_*`` draws into ``ax`` (a new figure when None) and returns the axes; nothing is shown
or saved here. Colours are told apart by colour-blind readers, and what matters is also written.
"""

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import matplotlib.pyplot as plt
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.gap.acts import WhereItActs
from imr_torch.gap.hypotheses import in_words
from imr_torch.gap.latent import LatentPressure
from imr_torch.gap.locate import Onset
from imr_torch.gap.shrinkage import Shrinkage
from imr_torch.gap.windows import MovingWindows
from imr_torch.goodness.phases import PHASES, phase_clock, phase_name
from imr_torch.goodness.score import LEVEL, BlockResult, GapTest
from imr_torch.labels import R_STAR, T_STAR, plain
from imr_torch.material import LIBRARY, PARAMETERS
from imr_torch.observe import ExperimentBatch

BESIDE = {"with_cause": "with the cause", "with_additions": "with additions"}
"""What is drawn beside the base model, by its name in the JSON: the named cause, else the best step of a stepwise selection."""
DATA, BASE, AFTER, ALARM = "#222222", "#E69F00", "#0072B2", "#D55E00"
_SMALLEST = 300.0  # -log10 p beyond which p-values are zero in float64
_LINEAR = 10.0  # -log10 p up to which axes are linear; logarithmic beyond
_BARS = 12
_ALL = 0.99  # probability from which on others cannot be seen
_BAND = 1.645  # standard deviations of a 90 % band


def _axes(ax: Axes | None, size: tuple[float, float] = (5.2, 3.4)) -> Axes:
    if ax is not None:
        return ax
    return plt.subplots(figsize=size, layout="constrained")[1]


def _strength(p_value: float) -> float:
    """How small a p-value is, in powers of ten."""
    return -math.log10(max(p_value, 10.0**-_SMALLEST))


def phase_rms(fit: ModelFit, batch: ExperimentBatch) -> Float[Tensor, "experiments phases"]:
    """Root mean square residual of the mean curves by experiment and phase, over its noise: ``E x
    len(PHASES)``, NaN if empty.

    1 is what noise alone leaves.
    """
    clock = phase_clock(batch.times, fit.prediction, batch.mask)
    noise = batch.sd(fit.prediction) / batch.counts.sqrt()
    square = torch.where(batch.mask, ((batch.mean - fit.prediction) / noise).square(), 0.0)
    names = [[phase_name(c) for c in row] for row in clock.tolist()]
    columns = []
    for phase in PHASES:
        inside = torch.tensor([[name == phase for name in row] for row in names]) & batch.mask
        columns.append((torch.where(inside, square, 0.0).sum(1) / inside.sum(1)).sqrt())
    return torch.stack(columns, 1)


def plot_phase_residual(fit: ModelFit, batch: ExperimentBatch, *, ax: Axes | None = None) -> Axes:
    """Size of the residual of a fit: a map over experiments and phases, 1 being noise alone."""
    values = phase_rms(fit, batch)
    ax = _axes(ax, (5.8, 1.4 + 0.36 * len(values)))
    top = max(3.0, float(values.nan_to_num().max()))
    image = ax.imshow(values.numpy(), cmap="Blues", vmin=0.0, vmax=top, aspect="auto")
    for i, row in enumerate(values.tolist()):
        for j, value in enumerate(row):
            text = "" if math.isnan(value) else f"{value:.1f}"
            ax.text(
                j,
                i,
                text,
                ha="center",
                va="center",
                fontsize=8,
                color="white" if value > 0.6 * top else "black",
            )
    ax.set_xticks(range(len(PHASES)), [phase.replace(" ", "\n") for phase in PHASES], fontsize=8)
    ax.set_yticks(range(len(values)), [plain(e.label, 24) for e in batch.experiments], fontsize=8)
    ax.figure.colorbar(image, ax=ax, label="rms residual / noise")
    return ax


def plot_scores(test: GapTest, *, ax: Axes | None = None) -> Axes:
    """P-values of the blocks of a gap test, smallest first, with the power of those that have an
    amplitude.
    """
    shown = test.blocks[:_BARS]
    ax = _axes(ax, (6.4, 1.0 + 0.27 * len(shown)))
    strength = [_strength(b.p_value) for b in shown]
    limit = -math.log10(LEVEL / len(test.blocks))
    places = range(len(shown) - 1, -1, -1)
    ax.barh(
        places, strength, color=[ALARM if s > limit else "#AAAAAA" for s in strength], height=0.7
    )
    ax.axvline(limit, color=DATA, ls="--", lw=1)
    for place, s in zip(places, strength, strict=True):
        ax.text(s, place, f" {'> ' if s == _SMALLEST else ''}{s:.3g}", va="center", fontsize=7)
    ax.set_yticks(places, [_labelled(b) for b in shown], fontsize=8)
    ax.set(
        xlabel="$-\\log_{10} p$  (dashed: 4 % over all)", xlim=(0.0, 10.0 * max(*strength, limit))
    )
    ax.set_xscale("symlog", linthresh=_LINEAR)
    return ax


def _labelled(block: BlockResult) -> str:
    """A block's name, with its power where it stands for an effect of typical size."""
    return (
        f"{plain(block.name)} (power {block.power:.2f})"
        if block.name in LIBRARY and not math.isnan(block.power)
        else plain(block.name)
    )


def plot_onset(found: Onset, *, ax: Axes | None = None) -> Axes:
    """P-value of a refit to the frames up to each moment.

    The first below the level is the first detection.
    """
    ax = _axes(ax)
    strength = [_strength(p) for p in found.p_values]
    ax.plot(found.times, strength, "o-", color=AFTER, ms=4)
    ax.axhline(
        -math.log10(found.level),
        color=DATA,
        ls="--",
        lw=1,
        label=f"{100 * found.level:g} % over the whole event",
    )
    if found.phase != "none":
        ax.axvline(
            found.time,
            color=ALARM,
            lw=1.5,
            label=f"first detected: {found.phase}, t* = {found.time:.2f}",
        )
    ax.set_yscale("symlog", linthresh=_LINEAR)
    ax.set(
        xlabel="frames up to $t^*$",
        ylabel="$-\\log_{10} p$",
        ylim=(0.0, 2.0 * max(*strength, _LINEAR)),
    )
    ax.legend(frameon=False, fontsize=8)
    return ax


def plot_acts(found: WhereItActs, *, ax: Axes | None = None) -> Axes:
    """Share of the signal of the named effects by phase, with its 90 % interval."""
    ax = _axes(ax, (5.2, 2.6))
    low, middle, high = torch.tensor(list(found.shares.values()), dtype=torch.float64).mT
    ax.bar(range(len(middle)), middle, color=AFTER, width=0.6)
    ax.errorbar(
        range(len(middle)),
        middle,
        yerr=torch.stack((middle - low, high - middle)),
        fmt="none",
        color=DATA,
        capsize=3,
    )
    ax.set_xticks(
        range(len(middle)), [phase.replace(" ", "\n") for phase in found.shares], fontsize=8
    )
    ax.set(ylabel="share of the signal", ylim=(0.0, 1.0))
    return ax


def plot_latent_pressure(found: LatentPressure, *, ax: Axes | None = None) -> Axes:
    """The pressure in the far field that would explain the residual, with its 90 % band."""
    ax = _axes(ax)
    half = _BAND * found.sd
    ax.fill_between(
        found.times,
        found.mean - half,
        found.mean + half,
        color=AFTER,
        alpha=0.25,
        lw=0,
        label="90 % band",
    )
    ax.plot(found.times, found.mean, color=AFTER, lw=1.5, label="mean")
    ax.axhline(0.0, color=DATA, lw=0.8)
    ax.set(xlabel=T_STAR, ylabel=r"latent pressure / $p_\infty$")
    ax.legend(frameon=False, fontsize=8)
    return ax


def plot_window_parameter(found: MovingWindows, name: str, *, ax: Axes | None = None) -> Axes:
    """One apparent parameter over the event, with its standard deviation."""
    ax = _axes(ax, (3.6, 2.8))
    i = found.names.index(name)
    entry = PARAMETERS[name]
    middle, low, high = (
        entry.display_scale * x[:, i] for x in (found.values, found.low, found.high)
    )
    ax.errorbar(
        found.centres,
        middle,
        yerr=torch.stack((middle - low, high - middle)),
        fmt="o-",
        ms=4,
        capsize=2,
        color=AFTER,
    )
    ax.set(xlabel="centre of the window, $t^*$", ylabel=entry.label)
    return ax


def plot_causes(posterior: dict[str, float], *, ax: Axes | None = None) -> Axes:
    """Probability of each cause, the most probable first; none and other stand out."""
    shown = sorted(posterior.items(), key=lambda item: -item[1])[:_BARS]
    ax = _axes(ax, (5.6, 1.0 + 0.27 * len(shown)))
    places = range(len(shown) - 1, -1, -1)
    colors = [{"none": "#AAAAAA", "other": ALARM}.get(name, AFTER) for name, _ in shown]
    ax.barh(places, [p for _, p in shown], color=colors, height=0.7)
    for place, (_, probability) in zip(places, shown, strict=True):
        ax.text(probability, place, f" {probability:.3f}", va="center", fontsize=8)
    ax.set_yticks(places, [name for name, _ in shown], fontsize=8)
    ax.set(xlabel="probability", xlim=(0.0, 1.3), xticks=[0.0, 0.25, 0.5, 0.75, 1.0])
    return ax


def only_other(posterior: Mapping[str, float]) -> bool:
    """Whether an unknown effect has all the probability, so that probabilities tell nothing of the
    known ones.
    """
    return posterior.get("other", 0.0) > _ALL


def plot_explained(
    explained: Mapping[str, float], unconverged: Collection[str] = (), *, ax: Axes | None = None
) -> Axes:
    """Nats that each effect explains alone, the most first.

    Light where its fit did not converge, so that they may be more.
    """
    shown = sorted(explained.items(), key=lambda item: -item[1])[:_BARS]
    ax = _axes(ax, (5.6, 1.0 + 0.27 * len(shown)))
    top = max(1.0, *(nats for _, nats in shown))
    for place, (name, nats) in zip(range(len(shown) - 1, -1, -1), shown, strict=True):
        loose = name in unconverged
        ax.barh(place, max(nats, 0.0), color=AFTER, alpha=0.35 if loose else 1.0, height=0.7)
        ax.text(
            max(nats, 0.0) + 0.02 * top,
            place,
            f"{nats:.0f}{' or more' if loose else ''}",
            va="center",
            fontsize=8,
        )
    ax.set_yticks(range(len(shown) - 1, -1, -1), [plain(name, 40) for name, _ in shown], fontsize=8)
    ax.set(xlabel="log evidence gained (nats)", xlim=(0.0, 1.3 * top))
    return ax


def plot_curves(
    batch: ExperimentBatch,
    number: int,
    base: Float[Tensor, "experiments frames"],
    after: Float[Tensor, "experiments frames"] | None = None,
    *,
    beside: str = "with_cause",
    ax: Axes | None = None,
    dense: Mapping[
        str, tuple[Float[Tensor, "experiments dense"], Float[Tensor, "experiments dense"]]
    ]
    | None = None,
) -> Axes:
    """Mean measured curve of one experiment, the base model, and the model with the cause or with
    additions.

    Args:
        batch: the data.
        number: which experiment.
        base: ``E x T`` tensor, prediction of the base model.
        after: ``E x T`` tensor, prediction with the cause or with additions, if there are some.
        beside: which of these ``after`` is, a key of :data:`BESIDE`.
        ax: where to draw.
        dense: ``"base"`` and ``beside`` at more times than the frames, t* and R* as ``E x D``
            tensors.
    """
    ax = _axes(ax)
    seen = batch.mask[number]
    times = batch.times[number]
    ax.plot(times[seen], batch.mean[number][seen], ".", ms=3, color=DATA, label="measured")
    for name, values, style, label in (
        ("base", base, {"color": BASE, "lw": 1.5, "ls": "--"}, "base model"),
        (beside, after, {"color": AFTER, "lw": 1.2}, BESIDE[beside]),
    ):
        if values is not None:
            at, curve = (
                (x[number] for x in dense[name]) if dense else (times[seen], values[number][seen])
            )
            ax.plot(at, curve, label=label, **style)
    ax.set(ylabel=R_STAR, ylim=(0.0, None))
    ax.set_title(plain(batch.experiments[number].label), fontsize=9)
    ax.legend(frameon=False, fontsize=7)
    return ax


def plot_residuals(
    batch: ExperimentBatch,
    number: int,
    base: Float[Tensor, "experiments frames"],
    after: Float[Tensor, "experiments frames"] | None = None,
    *,
    ax: Axes | None = None,
) -> Axes:
    """Residuals of the mean curve of one experiment over its noise, with the base model and with
    what is beside it.
    """
    ax = _axes(ax, (5.2, 2.2))
    seen = batch.mask[number]
    times = batch.times[number]
    noise = batch.sd(base)[number] / batch.counts[number].sqrt()
    ax.axhspan(-2.0, 2.0, color="#DDDDDD", lw=0)
    for curve, color, style in ((base, BASE, "--"), (after, AFTER, "-")):
        if curve is not None:
            ax.plot(
                times[seen],
                ((batch.mean - curve)[number] / noise)[seen],
                color=color,
                ls=style,
                lw=1.2,
            )
    ax.set(xlabel=T_STAR, ylabel="residual / noise")
    return ax


def plot_shrinkage(found: Shrinkage, *, ax: Axes | None = None) -> Axes:
    """Part of the squared bias on held-out designs that each hypothesis removes, with its 90 %
    interval.
    """
    names = list(found.shrinkage)
    ax = _axes(ax, (5.2, 1.0 + 0.4 * len(names)))
    low, middle, high = (
        100.0 * torch.tensor([found.shrinkage[name] for name in names], dtype=torch.float64).mT
    )
    places = range(len(names) - 1, -1, -1)
    ax.errorbar(
        middle,
        places,
        xerr=torch.stack((middle - low, high - middle)),
        fmt="o",
        color=AFTER,
        capsize=3,
    )
    for at in (0.0, 100.0):
        ax.axvline(at, color=DATA, lw=0.8)
    ax.set_yticks(
        places, [f"{name} (rival)" if name == found.rival else name for name in names], fontsize=8
    )
    ax.set(xlabel="held-out gap removed (%)", ylim=(-0.5, len(names) - 0.5))
    return ax


class DrawnStep(NamedTuple):
    """What is drawn of a step of a stepwise selection, in R*.

    ``closed``: lower, median and upper share of the held-out gap.
    """

    effects: Sequence[str]
    misfit: float
    noise: float
    closed: Sequence[float] | None


def plot_selection(steps: Sequence[DrawnStep], *, ax: Axes | None = None) -> Axes:
    """Misfit in R* from the base model to the last effect added, beside the noise, with what each
    step closes held out.
    """
    ax = _axes(ax, (5.8, 1.3 + 0.5 * len(steps)))
    places = list(range(len(steps) - 1, -1, -1))
    ax.barh(
        places,
        [step.misfit for step in steps],
        color=[BASE, *[AFTER] * (len(steps) - 1)],
        height=0.55,
    )
    ax.axvline(steps[-1].noise, color=DATA, ls="--", lw=1, label="noise of the mean curves")
    top = max(*(step.misfit for step in steps), steps[-1].noise)
    for place, step in zip(places, steps, strict=True):
        closed = (
            ""
            if step.closed is None
            else "\ncloses {1:.2f} ({0:.2f} to {2:.2f})".format(*step.closed)
        )
        behind = {"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8}
        ax.text(
            step.misfit + 0.03 * top,
            place,
            f"{step.misfit:.4f}{closed}",
            va="center",
            fontsize=7,
            bbox=behind,
        )
    names = ["base model", *("+ " + plain(_added(a, b), 50) for a, b in itertools.pairwise(steps))]
    ax.set_yticks(places, names, fontsize=8)
    ax.set(
        xlabel="misfit in $R^*$ (root mean square, beyond noise)",
        xlim=(0.0, 2.1 * top),
        ylim=(-0.6, len(steps) - 0.4),
    )
    ax.legend(frameon=False, fontsize=7, loc="lower right")
    return ax


def _added(before: DrawnStep, after: DrawnStep) -> str:
    """What one step has that the one before has not, and what it dropped."""
    added = [name for name in after.effects if name not in before.effects]
    dropped = [name for name in before.effects if name not in after.effects]
    return ", ".join(map(in_words, added)) + (
        f", without {', '.join(map(in_words, dropped))}" if dropped else ""
    )


def plot_shift(base: ModelFit, after: ModelFit, *, ax: Axes | None = None) -> Axes:
    """How far the cause moves the parameters of the base model: 90 % intervals relative to the base
    model's medians.
    """
    names = base.prior.names
    ax = _axes(ax, (5.2, 0.9 + 0.5 * len(names)))
    levels = torch.tensor((0.05, 0.5, 0.95), dtype=torch.float64)
    before = base.posterior.quantile(levels)
    later = after.posterior.quantile(levels)[:, [after.prior.names.index(name) for name in names]]
    for values, color, offset, label in (
        (before, BASE, 0.12, "base model"),
        (later, AFTER, -0.12, "with the cause"),
    ):
        low, middle, high = 100.0 * (values / before[1] - 1.0)
        places = [len(names) - 1 - i + offset for i in range(len(names))]
        ax.errorbar(
            middle,
            places,
            xerr=torch.stack((middle - low, high - middle)),
            fmt="o",
            color=color,
            capsize=3,
            label=label,
        )
    ax.axvline(0.0, color=DATA, lw=0.8)
    ax.set_yticks(
        range(len(names) - 1, -1, -1), [PARAMETERS[name].label for name in names], fontsize=8
    )
    ax.set(
        xlabel="change against the base model (%), 90 % intervals", ylim=(-0.5, len(names) - 0.5)
    )
    ax.legend(frameon=False, fontsize=8)
    return ax
