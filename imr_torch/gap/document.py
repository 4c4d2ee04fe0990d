"""A diagnosis as JSON-ready values, and these in words: the verdict, then the questions in order.

Text, figures and page are made of this document alone, so a saved result says and shows the same
again. The text is a template, as those of all results are. It is a list of sections, each a heading
with sentences; the page shows the same list.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from statistics import median
from typing import Any

import torch

from imr_torch.assimilate import ModelFit
from imr_torch.assimilate.dense import dense_curve
from imr_torch.design import NextDesign
from imr_torch.files import Document, drawn_numbers
from imr_torch.float64 import zeros
from imr_torch.gap.attribute import Attribution
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.examine import Parts
from imr_torch.gap.hypotheses import EXPLAINS, GEL_SCATTER, Hypothesis, gels_of, in_words
from imr_torch.gap.shrinkage import Shrinkage
from imr_torch.gap.verdict import MEMBER, NONE, OTHER, SLOW_NOISE, Choice
from imr_torch.goodness.phases import PHASES, phase_numbers
from imr_torch.goodness.score import ADEQUATE
from imr_torch.html import render
from imr_torch.labels import p_value
from imr_torch.material import LIBRARY, PARAMETERS, Intervals, intervals
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import Simulator
from imr_torch.unknown import CommonUnknown, Unknown

_ENTRIES = {
    GEL_SCATTER: "the gel differs between shots",
    NONE: "nothing is missing",
    OTHER: "an effect that the library does not hold",
    SLOW_NOISE: "slow noise of the camera",
    "material": "a stress of the gel, one function of stretch and strain rate in all shots",
    "contents": "a pressure of the contents, one function of radius and velocity in all shots",
    "drive": "a pressure of its own in each shot",
    "sample": "the sample around the bubble: an echo of its flux, or a resistance to it",
    "camera": "an error of the camera, of radius or time",
}

_NOTHING = ("Not ", "No cause is added", "At worst")
"""Begin sections that hold nothing, or a bound alone."""


def to_json(
    report: GapReport, parts: Parts | None = None, *, simulator: Simulator | None = None
) -> Document:
    """The document of a diagnosis; null for every part that was not run.

    Args:
        report: the diagnosis.
        parts: what was run beside the verdict.
        simulator: makes the bubbles of densely drawn curves; without it they are drawn at the
            frames.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.gap import diagnose, to_json
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> laboratory = SimulatedLaboratory(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> report = diagnose([shot], effects=library(["sound_speed"]), simulator=PolytropicSimulator())
    >>> to_json(report)["verdict"]
    'none'
    """
    parts = parts or Parts()
    base = report.base
    test = report.gap
    # the base model and what leads each step of the selection
    leading = {"none": report.null} | {
        step.winner.name: step.winner_fit for step in report.steps
    }
    document = {
        "gap": report.found,
        "verdict": report.verdict,
        "cause": list(report.cause),
        "reason": report.reason,
        "members": _read(report.choice, attrgetter("members")),
        "members_held": _read(report.choice, partial(_members_held, report)),
        "expected_loss": _read(report.choice, attrgetter("loss")),
        "converged": report.converged,
        "null_usable": report.null.certificate.usable,
        "model": {
            "key": base.model,
            "title": base.material.title,
            "known": dict(base.known),
        },
        "p_gap": test.p_value,
        "test_rejects": test.found,
        "bias_sigma": test.bias_sigma,
        "bias_R": test.bias_radius,
        "tests": [
            vars(b) | {"power": None if math.isnan(b.power) else b.power}
            for b in test.blocks
        ],
        **{name: _read(report.attribution, read) for name, read in _CAUSES.items()},
        "selected": list(report.selected.parts),
        "adequacy_p": report.adequacy_p,
        **_values(report, parts),
        "hidden": list(map(vars, parts.hidden)),
        "onset": _read(parts.onset, lambda when: vars(when) | {"sentence": str(when)}),
        "shrinkage": _read(parts.shrinkage, partial(_shrinkage, report=report)),
        "next_design": _read(parts.next_design, _design),
        "missing": _read(parts.unknown, _missing),
        "examined": parts.onset is not None,
        "phase_residual": {
            "phases": PHASES,
            "rows": _phase_residual(report.null, report.batch),
        },
        "curves": _curves(report, simulator),
        **_noise(report),
        "certificates": {
            name: vars(fit.certificate) | {"text": str(fit.certificate)}
            for name, fit in leading.items()
        },
        "seconds": report.seconds,
    }
    return document | {
        "headline": _fill_template("diagnosis_headline.txt", document),
        "next_step": " ".join(
            _fill_template("diagnosis_next_step.txt", document).splitlines()
        ),
    }


def _read(part: object, read: Callable[[Any], object]) -> object:
    """What is read from a part of a diagnosis; None where it was not run."""
    return None if part is None else read(part)


def _members_held(report: GapReport, choice: Choice) -> tuple[str, ...]:
    """The parts beside which the members of a choice have their probabilities."""
    return next(
        step.held.parts
        for step in (report.attribution, *report.steps)
        if step and choice.members.items() <= step.posterior.items()
    )


def _read_unknown(found: Attribution) -> Document:
    """The probability that an unknown effect looks like a known one."""
    like = found.likeness
    return {
        "size_sd": like.size,
        "chance_look_alike": like.chance,
        "standard_error": like.error,
        "bayes_factor": like.bayes_factor(found.adequacy.p_value),
    }


_CAUSES: Mapping[str, Callable[[Attribution], object]] = {
    "held": attrgetter("held.parts"),
    "leading": attrgetter("winner.name"),
    "posterior": attrgetter("posterior"),
    "explained_nats": attrgetter("explained"),
    "unconverged": attrgetter("unconverged"),
    "given_up": attrgetter("given_up"),
    "unknown": _read_unknown,
    "evidence_checks": lambda found: {
        name: vars(own) for name, own in found.checked.items()
    },
    "credible_set": lambda found: list(found.credible_set()),
    "leading_adequacy_p": attrgetter("adequacy.p_value"),
}  # probabilities and evidence of all causes


def _values(report: GapReport, parts: Parts) -> Document:
    """The parameters of the gel and of the named cause, with 90 % intervals."""
    within = report.within_misfit
    named = report.selected_fit if report.verdict in ("effect", "class") else None
    fit, batch = report.quoted
    base = intervals((within.own[0] if within else report.null).posterior)
    quoted = intervals(fit.posterior)
    shift = None
    if named or (within and report.selected.parts):
        beside = intervals(report.selected_fit.posterior)
        shift = {n: {"base": own, "with_cause": beside[n]} for n, own in base.items()}
    return {
        "parameters": {name: quoted[name] for name in base},
        "widened": within is not None,
        "quoted_noise": str(batch.noise),
        "parameters_with_model_error": _read(parts.model_error, attrgetter("intervals")),
        "parameter_bound_sd": _read(parts.model_error, attrgetter("bound")),
        "parameter_shift": shift,
        "cause_values": _read(named, partial(_cause_values, report)),
        "gels": gels_of(report.selected_fit, report.selected) or None,
    }


def _cause_values(report: GapReport, named: ModelFit) -> dict[str, Intervals]:
    """Named effect -> its parameters; members of a class that the leading fit does not hold have the
    values of their own fits.
    """
    fits = [named, *(report.attribution.fits.values() if report.attribution else ())]
    values = {}
    for part in report.cause:
        names = LIBRARY[part].names if part in LIBRARY else ()
        holding = [fit for fit in fits if set(names) <= set(fit.prior.names)]
        if names and holding:
            every = intervals(holding[0].posterior)
            values[part] = {name: every[name] for name in names}
    return values


def _shrinkage(found: Shrinkage, report: GapReport) -> Document:
    shares = found.placebo
    return vars(found) | {
        "placebo_median": median(shares) if shares else None,
        "placebo_95": found.placebo_high if shares else None,
        "placebos": len(shares),
        "word": found.word(report.adequacy_p or 0.0),
    }


def _missing(found: Unknown) -> Document:
    """Kinds and terms with their probabilities, and the missing pressure of each shot: us, kPa, 1/s."""
    units = {
        "t_us": ("times", 1e6),
        "stretch": ("stretch", 1.0),
        "rate": ("rate", 1.0),
        "kPa": ("pressure", 1e-3),
        "sd_kPa": ("sd", 1e-3),
        "own_kPa": ("own_stress", 1e-3),
    }
    return {
        "kind": found.kind,
        "kinds": found.probabilities,
        "explained_nats": found.explained,
        "terms": found.terms,
        "shots": [
            {"id": shot.label}
            | {
                label: drawn_numbers(scale * getattr(shot, name)[::4])
                for label, (name, scale) in units.items()
            }
            for shot in found.shots
        ],
    }


def laboratory_document(media: Mapping[str, str], found: CommonUnknown) -> Document:
    """JSON-ready values of what several gels miss.

    Args:
        media: gel -> what is known of its medium, in words.
        found: of :func:`imr_torch.gap.compare_gels`.

    >>> from imr_torch.gap.document import laboratory_document
    >>> from imr_torch.unknown import CommonUnknown
    >>> names = ("nothing", "shots", "own", "law", "one", "both")
    >>> found = CommonUnknown(dict.fromkeys(names, 0.0) | {"nothing": 1.0}, ())
    >>> laboratory_document({"a": "", "b": ""}, found)["verdict"]
    'none'
    """
    return {
        "gels": list(media),
        "media": dict(media),
        "verdict": found.verdict,
        "probabilities": found.probabilities,
        "causes": list(map(vars, found.causes)),
    }


def _phase_residual(fit: ModelFit, batch: ExperimentBatch) -> list[list[float | None]]:
    """Root mean square residual of the mean curves by experiment and phase, over its noise; null
    where a phase has no frames.
    """
    phase = phase_numbers(batch.times, fit.prediction, batch.mask)
    noise = batch.of_frames.sd(fit.prediction) / batch.counts.sqrt()
    square = torch.where(batch.mask, ((batch.mean - fit.prediction) / noise).square(), 0.0)
    none = zeros(len(square), len(PHASES))
    total, frames = (none.scatter_add(1, phase, x) for x in (square, batch.mask.double()))
    return [drawn_numbers(row) for row in (total / frames).sqrt()]


def _curves(report: GapReport, simulator: Simulator | None) -> list[Document]:
    """Mean measured curves, the base model and, where anything was selected, the model with it.

    With a simulator, ``drawn`` holds the curves of the models at 600 points.
    """
    batch = report.batch
    fits = {"base": (Hypothesis(report.base), report.trained.null)}
    if report.selected.parts:
        fits["selected"] = (report.selected, report.selected_fit)
    dense = {
        name: dense_curve(fit, hypothesis.seen(batch), simulator)
        for name, (hypothesis, fit) in fits.items()
        if simulator is not None
    }
    outer = simulator.conditions.surroundings if simulator else None
    noise = batch.of_frames.sd(report.null.prediction) / batch.counts.sqrt()
    rows = []
    for e, experiment in enumerate(batch.experiments):
        seen = batch.mask[e]
        size = outer and outer.max_radius(experiment.design[0])
        rows.append(
            {
                "id": experiment.label,
                "We": experiment.design[0],
                "R_inf*": experiment.design[1],
                "Rmax_m": size,
                "time_scale_s": outer and size and outer.time_scale(size),
                "t_star": batch.times[e][seen].tolist(),
                "R_star": batch.mean[e][seen].tolist(),
                "sd": noise[e][seen].tolist(),
                "selected": None,
                **{
                    name: fit.prediction[e][seen].tolist()
                    for name, (_, fit) in fits.items()
                },
                "drawn": {
                    name: {"t_star": drawn_numbers(t[e]), "R_star": drawn_numbers(r[e])}
                    for name, (t, r) in dense.items()
                },
            }
        )
    return rows


def _noise(report: GapReport) -> Document:
    """The noise law, what is known of it, and what was left out."""
    batch = report.batch
    return {
        "noise": vars(batch.noise),
        "noise_text": str(batch.noise),
        "noise_inferred": batch.noise_laws is not None,
        "noise_interval": batch.noise_interval(report.null.prediction),
        "noise_factors": {e.label: e.noise_factor for e in batch.curves},
        "frames_left_out": dict(report.spoilt),
    }


def _design(found: NextDesign) -> Document:
    """The next design, its gain in nats, what it tells apart and how it is taken to be observed."""
    weber, rest = found.design.tolist()
    nuisance = found.plan.nuisance
    return {
        "We": weber,
        "R_inf*": rest,
        "gain": found.gain,
        "gain_sd": found.error,
        "entropy": found.entropy,
        "tells_apart": list(found.causes),
        "p_truth_now": found.now,
        "p_truth_after": found.after,
        "p_truth_after_sd": found.after_error,
        "helps": found.helps,
        "plan": {
            "repeats": found.plan.repeats,
            "frames": len(found.plan.times),
            "end_t": float(found.plan.times[-1]),
            "max_radius_sd": nuisance.max_radius,
            "time_zero_sd": nuisance.time_zero,
            "rest_radius_sd": nuisance.rest_radius,
        },
    }


@dataclass(frozen=True)
class Section:
    """A heading and its sentences.

    Args:
        heading: the question.
        sentences: the answer.
        folded: whether there is nothing to say, or only details, so that a page folds it away.
    """

    heading: str
    sentences: tuple[str, ...]
    folded: bool = False


def title(name: str) -> str:
    """A cause in plain words, its code name behind: of an effect, of several joined by ``+``, or
    another entry of the posterior.

    >>> from imr_torch.gap.document import title
    >>> title("clock"), title("other")
    ('frame rate or pixel size is off (clock)', 'an effect that the library does not hold')
    """
    return " and ".join(
        f"{LIBRARY[part].meaning} ({part})" if part in LIBRARY else _ENTRIES.get(part, part)
        for part in name.split("+")
    )


def list_names() -> Document:
    """What templates of a diagnosis may use beside the document: words for its numbers."""
    return {
        "parameters": PARAMETERS,
        "entries": _ENTRIES,
        "titles": lambda names: list(map(title, names)),
        "in_words": in_words,
        "effects": LIBRARY,
        "sections": sections,
        "p_value": p_value,
        "adequate": ADEQUATE,
        "explains": EXPLAINS,
        "member": MEMBER,
    }


def _fill_template(name: str, document: Document) -> str:
    return render(name, document=document, **list_names()).strip("\n")


def describe(document: Document) -> str:
    """The diagnosis as text.

    Args:
        document: of the diagnosis (:func:`imr_torch.gap.to_json`).

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.gap import describe, diagnose, to_json
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> laboratory = SimulatedLaboratory(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> report = diagnose([shot], effects=library(["sound_speed"]), simulator=PolytropicSimulator())
    >>> describe(to_json(report)).splitlines()[1].strip()
    'No gap was found: the base model describes these data within their noise.'
    """
    return _fill_template("diagnose.txt", document)


def sections(document: Document) -> list[Section]:
    """The diagnosis as sections, in the order of the questions."""
    folded = ["What the records show without a model", "The medium"]
    folded += ["Have the fits converged?"] * document["converged"]
    folded += ["What would these data not show?"] * document["gap"]
    found = []
    for block in describe(document).split("\n\n")[:-1]:
        heading, *sentences = map(str.strip, block.splitlines())
        nothing = sentences[0].startswith(_NOTHING)
        found += [Section(heading, tuple(sentences), nothing or heading in folded)]
    return found
