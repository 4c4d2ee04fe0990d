"""Sphinx extension: one page for each constitutive model and effect of the registries, with its
equation and its picture.
"""

from inspect import isfunction
from pathlib import Path

import matplotlib
import numpy as np
import torch
from formulas import EFFECTS, MODELS
from look_alikes import BASE, LookAlikes
from matplotlib import pyplot as plt
from pages import Folder, table

from imr_torch.labels import file_name
from imr_torch.material import (
    LIBRARY,
    MATERIALS,
    PARAMETERS,
    Effect,
    LogNormal,
    Marginal,
    Material,
    TruncatedNormal,
)
from imr_torch.observe import Film, predict
from imr_torch.simulate import ACCURACIES, TransportSimulator

TYPICAL = {
    "G": 5000.0,
    "mu": 0.1,
    "alpha": 0.3,
    "G_lin": 5000.0,
    "alpha_fung2": 0.05,
    "alpha_fung": 0.02,
    "thinning": 0.3,
    "shear_time": 1e-5,
    "tau": 5e-6,
    "retardation": 0.1,
    "tau_sls": 5e-6,
    "tau_sns": 5e-6,
    "tau_ucm": 5e-6,
}
"""Values at which the pictures of the models are drawn; parameters of other models take the median of their prior."""

PLACES = {
    "material": "the gel",
    "gas": "what is in the bubble",
    "liquid": "the liquid around the bubble",
    "geometry": "the geometry",
    "driving": "what drives the bubble",
    "measurement": "the camera and its clock",
}
_DESIGN = (450.0, 0.20)
_TIMES = torch.linspace(0.0, 3.0, 301, dtype=torch.float64)
_COLOURS = ("#0072B2", "#D55E00", "#009E73")
_SMALL = (
    0.2  # of the amplitude at which fits start: where changes are compared, they are linear
)
_EXTENDS = {
    "qkv": "alpha",
    "gen_qkv": "alpha",
    "fung2": "alpha_fung2",
    "fungexp": "alpha_fung",
    "carreau": "thinning",
}
_EXTENDS |= {"zener": "tau", "sns": "tau_sns"}


def curves(rows: list[dict[str, float]]) -> np.ndarray:
    """``K x T`` radii as filmed."""
    film = Film(torch.tensor([_DESIGN], dtype=torch.float64), _TIMES[None])
    simulator = TransportSimulator(accuracy=ACCURACIES["search"], threads=1)
    return predict(simulator, torch.stack([PARAMETERS.pack(row) for row in rows]), film)[
        :, 0
    ].numpy()


def prior_text(prior: Marginal | None) -> str:
    """A prior in words."""
    if isinstance(prior, LogNormal):
        return f"log-normal, median {prior.median:g}, factor {prior.factor:g} for one sd"
    if isinstance(prior, TruncatedNormal):
        ends = "" if prior.lower == -np.inf else f", from {prior.lower:g} on"
        return f"normal, mean {prior.mean:g}, sd {prior.sd:g}{ends}" + (
            "" if prior.upper == np.inf else f", to {prior.upper:g}"
        )
    return "" if prior is None else str(prior)


def parameter_table(
    names: tuple[str, ...], priors: dict[str, Marginal | None], known: tuple[str, ...] = ()
) -> str:
    """Parameters with units, bounds, the value at which they do nothing, and the prior."""
    rows = []
    for name in names:
        entry = PARAMETERS[name]
        unit = "" if entry.unit == "1" else entry.unit
        prior = (
            "must be measured independently"
            if name in known
            else prior_text(priors.get(name))
        )
        rows.append(
            (
                f"`{name}`",
                entry.meaning,
                unit,
                f"{entry.lower:g} to {entry.upper:g}",
                f"{entry.neutral:g}",
                prior,
            )
        )
    return table(
        (
            "name",
            "meaning",
            "SI unit",
            "allowed",
            "does nothing at",
            "prior where it is inferred",
        ),
        rows,
    )


def _save(figure: plt.Figure, path: Path) -> None:
    figure.savefig(path, dpi=120, metadata={"Software": None})
    plt.close(figure)


def draw_model(model: Material, name: str, path: Path) -> None:
    """R(t) at three values of one free parameter, the others at typical ones."""
    centre = {each: TYPICAL.get(each, _median(each)) for each in model.names}
    entry = PARAMETERS[name]
    values = [min(entry.upper, share * centre[name]) for share in (1.0 / 3.0, 1.0, 3.0)]
    figure, axis = plt.subplots(figsize=(3.4, 2.7), layout="constrained")
    for value, radius, colour in zip(
        values, curves([{**centre, name: x} for x in values]), _COLOURS, strict=True
    ):
        axis.plot(
            _TIMES,
            radius,
            color=colour,
            label=f"{entry.display_scale * value:.3g} {_unit(name)}".strip(),
        )
    axis.set(
        xlabel=r"$t\,U_c/R_\mathrm{max}$",
        ylabel=r"$R/R_\mathrm{max}$",
        ylim=(0.0, 1.15),
        title=name,
    )
    axis.legend(fontsize="small", frameon=False, loc="upper right")
    _save(figure, path)


def model_pictures(model: Material) -> str:
    """The pictures of a model side by side, below each other on a narrow screen."""
    file = f"model-{model.key}-{{0}}.png"
    one = f":::{{{{grid-item}}}}\n![Radius over time at three values of {{0}}]({file})\n:::"
    pictures = "\n".join(one.format(name) for name in model.free)
    return f"::::{{grid}} 1 {min(2, len(model.free))} 3 3\n:gutter: 1\n\n{pictures}\n::::"


def draw_effect(effect: Effect, path: Path) -> None:
    """R(t) of the base gel without the effect and with two sizes of it, and the differences."""
    extra = {effect.needs: BASE[effect.needs]} if effect.needs in BASE else {}
    starts = [effect.starts[0], effect.starts[min(1, len(effect.starts) - 1)]]
    rows = [dict(zip(effect.names, start, strict=True)) for start in starts]
    neutral, *changed = curves([BASE | extra, *({**BASE, **extra, **row} for row in rows)])
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.0, 2.8), layout="constrained")
    left.plot(_TIMES, neutral, color="0.45", linewidth=3.0, alpha=0.5, label="without it")
    for row, radius, colour in zip(rows, changed, _COLOURS, strict=False):
        label = ", ".join(f"{name} {value:.3g}" for name, value in row.items())
        left.plot(_TIMES, radius, color=colour, label=label)
        right.plot(_TIMES, radius - neutral, color=colour)
    left.set(
        xlabel=r"$t\,U_c/R_\mathrm{max}$", ylabel=r"$R/R_\mathrm{max}$", ylim=(0.0, 1.2)
    )
    right.set(xlabel=r"$t\,U_c/R_\mathrm{max}$", ylabel=r"change of $R/R_\mathrm{max}$")
    right.axhline(0.0, color="0.7", linewidth=0.8)
    left.legend(fontsize="x-small", frameon=False, loc="upper right")
    _save(figure, path)


def _median(name: str) -> float:
    prior = PARAMETERS[name].prior
    return (
        prior.median
        if isinstance(prior, LogNormal)
        else 0.5 * prior.sd
        if isinstance(prior, TruncatedNormal)
        else 0.1
    )


def _unit(name: str) -> str:
    unit = PARAMETERS[name].display_unit or PARAMETERS[name].unit
    return "" if unit == "1" else unit


def compared() -> LookAlikes:
    """The changes of all effects, and of the models that extend NHKV by one thing."""
    changes = {}
    for name, effect in LIBRARY.items():
        amplitude, *shape = effect.starts[0]
        changes[name] = {
            **BASE,
            **dict(zip(effect.names, (_SMALL * amplitude, *shape), strict=True)),
        }
    for key, switch in _EXTENDS.items():
        own = {name: TYPICAL[name] for name in MATERIALS[key].names if name not in BASE}
        changes[f"model {key}"] = {**BASE, **own, switch: _SMALL * own[switch]}
    return LookAlikes(changes)


def likeness_text(found: LookAlikes, name: str) -> str:
    """The table of look-alikes, or why there is none."""
    if name not in found.left:
        return (
            "To first order G, mu, Rmax, time zero and R_inf absorb all that it does: it cannot "
            "be told from them.\n"
        )
    share = (
        "Of its change of R(t), G, mu, Rmax, time zero and R_inf absorb "
        f"{100.0 * found.absorbed(name):.3g} %. "
    )
    nearest = found.nearest(name)
    if not nearest:
        return share + (
            "What remains encloses an angle of more than 60 degrees with that of every other "
            "entry.\n"
        )
    rows = [
        (
            _link(one.name),
            f"{one.angle:.0f}°",
            f"{100.0 * np.sin(np.radians(one.angle)):.0f} %",
            f"{one.where} (We {one.weber:g})",
        )
        for one in nearest
    ]
    head = ("looks like", "angle", "left after the best match", "what is left is largest")
    return (
        f"{share}What remains looks most like:\n\n{table(head, rows)}\n[How these angles are "
        "computed](index.md#look-alikes).\n"
    )


def _link(name: str) -> str:
    kind, _, key = name.rpartition(" ")
    return (
        f"[{MATERIALS[key].title} (model)](model-{key}.md)"
        if kind
        else f"[{key}](effect-{file_name(key)}.md)"
    )


def equations(text: str) -> str:
    """The parts of a formula, one below the other, so that they fit on a narrow screen."""
    return "\n\n".join(f"$$\n{part.strip()}\n$$" for part in text.split(r", \qquad"))


def model_page(model: Material, found: LookAlikes) -> str:
    """The page of a constitutive model."""
    doc = (type(model).__doc__ or "").strip()
    priors = {name: PARAMETERS[name].prior for name in model.names}
    alike = (
        f"## Look-alikes\n\n{likeness_text(found, f'model {model.key}')}\n"
        if model.key in _EXTENDS
        else ""
    )
    return f"""# {model.title}

{doc} On the command line and in Python it is called `{model.key}`.

## Equation

{equations(MODELS[model.key])}

$S$ is the stress integral, which adds to the pressure of the liquid at the wall; $\\lambda = R/R_\\infty$. See
[what a model says](index.md#what-a-model-says).

## Parameters

{parameter_table(model.names, priors, model.known)}
## What it does to R(t)

One panel a parameter, each at a third, once and three times its typical value; We {_DESIGN[0]:g},
R_inf/Rmax {_DESIGN[1]:g}, heat and vapour transport.

{model_pictures(model)}

{alike}## Source

{model.reference}.
"""


def effect_page(effect: Effect, found: LookAlikes) -> str:
    """The page of an effect."""
    group = [
        other.name
        for other in LIBRARY.values()
        if other.family == effect.family and other is not effect
    ]
    same = (
        f"A diagnosis reports it in one class with {', '.join(_link(x) for x in group)}.\n\n"
        if group
        else ""
    )
    needs = (
        f"It acts only on models that have `{effect.needs}`.\n\n" if effect.needs else ""
    )
    return f"""# {effect.name}

{effect.meaning[0].upper() + effect.meaning[1:]}. It concerns {PLACES[effect.place]}.

{needs}{same}## What it changes

{equations(EFFECTS[effect.name])}

{_laws(effect)}
## Parameters

{parameter_table(effect.names, dict(effect.priors))}
## What it does to R(t)

Two sizes of it on an NHKV gel with G = {BASE["G"]:g} Pa and mu = {BASE["mu"]:g} Pa s; We {_DESIGN[0]:g},
R_inf/Rmax {_DESIGN[1]:g}.

![Radius over time without and with {effect.name}, and the difference](effect-{file_name(effect.name)}.png)

## Look-alikes

{likeness_text(found, effect.name)}
## Try it

Let a diagnosis decide among it and what looks like it:

```shell
imr-torch diagnose gel.csv --effects {",".join([effect.name, *(x.name for x in found_effects(found, effect))])}
```
"""


def found_effects(found: LookAlikes, effect: Effect) -> list[Effect]:
    """The nearest effects that can be put on NHKV beside it."""
    names = [one.name for one in found.nearest(effect.name, most=3) if one.name in LIBRARY]
    return [LIBRARY[name] for name in names if LIBRARY[name].applies("nhkv")][:2]


def _laws(effect: Effect) -> str:
    """What the code says of its law."""
    from imr_torch.material.models import TERMS

    laws = [
        law
        for law in (effect.setting, effect.gas_loss, effect.vapour, effect.far_field)
        if isfunction(law)  # what only adds to or scales an entry says nothing more
    ]
    laws += (
        []
        if laws
        else [term.excess or term.law for term in TERMS if term.switch == effect.names[0]]
    )
    said = [effect.note, *(law.__doc__ or "" for law in laws)]
    said = [" ".join(text.split()).replace("``", "`") for text in said]
    told = [
        text for text in said if text and text.rstrip(".").lower() != effect.meaning.lower()
    ]
    return "\n\n".join(f"*From the code:* {text}" for text in told) + "\n"


def index_page() -> str:
    """The table of contents of the catalogue."""
    models = table(
        ("model, and its name in commands", "parameters", "in a sentence"),
        (
            (
                f"[{m.title}](model-{m.key}.md) `{m.key}`",
                ", ".join(m.names),
                (type(m).__doc__ or "").strip().splitlines()[0],
            )
            for m in MATERIALS.values()
        ),
    )
    effects = "\n".join(
        f"### Of {words}\n\n"
        + table(
            ("effect", "meaning"),
            ((_link(e.name), e.meaning) for e in LIBRARY.values() if e.place == place),
        )
        for place, words in PLACES.items()
    )
    pages = "\n".join(
        [
            *(f"model-{key}" for key in MATERIALS),
            *(f"effect-{file_name(name)}" for name in LIBRARY),
        ]
    )
    return (
        (Path(__file__).parent / "catalogue_index.md")
        .read_text()
        .format(models=models, effects=effects, pages=pages)
    )


def generate(folder: Path) -> None:
    """Write all pages and pictures."""
    matplotlib.use("agg")
    found = compared()
    with (
        Folder(folder) as out,
        plt.rc_context(
            {"axes.spines.top": False, "axes.spines.right": False, "font.size": 9}
        ),
    ):
        out.write("index.md", index_page())
        for model in MATERIALS.values():
            out.write(f"model-{model.key}.md", model_page(model, found))
            for name in model.free:
                draw_model(model, name, out.place(f"model-{model.key}-{name}.png"))
        for effect in LIBRARY.values():
            name = f"effect-{file_name(effect.name)}"
            out.write(f"{name}.md", effect_page(effect, found))
            draw_effect(effect, out.place(f"{name}.png"))
