"""The figures of the reproduction: each computes its pieces once, keeps them as JSON, and draws
them.

All but ``sequence`` and ``trajectory``, which read the campaigns' journals, are of the stiff-PA
case. "Published" names the estimators and the inference of the study; "default" those of this
package.
"""

import json
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullFormatter
from paper_campaigns import (
    PLAN,
    POLICIES,
    SEARCH,
    SIMULATOR,
    WITHIN,
    Row,
    informations,
    read,
    study,
    true_controls,
)

from imr_torch.assimilate import PublishedFit, assimilate_published
from imr_torch.campaign import (
    PAPER_OPTIMAL,
    ExactLearner,
    Learner,
    Observations,
    Optimal,
    PaperLearner,
    Situation,
)
from imr_torch.cli.figures import save
from imr_torch.design import DesignSpace, Laplace, PublishedEstimator, gains_of_each
from imr_torch.files import write_json
from imr_torch.labels import REST_RADIUS, WEBER, symbol, with_unit
from imr_torch.material import CASES, PARAMETERS, Belief, TruncatedNormal, reference_case
from imr_torch.observe import Experiment, ExperimentBatch, SimulatedLaboratory, collapse_time
from imr_torch.random import child
from imr_torch.results import for_publication
from imr_torch.results.plot import CYCLE, MODEL, SECOND, TRUTH
from imr_torch.results.publication import STYLE

CASE = reference_case("stiff-pa")
RADII = {"985 um, .2887": (985e-6, 0.2887), "387 um, .15": (387e-6, 0.15)}
DRAWS = (200, 400, 800, 1600)
SPREADS = (0.02, 0.04, 0.06, 0.08, 0.10)
NOISES = (0.5, 1.0, 2.0, 4.0)
LIMIT_WEBERS = (100.0, 150.0, 200.0, 300.0, 400.0, 500.0, 650.0, 800.0, 1000.0)
LIMIT_RESTS = (0.14, 0.16, 0.18, 0.20, 0.22, 0.24, 0.26, 0.28, 0.30)
LEARNERS: dict[str, Learner] = {"paper": PaperLearner(), "exact": ExactLearner()}
NAMES = {"paper": "published", "exact": "default"}  # of the ways to learn, in figures
TITLES = {"stiff-pa": "stiff PA", "soft-pa": "soft PA"}
MODELS = {"nhkv": "NHKV", "gen_qkv": "gen. qKV"}
LEAST = 1e-12  # probability below which points are drawn at the lower edge
COLORS = {"optimal": MODEL, "random": SECOND}
plt.rcParams.update(STYLE | {"axes.prop_cycle": cycler(color=CYCLE), "legend.frameon": False})


def remembered(folder: Path, name: str, compute: Callable[[], Any]) -> Any:
    """A piece of a figure, computed unless it is there, with the CPU time that it took."""
    path = folder / "pieces" / f"{name}.json"
    if not path.exists():
        started = time.process_time()
        result = compute()
        write_json(path, result | {"cpu_seconds": time.process_time() - started})
        print(f"{path}: {time.process_time() - started:.0f} s CPU", flush=True)
    return json.loads(path.read_text())


def finish(folder: Path, name: str, document: Any, figure: Figure, columns: str = "two") -> None:
    """Write ``NAME.json``, ``NAME.png`` and ``NAME.pdf``, one or two columns wide."""
    write_json(folder / f"{name}.json", document)
    save(for_publication(lambda: figure, columns), folder, name)
    print(f"wrote {folder / name}.json, .png and .pdf")


def legend_above(figure: Figure, ax: Axes) -> None:
    """The legend of one panel above all of them, where it hides no data."""
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))


def weber(radius: float) -> float:
    """Weber number of a maximum radius in metres."""
    return radius / float(
        SIMULATOR.conditions.surroundings.max_radius(torch.tensor(1.0, dtype=torch.float64))
    )


def shoot(design: tuple[float, float], seed: int, *, scale: float = 1.0) -> Experiment:
    """100 curves of the true gel, cut at the second collapse."""
    noise = replace(PLAN.noise, scale=scale)
    laboratory = SimulatedLaboratory(
        SIMULATOR, PARAMETERS.pack(CASE.truth), noise=noise, repeats=PLAN.repeats
    )
    whole = laboratory.shoot(
        torch.tensor(design, dtype=torch.float64), seed=child(seed, "shoot", 1)
    )
    return whole.until(collapse_time(whole.times, whole.mean, 2))


def learn(
    learner: Learner, experiment: Experiment, belief: Belief, seed: int, *, scale: float = 1.0
) -> Belief:
    """The belief after one experiment."""
    batch = ExperimentBatch((experiment,), replace(PLAN.noise, scale=scale))
    return learner.learn(Observations(belief, belief, batch, 1, seed), SIMULATOR).belief


def bo(folder: Path) -> None:
    """Trajectories and convergence of the search for a design, over the draws of the published
    estimator, and the default's.
    """

    def search(policy: Optimal) -> dict[str, Any]:
        found = policy.choose(Situation(1, CASE.prior, SIMULATOR, DesignSpace(), PLAN, 0)).search
        assert found is not None
        best = found.recommendation
        return {
            "designs": found.designs.tolist(),
            "gains": [gain.value for gain in found.gains],
            "sds": [gain.variance**0.5 for gain in found.gains],
            "recommended": best.design.tolist(),
            "gain": best.mean,
        }

    searches = {
        f"paper_{n}": replace(PAPER_OPTIMAL, estimator=PublishedEstimator(n // 2)) for n in DRAWS
    } | {"default_32": SEARCH}
    rows = {
        name: remembered(folder, f"bo_{name}", lambda p=policy: search(p))
        for name, policy in searches.items()
    }
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.6), layout="constrained")
    for name, row in rows.items():
        ahead = torch.tensor(row["gains"]).cummax(0).values
        way, draws = name.split("_")
        label = f"{NAMES.get(way, way)}, {draws} draws"
        axes[0].plot(range(1, len(ahead) + 1), ahead - ahead[-1], label=label, lw=1.2)
        axes[1].plot(*zip(*row["designs"], strict=True), ".", ms=4)
        axes[1].plot(*row["recommended"], "*", ms=12, color=axes[1].lines[-1].get_color())
        axes[2].plot(range(1, len(ahead) + 1), row["gains"], ".-", ms=3, lw=0.7)
    axes[0].set(xlabel="evaluation", ylabel="best gain less the last (nats)")
    axes[1].set(xlabel=WEBER, ylabel=REST_RADIUS, title="evaluated; stars: recommended")
    axes[2].set(xlabel="evaluation", ylabel="gain (nats)")
    legend_above(figure, axes[0])
    finish(folder, "bo", rows, figure)


def search(folder: Path) -> None:
    """Whether the cheap search ends where a dearer one does, for the first and the second design of
    a campaign.

    The dearer one has four times the draws and asks for one design at a time; both ends are judged
    with 128 fresh common draws of each model.
    """
    dear = Optimal(Laplace(draws=64), batch=1)
    judge = Laplace(draws=128)
    campaigns = study(folder, CASE, "optimal", "exact")
    seeds = [seed for seed in range(3) if campaigns.open(seed).steps]

    def compute(number: int, seed: int) -> dict[str, Any]:
        belief = CASE.prior if number == 1 else campaigns.open(seed).steps[number - 2].belief
        ends = []
        seconds = []
        for policy in (SEARCH, dear):
            started = time.process_time()
            ends.append(
                policy.choose(
                    Situation(number, belief, SIMULATOR, DesignSpace(), PLAN, seed)
                ).design
            )
            seconds.append(time.process_time() - started)
        gains = gains_of_each(
            belief, torch.stack(ends), SIMULATOR, PLAN, estimator=judge, seed=12345
        )
        return {
            "ends": [end.tolist() for end in ends],
            "gains": [gain.value for gain in gains],
            "search_cpu": seconds,
        }

    rows = {
        f"design {number}, seed {seed}": remembered(
            folder, f"search_{number}_{seed}", lambda n=number, s=seed: compute(n, s)
        )
        for number in (1, 2)
        for seed in seeds
    }
    figure, ax = plt.subplots(figsize=(5.5, 3.4), layout="constrained")
    for i, (name, row) in enumerate(rows.items()):
        (a, b), (c, d) = row["ends"]
        ax.annotate("", (a, b), (c, d), arrowprops={"arrowstyle": "->", "color": f"C{i}"})
        ax.plot(
            [a, c],
            [b, d],
            "o",
            color=f"C{i}",
            label=f"{name}: {row['gains'][0] - row['gains'][1]:+.3f}",
        )
    ax.set(xlabel=WEBER, ylabel=REST_RADIUS, title="from a dear search to the default; gain (nats)")
    ax.legend()
    finish(folder, "search", rows, figure, "one")


def ensembles(folder: Path) -> None:
    """Published ensembles of one design over iterations and restarts."""
    design = (weber(985e-6), 0.2887)

    def states(fit: PublishedFit) -> dict[str, Any]:
        values = [fit.prior.physical(z) for z in fit.ensembles]
        return {
            "names": fit.prior.names,
            "means": [v.mean(0).tolist() for v in values],
            "sds": [v.std(0).tolist() for v in values],
        }

    def compute() -> dict[str, Any]:
        fits = assimilate_published(CASE.prior, shoot(design, 0), PLAN.noise, SIMULATOR, seed=0)
        return {fit.prior.model: states(fit) for fit in fits}

    found = remembered(folder, "ensembles", compute)
    figure, axes = plt.subplots(1, 5, figsize=(15, 3.2), layout="constrained")
    panels = [(model, i) for model in CASE.prior.keys for i in range(len(found[model]["names"]))]
    for ax, (model, i) in zip(axes, panels, strict=True):
        mean, sd = (
            torch.tensor([row[i] for row in found[model][kind]]) for kind in ("means", "sds")
        )
        ax.errorbar(range(len(mean)), mean, sd, fmt=".-", capsize=2)
        for restart in (5, 10):
            ax.axvline(restart - 0.5, color="0.7", lw=0.8)
        name = found[model]["names"][i]
        if model == CASE.truth_model:
            ax.axhline(CASE.truth[name], color=TRUTH, ls="--")
        ax.set(
            title=MODELS[model],
            ylabel=with_unit(symbol(name), PARAMETERS[name].unit),
            xlabel="iteration",
        )
    finish(folder, "ensembles", found, figure)


def models(folder: Path, seeds: Sequence[int] = range(3)) -> None:
    """Probability of the wrong model (NHKV) at two designs, as published and by evidence."""
    rows = {}
    for (mode, learner), (name, (radius, rest)), seed in product(
        LEARNERS.items(), RADII.items(), seeds
    ):

        def compute(
            design: tuple[float, float] = (weber(radius), rest),
            how: Learner = learner,
            seed: int = seed,
        ) -> dict[str, Any]:
            belief = learn(how, shoot(design, seed), CASE.prior, seed)
            return {"design": design, "probability_nhkv": belief.probabilities["nhkv"]}

        rows[f"{name} | {mode} | {seed}"] = remembered(
            folder, f"models_{name.split()[0]}_{mode}_{seed}", compute
        )
    figure, ax = plt.subplots(figsize=(5.5, 3.4), layout="constrained")
    for mode, color, aside in (("paper", SECOND, -0.1), ("exact", MODEL, 0.1)):
        points = [
            (place + aside, max(row["probability_nhkv"], LEAST))
            for place, name in enumerate(RADII)
            for key, row in rows.items()
            if key.startswith(f"{name} | {mode}")
        ]
        ax.plot(*zip(*points, strict=True), "o", ms=4, color=color, label=NAMES[mode])
    ax.set(
        xlim=(-0.5, 1.5),
        xticks=range(len(RADII)),
        ylabel=f"P(NHKV), {LEAST:g} or more",
        yscale="log",
    )
    ax.set_xticklabels(
        [
            f"$R_\\mathrm{{max}}$ = {1e6 * radius:.0f} µm\n$R_\\infty^*$ = {rest:g}"
            for radius, rest in RADII.values()
        ]
    )
    ax.legend()
    finish(folder, "models", rows, figure, "one")


def errors(folder: Path) -> None:
    """What limits the answer: the spread of G_inf in the prior, and the noise; generalised qKV
    alone, one design.
    """
    design = (weber(985e-6), 0.2887)
    part = CASE.prior["gen_qkv"]
    true = torch.tensor([CASE.truth[name] for name in part.names], dtype=torch.float64)

    def compute(spread: float, scale: float, learner: Learner) -> dict[str, Any]:
        marginals = dict(zip(part.names, part.marginals, strict=True))
        marginals["G"] = TruncatedNormal(2770.0, spread * 2770.0, lower=0.0)
        belief = Belief.prior({"gen_qkv": marginals})
        after = learn(learner, shoot(design, 0, scale=scale), belief, 0, scale=scale)["gen_qkv"]
        return {"sds": (after.sds / true).tolist(), "errors": (after.means / true - 1.0).tolist()}

    rows = {}
    for mode, learner in LEARNERS.items():
        for spread, scale in [(s, 1.0) for s in SPREADS] + [(0.1, n) for n in NOISES if n != 1.0]:
            name = f"errors_{mode}_{spread:g}_{scale:g}"
            rows[name] = remembered(
                folder, name, lambda s=spread, n=scale, how=learner: compute(s, n, how)
            )
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for ax, values, label in (
        (axes[0], SPREADS, "relative prior sd of $G$"),
        (axes[1], NOISES, "noise, times the published"),
    ):
        for mode, style, face in (("exact", "-", None), ("paper", "--", "white")):
            keys = [
                f"errors_{mode}_{v:g}_1" if ax is axes[0] else f"errors_{mode}_0.1_{v:g}"
                for v in values
            ]
            for i, name in enumerate(part.names):
                sds = [rows[k]["sds"][i] for k in keys]
                curve = f"{symbol(name)}, {NAMES[mode]}"
                ax.plot(
                    values,
                    sds,
                    style,
                    color=f"C{i}",
                    marker="o",
                    mfc=face,
                    ms=4,
                    lw=1.2,
                    label=curve,
                )
        ax.set(xlabel=label, ylabel="posterior sd / truth", yscale="log")
    legend_above(figure, axes[0])
    finish(folder, "errors", rows, figure)


def limit(folder: Path) -> None:
    """What the best designs of a grid would leave if the gel were known: what a search over these
    designs cannot beat.

    Best by the largest relative standard deviation of a parameter, and by the volume of the
    posterior.
    """
    grid = torch.tensor(list(product(LIMIT_WEBERS, LIMIT_RESTS)), dtype=torch.float64)
    part = CASE.prior[CASE.truth_model]
    truth = true_controls(CASE)
    each = informations(CASE, grid, SIMULATOR)
    slopes: Any = torch.autograd.functional.jacobian(
        lambda v: part.physical(part.mean + part.chol @ v), truth
    )
    gel = part.physical(part.mean + part.chol @ truth)
    document = {}
    figure = plt.figure(figsize=(9.0, 3.2), layout="constrained")
    for count, ax in enumerate(figure.subplots(1, 3), start=1):
        sets = torch.combinations(torch.arange(len(grid)), count, with_replacement=True)
        known = torch.eye(len(gel), dtype=torch.float64) + each[sets].sum(1)
        covariance = slopes @ torch.linalg.inv(known) @ slopes.mT
        sds = covariance.diagonal(dim1=-2, dim2=-1).sqrt() / gel
        worst = sds.amax(1)
        chosen = {
            "by the worst parameter": int(worst.argmin()),
            "by volume": int(torch.logdet(known).argmax()),
        }
        document[count] = {
            name: {
                "designs": grid[sets[i]].tolist(),
                "sds": dict(zip(part.names, sds[i].tolist(), strict=True)),
            }
            for name, i in chosen.items()
        }
        best = torch.full((len(grid),), torch.inf, dtype=torch.float64)
        best = best.scatter_reduce(
            0, sets.flatten(), worst.repeat_interleave(count), "amin"
        ).unflatten(0, (len(LIMIT_WEBERS), -1))
        image = ax.pcolormesh(LIMIT_RESTS, LIMIT_WEBERS, 100.0 * best, shading="nearest")
        figure.colorbar(image, ax=ax)
        ax.set(
            title=f"{count} design{'s' if count > 1 else ''}: largest sd (%)",
            xlabel=REST_RADIUS,
            ylabel=WEBER,
        )
    finish(folder, "limit", document, figure)


def _line(
    ax: Axes,
    seeds: dict[int, list[Row]],
    value: Callable[[Row], float | None],
    color: str,
    label: str,
) -> list[Any]:
    """Median over seeds at each design with its quartiles; returns what was drawn."""
    longest = max(len(rows) for rows in seeds.values())
    found = []
    for n in range(longest):
        values = sorted(
            v for rows in seeds.values() if len(rows) > n and (v := value(rows[n])) is not None
        )
        if values:
            middle = statistics.median(values)
            low = values[len(values) // 4]
            high = values[-1 - len(values) // 4]
            found.append(
                {"design": n + 1, "seeds": len(values), "low": low, "median": middle, "high": high}
            )
    if found:
        numbers = [row["design"] for row in found]
        ax.fill_between(
            numbers,
            [r["low"] for r in found],
            [r["high"] for r in found],
            color=color,
            alpha=0.2,
            lw=0,
        )
        ax.plot(numbers, [r["median"] for r in found], ".-", color=color, label=label)
    return found


def sequence(folder: Path, mode: str = "exact") -> None:
    """Gain, model probability and relative error over designs, both cases, optimal and random."""
    wanted: dict[str, Callable[[Row], float | None]] = {
        "expected gain (nats)": lambda row: row.gain,
        "P(right model)": lambda row: row.probability,
        "largest rel. error": lambda row: max(row.errors),
        "largest rel. sd": lambda row: max(row.sds),
    }
    figure, axes = plt.subplots(len(CASES), len(wanted), figsize=(15, 8), layout="constrained")
    document: dict[str, Any] = {}
    for row, case in zip(axes, CASES.values(), strict=True):
        for policy in POLICIES:
            seeds = read(folder, case, policy, mode)
            for ax, (name, value) in zip(row, wanted.items(), strict=True):
                if seeds:
                    drawn = _line(ax, seeds, value, COLORS[policy], f"{policy}, {len(seeds)} seeds")
                    document[f"{case.key} | {policy} | {name}"] = drawn
                ax.set(xlabel="designs", ylabel=name)
                ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        row[0].set_title(TITLES[case.key], loc="left")
        row[1].set_ylim(-0.05, 1.05)
        for ax in row[2:]:
            ax.set_yscale("log")
            ax.yaxis.set_minor_formatter(NullFormatter())
            ax.axhline(WITHIN, color="0.5", ls=":")
    legend_above(figure, axes[0, 1])
    finish(folder, "sequence" if mode == "exact" else f"sequence_{mode}", document, figure)


def trajectory(folder: Path, mode: str = "exact") -> None:
    """Designs in the order in which they were shot, and the entropy of the belief."""
    figure, axes = plt.subplots(len(CASES), 2, figsize=(10, 7), layout="constrained")
    document: dict[str, Any] = {}
    for row, case in zip(axes, CASES.values(), strict=True):
        for policy in POLICIES:
            seeds = read(folder, case, policy, mode)
            if not seeds:
                continue
            if policy == "optimal":
                for rows in seeds.values():
                    row[0].plot(
                        *zip(*(r.design for r in rows), strict=True), "-", color="0.8", lw=0.7
                    )
                for n in range(max(map(len, seeds.values()))):
                    shot = [rows[n].design for rows in seeds.values() if len(rows) > n]
                    row[0].plot(
                        *zip(*shot, strict=True), "o", ms=4, color=f"C{n}", label=f"design {n + 1}"
                    )
            document[f"{case.key} | {policy} | designs"] = {
                s: [r.design for r in rows] for s, rows in seeds.items()
            }
            drawn = _line(row[1], seeds, lambda r: r.entropy, COLORS[policy], policy)
            document[f"{case.key} | {policy} | entropy"] = drawn
        row[0].set(xlabel=WEBER, ylabel=REST_RADIUS, xlim=(80, 1020), ylim=(0.135, 0.305))
        row[0].set_title(f"{TITLES[case.key]}: optimal designs", loc="left")
        row[1].set(xlabel="designs", ylabel="entropy of the belief (nats, SI)")
        row[1].xaxis.set_major_locator(MaxNLocator(integer=True))
        for ax in row:
            if ax.get_legend_handles_labels()[0]:
                ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    finish(folder, "trajectory" if mode == "exact" else f"trajectory_{mode}", document, figure)
