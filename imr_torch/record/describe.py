"""What records show before any gel is fitted: wall pressure in growth and collapse, chord,
skewness, what each cycle looks like, and shots that stand out from their set.

The probability that a shot stands out is that of a mixture over shots: a quantity of a shot (chord,
skewness, viscosity of its first cycle) is normal about a line over the logarithm of its maximum
radius; a shot that stands out has a much wider spread about the same line. Intercept, slope and
scatter are integrated over on a grid, so that nobody has to say which shots the line is fitted to.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from imr_torch.files import Document, read_table, without_nonfinite
from imr_torch.html import render
from imr_torch.observe import Experiment
from imr_torch.observe.landmarks import find_landmarks
from imr_torch.reading.traces import RadiusTrace
from imr_torch.record.cycles import Cycle, RecordOptions, describe_cycles
from imr_torch.units import Surroundings

WATER = read_table("record")["water"]
"""Medians of chord and skewness of shots in water (``data/record.toml``)."""

FEWEST = 3
"""Shots below which none can be told to stand out: two cannot outvote each other."""

SLOW = 1.01
"""Chord over that of a lossless bubble, which dissipation hardly changes, from which on a cycle is slow."""

EVEN_ODDS = 0.5
"""Probability from which on a shot stands out: more probable than not."""


@dataclass(frozen=True, eq=False)
class ShotRecord:
    """What one record shows.

    Args:
        label: name of the shot.
        cycles: that have frames enough; the first is that of the largest radius.
        odd: probability that the shot stands out from its set; None where fewer than three shots
            are compared.
        odd_in: quantities in which it does, of "chord", "skewness" and "viscosity".
        weight: how often its likelihood counts in fits.

    >>> from imr_torch.record import ShotRecord
    >>> ShotRecord("shot 1", (), 0.02).odd_in
    ()
    """

    label: str
    cycles: tuple[Cycle, ...]
    odd: float | None = None
    odd_in: tuple[str, ...] = ()
    weight: float = 1.0

    @property
    def stands_out(self) -> bool:
        """Whether it is more probable than not that it does."""
        return self.odd is not None and self.odd > EVEN_ODDS


@dataclass(frozen=True, eq=False)
class Record:
    """What the records of a set show.

    Args:
        shots: in the order of the traces.

    >>> from imr_torch.record import Record, ShotRecord
    >>> Record((ShotRecord("shot 1", ()),)).sentences()
    ('No shot has frames enough about its maximum to show a wall pressure.',)
    """

    shots: tuple[ShotRecord, ...]

    def weighted(self, experiments: Iterable[Experiment]) -> tuple[Experiment, ...]:
        """The shots as a fit takes them.

        One that stands out counts next to nothing (``RecordOptions.odd_weight``): in a mixture of
        good and odd shots the others say what the gel is.
        """
        weights = {shot.label: shot.weight for shot in self.shots}
        return tuple(replace(e, weight=weights.get(e.label, 1.0)) for e in experiments)

    def first(self, name: str) -> np.ndarray:
        """A number of the first cycle of every shot; NaN where a shot has none."""
        firsts = [[c for c in shot.cycles if c.number == 1] for shot in self.shots]
        return np.array([getattr(c[0], name) if c else np.nan for c in firsts], dtype=float)

    @property
    def described(self) -> int:
        """How many shots have frames enough about their maximum."""
        return int(np.isfinite(self.first("max_radius_m")).sum())

    def sentences(self) -> tuple[str, ...]:
        """What is seen, in words."""
        chord, skewness = (
            x[np.isfinite(x)] for x in map(self.first, ("chord", "skewness"))
        )
        text = render(
            "record.txt",
            record=self,
            chord=chord,
            skewness=skewness,
            cycles=[cycle for shot in self.shots for cycle in shot.cycles],
            median=np.median,
            water=WATER,
            slow=SLOW,
            fewest=FEWEST,
        )
        return tuple(text.splitlines())

    def to_dict(self) -> Document | None:
        """JSON-ready, SI; pressures over p_inf, and null where a number is not known; None without
        shots.
        """
        if not self.shots:
            return None
        shots = [
            {
                "id": shot.label,
                "odd": shot.odd,
                "odd_in": list(shot.odd_in),
                "stands_out": shot.stands_out,
                "weight": shot.weight,
                "cycles": [cycle.to_dict() for cycle in shot.cycles],
            }
            for shot in self.shots
        ]
        document = {"shots": shots, "water": WATER, "sentences": list(self.sentences())}
        return without_nonfinite(document)[0]


def describe_record(
    traces: Iterable[RadiusTrace],
    surroundings: Surroundings = Surroundings(),
    *,
    options: RecordOptions = RecordOptions(),
) -> Record:
    """What records show without a model of the gel.

    Args:
        traces: of one gel, with their growth where it was recorded.
        surroundings: the liquid side; a wrong density or pressure looks like a modulus.
        options: how they are read.

    >>> import numpy as np
    >>> import torch
    >>> from imr_torch.observe import RadiusTrace, TraceSet
    >>> from imr_torch.record import describe_record
    >>> time = np.linspace(-24e-6, 24e-6, 97)
    >>> trace = RadiusTrace("shot 1", torch.tensor(time), torch.tensor(2e-4 * np.cos(6e4 * time) ** 0.4), "example")
    >>> record = describe_record(TraceSet((trace,)))
    >>> record.shots[0].cycles[0].frames, record.sentences()[-1]
    (95, 'Two shots cannot outvote each other, so of fewer than three none stands out.')
    """
    shots = [
        ShotRecord(
            trace.experiment_id,
            describe_cycles(trace, find_landmarks(trace), surroundings, options),
        )
        for trace in traces
    ]
    return Record(tuple(_with_odd(shots, options)))


def _with_odd(shots: list[ShotRecord], options: RecordOptions) -> list[ShotRecord]:
    """The shots with their probabilities of standing out."""
    record = Record(tuple(shots))
    sizes = record.first("max_radius_m")
    if np.isfinite(sizes).sum() < FEWEST:
        return shots
    chances = {}
    for name, scatter in zip(
        ("chord", "skewness", "viscosity"), options.scatter, strict=True
    ):
        values = record.first(name)
        if name == "viscosity":
            scatter *= float(np.nanmedian(np.abs(values)))
            # the collapse says little of it
            values[np.isnan(record.first("skewness"))] = np.nan
        chances[name] = odd_probabilities(
            values, record.first(f"{name}_sd"), sizes, options, scatter=scatter
        )
    whole = 1.0 - np.prod([1.0 - values for values in chances.values()], axis=0)
    return [
        replace(
            shot,
            odd=float(odd),
            odd_in=tuple(name for name, p in chances.items() if p[i] > 0.5 * EVEN_ODDS),
            weight=options.odd_weight if odd > EVEN_ODDS else 1.0,
        )
        for i, (shot, odd) in enumerate(zip(shots, whole, strict=True))
    ]


def odd_probabilities(
    values: np.ndarray,
    sds: np.ndarray,
    sizes: np.ndarray,
    options: RecordOptions,
    *,
    scatter: float,
    relative_slope: float = 5.0,
) -> np.ndarray:
    """Probability that each shot stands out in a quantity; 0 where it is not known or fewer than
    three shots have it.

    Args:
        values: a shot; NaN where it is not known.
        sds: their standard deviations.
        sizes: maximum radius of each shot.
        options: prior probability and width of shots that stand out.
        scatter: of good shots, that a prior takes for likely.
        relative_slope: change with the logarithm of the maximum radius, over ``scatter``, that a
            prior takes for likely.

    >>> import numpy as np
    >>> from imr_torch.record import RecordOptions
    >>> from imr_torch.record.describe import odd_probabilities
    >>> chords = np.array([1.00, 1.01, 0.99, 1.00, 1.10, 1.01])
    >>> sds = np.full(6, 0.003)
    >>> odd_probabilities(chords, sds, np.ones(6), RecordOptions(), scatter=0.01) > 0.5
    array([False, False, False, False,  True, False])
    """
    found = np.zeros(len(values))
    known = np.isfinite(values + sds)
    if known.sum() < FEWEST:
        return found
    x = values[known]
    before = np.where(
        sds[known] > 2.0 * np.median(sds[known]), options.odd_noisy, options.odd
    )
    size = np.log(sizes[known] / np.median(sizes[known]))
    reach = 3.0 * np.hypot(scatter, 1.5 * np.median(abs(x - np.median(x))))
    centre, change, spread = np.meshgrid(
        np.median(x) + reach * np.linspace(-1.0, 1.0, 41),
        scatter * relative_slope * np.linspace(-2.5, 2.5, 11),
        scatter * 2.0 ** np.linspace(-2.0, 4.0, 13),
        indexing="ij",
    )
    prior = -0.5 * (change / (scatter * relative_slope)) ** 2
    prior -= 0.5 * np.log2(spread / scatter) ** 2  # a factor of 2 either way
    variance = spread[..., None] ** 2 + sds[known] ** 2
    apart = (x - centre[..., None] - change[..., None] * size) ** 2 / variance
    good = np.exp(-0.5 * apart) * (1.0 - before)
    odd = np.exp(-0.5 * apart / options.wide**2) * before / options.wide
    weight = prior + (np.log(good + odd + 1e-300) - 0.5 * np.log(variance)).sum(-1)
    weight = np.exp(weight - weight.max())
    share = odd / (good + odd + 1e-300)
    found[known] = (weight[..., None] * share).sum((0, 1, 2)) / weight.sum()
    return found
