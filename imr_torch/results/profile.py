"""Profile likelihoods in a result document: their figure."""

from collections.abc import Iterator, Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imr_torch.assimilate.profile import FALL
from imr_torch.labels import file_name
from imr_torch.material import PARAMETERS, Belief, ModelBelief, material
from imr_torch.results.named import NamedFigure
from imr_torch.results.plot import DATA, MODEL, PALE, SECOND, parameter_label, set_scale

_TOP = 4.2  # nats that are drawn
_COLUMNS = 2
_REACH = 3.0  # standard deviations of the posterior that are drawn


def profile_named_figures(document: Mapping[str, Any]) -> Iterator[NamedFigure]:
    """A figure for each model with profiles: ``profile`` of the most probable one, ``profile_KEY``
    of others.

    Args:
        document: of ``characterize``.
    """
    best = max(document["model_probabilities"], key=document["model_probabilities"].__getitem__)
    for key, found in (document.get("profiles") or {}).items():
        if found:
            yield NamedFigure(
                "profile" if key == best else f"profile_{file_name(key)}",
                f"Profile likelihood of the parameters of {material(key).title}: nats that the "
                "best fit loses where one "
                "is held and all others are fitted again, beside posterior and prior. Below the "
                "dashed line: 95 %. A side on "
                "which it stays below is open: the data do not bound the parameter there.",
                f"Line charts of the profile likelihood of {', '.join(found)}.",
                lambda key=key: profile_figure(document, key),
            )


def profile_figure(document: Mapping[str, Any], key: str) -> Figure:
    """The profiles of one model, a panel a parameter.

    Args:
        document: of ``characterize``.
        key: the model.
    """
    found = document["profiles"][key]
    prior, posterior = (Belief.from_dict(document[name])[key] for name in ("prior", "belief"))
    columns = min(_COLUMNS, len(found))
    rows = -(-len(found) // columns)
    size = (0.6 + 2.7 * columns, 0.9 + 2.3 * rows)
    figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for ax in axes.flat[len(found) :]:
        ax.set_axis_off()
    for ax, (name, entry) in zip(axes.flat, found.items(), strict=False):
        _plot_profile(ax, name, entry, prior, posterior)
    for ax in axes[:, 0]:
        ax.set_ylabel("nats lost")
    figure.legend(
        *axes.flat[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=2 * columns,
        frameon=False,
        fontsize=8,
    )
    return figure


def _plot_profile(
    ax: Axes, name: str, entry: Mapping[str, Any], prior: ModelBelief, posterior: ModelBelief
) -> None:
    """The profile of one parameter, with the line of 95 % and what posterior and prior would lose."""
    parameter = PARAMETERS[name]
    values = parameter.display_scale * np.asarray(entry["values"], dtype=float)
    lost = np.asarray(entry["nats_lost"], dtype=float)
    z = torch.linspace(-_REACH, _REACH, 121, dtype=torch.float64)
    curves = [
        parameter.display_scale
        * part.quantile(torch.special.ndtr(z))[:, part.names.index(name)].numpy()
        for part in (prior, posterior)
    ]
    low = min(values.min(), curves[1].min())
    high = max(values.max(), curves[1].max())
    wide = set_scale(ax, "x", low, high)
    ax.axhline(FALL, color=DATA, ls="--", lw=1.0, label="95 %")
    for at, color, label in zip(curves, (PALE, SECOND), ("prior", "posterior"), strict=True):
        ax.plot(at, 0.5 * z.square(), color=color, lw=1.2, label=label)
    ax.plot(*_between(values, lost, wide), color=MODEL, lw=1.4, label="profile", zorder=3)
    converged = np.asarray(entry["converged"], dtype=bool)
    ax.plot(values[converged], lost[converged], ".", ms=6, color=MODEL, zorder=4)
    ax.plot(values[~converged], lost[~converged], "o", ms=4.5, mfc="white", mec=MODEL, zorder=4)
    for limit in entry["limits_95"]:
        if limit is not None:
            ax.plot(2 * [parameter.display_scale * limit], (0.0, FALL), color=MODEL, lw=0.9, ls=":")
    ax.set(xlim=(low, high), ylim=(0.0, _TOP), xlabel=parameter_label(parameter))
    ax.set_title(f"bounded {entry['bounded']}", fontsize=9)


def _between(values: np.ndarray, lost: np.ndarray, wide: bool) -> tuple[np.ndarray, np.ndarray]:
    """Points of a smooth line: the root of the nats lost, signed by the side, is nearly straight
    between fits.
    """
    at = np.log(values) if wide else values
    best = int(lost.argmin())
    roots = np.sqrt(lost) * np.where(np.arange(len(lost)) < best, -1.0, 1.0)
    dense = np.linspace(at[0], at[-1], 201)
    return (np.exp(dense) if wide else dense), np.interp(dense, at, roots) ** 2
