"""The page of a characterisation, drawn from its document alone: the gel, what was assumed,
figures, then details.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import matplotlib.pyplot as plt

from imr_torch.assimilate import BadFrame
from imr_torch.html import Block, Picture, Preformatted, Table, page
from imr_torch.labels import model_probability
from imr_torch.material import PARAMETERS, material
from imr_torch.observe import Noise, noise_sentences
from imr_torch.results.collapse import collapse_rows
from imr_torch.results.figures import draw_figures
from imr_torch.results.named import NamedFigure
from imr_torch.results.population import population_block
from imr_torch.results.profile import profile_block
from imr_torch.select import Bound

_FIGURES = 12  # shown at once; the others are folded away
_IMPROBABLE = 0.001
_ALONE = 1e299  # agreement that stands for infinity, which JSON has not


def characterization_page(document: Mapping[str, Any], *, title: str = "", report: str = "") -> str:
    """The page as HTML.

    Args:
        document: of ``characterize``, with its header.
        title: of the page; the names of the files when not given.
        report: the printed report, folded away at the end.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, characterize, wide_prior
    >>> from imr_torch.assimilate import SearchOptions
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import RadiusTrace, TraceSet
    >>> from imr_torch.results import characterization_document, characterization_page, header
    >>> from imr_torch.units import Surroundings
    >>> simulator, size, times = PolytropicSimulator(), 221e-6, torch.linspace(0.0, 2.2, 23, dtype=torch.float64)
    >>> bubble = simulator(PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), torch.tensor([200.0, 0.2]).double(), times)
    >>> traces = TraceSet((RadiusTrace("a", times * Surroundings().time_scale(size), size * bubble.radius, "example"),))
    >>> options = SearchOptions(raw_samples=16, starts=2)
    >>> prior = wide_prior(["nhkv"])
    >>> result = characterize(traces, prior=prior, simulator=simulator, rest_radius=(0.2, 0.002), options=options)
    >>> document = header("characterize") | characterization_document(result, traces, simulator, draws=5)
    >>> "<title>Gel 7</title>" in characterization_page(document, title="Gel 7")
    True
    """
    best = max(document["model_probabilities"], key=document["model_probabilities"].__getitem__)
    names = ", ".join(
        entry["name"] for entry in document.get("files", ()) if not entry["name"].endswith(".json")
    )
    tested = document["fit_test"]
    data = "curves" if document["curves"] else "collapse times"
    sentence = (
        tested["sentence"]
        if tested
        else f"It was not tested whether the model explains the {data}."
    )
    warning = tested is None or not tested["explained"]
    blocks = [
        Block("The gel", (gel_table(document, best),)),
        Block("What was assumed", (_assumed(document, best),)),
    ]
    if document.get("population"):
        blocks.append(
            Block(
                "Does the gel differ from shot to shot?", population_block(document["population"])
            )
        )
    if document.get("profiles"):
        blocks.append(Block("Do the data bound each parameter?", profile_block(document)))
    pictures, failed = pictures_of(draw_figures(document))
    blocks.append(Block("Figures", (*pictures[:_FIGURES], *failed)))
    if pictures[_FIGURES:]:
        blocks.append(
            Block(
                f"{len(pictures) - _FIGURES} more figures", tuple(pictures[_FIGURES:]), folded=True
            )
        )
    if document["curves"]:
        blocks.append(
            Block(
                "Frames that were fitted, and why others were not",
                frame_lines(document),
                folded=True,
            )
        )
    if len(document["models"]) > 1:
        blocks.append(Block("All models", (_models(document),), folded=True))
    blocks.append(Block("Have the fits converged?", _certificates(document), folded=True))
    if document.get("rows_left_out") or document.get("notes"):
        rows = [
            f"{x['file']} [{x['experiment'] or '-'}] row(s) {x['rows'] or '-'}: {x['reason']}"
            for x in document["rows_left_out"]
        ]
        blocks.append(
            Block(
                "Rows that were left out of the files",
                (*rows, *document.get("notes", ())),
                folded=True,
            )
        )
    blocks.append(Block("Files, medium and software", (provenance_table(document),), folded=True))
    if report:
        blocks.append(Block("The report as text", (Preformatted(report),), folded=True))
    text = page(
        title or f"Gel in {names or 'the given curves'}",
        [sentence, *(f"Caution: {text}" for text in document.get("cautions", ()))],
        blocks,
        warning=warning,
        next_step=_next_step(document),
        footer=footer(document),
    )
    for picture in pictures:
        plt.close(picture.figure)
    return text


def pictures_of(figures: Iterable[NamedFigure]) -> tuple[list[Picture], list[str]]:
    """Figures as pictures of a page, and a sentence for each that could not be drawn."""
    pictures = []
    failed = []
    for figure in figures:
        try:
            pictures.append(Picture(figure.caption, figure.alt, figure.draw()))
        except Exception as error:  # a figure that fails costs the page nothing else
            failed.append(_not_drawn(figure, error))
    return pictures, failed


def _not_drawn(figure: NamedFigure, error: Exception) -> str:
    return (
        f"The figure {figure.name} could not be drawn ({type(error).__name__}: {error}); its "
        "numbers are in the JSON."
    )


def gel_table(document: Mapping[str, Any], best: str) -> Table:
    """Model, its probability, and every parameter with its 90 % interval."""
    rows = [
        (
            "Model",
            f"{material(best).title}, {_probability(document, best)} among "
            f"{len(document['models'])} candidate(s)",
        )
    ]
    for name, (low, middle, high) in document["models"][best]["intervals"].items():
        words = document["models"][best].get("identifiability", {}).get(name, Bound.BOTH.value)
        said = "" if words == Bound.BOTH.value else f"; {words}"
        rows.append(
            (
                f"{name}, {PARAMETERS[name].meaning}",
                PARAMETERS[name].interval(low, middle, high) + said,
            )
        )
    unit = "R*" if document["curves"] else "t*"
    rows.append(
        ("Residual", f"{document['models'][best]['rmse']:.4f} in {unit} (root mean square)")
    )
    return Table(tuple(rows))


def _assumed(document: Mapping[str, Any], best: str) -> Table:
    fitted = sum(c["frames"]["fitted"] for c in document["curves"])
    recorded = sum(c["frames"]["recorded"] for c in document["curves"])
    rows = collapse_rows(document)
    if document["curves"]:
        rows += [
            (
                "Curves",
                f"{len(document['curves'])}, taken to be of one gel: {fitted} of {recorded} "
                "frames were fitted",
            ),
            ("Rmax, time zero, R_inf", "measured from each curve, and uncertain in the fit"),
        ]
    if blurred := [e for e in document["experiments"] if e.get("exposure_t_star")]:
        longest = max(e["exposure_t_star"] for e in blurred)
        rows.append(
            (
                "Exposure",
                f"as stated for {len(blurred)} curve(s): radii are averaged over up to t* = "
                f"{longest:.3g}",
            )
        )
    return Table((*rows, *setting_rows(document, best)))


def setting_rows(document: Mapping[str, Any], best: str) -> list[tuple[str, str]]:
    """What every fit assumes: bubble, noise, what is known of the model ``best``, medium, software."""
    rows = [
        (
            "Bubble",
            _PHYSICS.get(document.get("physics", ""), "as the simulator that was given makes it"),
        )
    ]
    if document.get("curves") or not document.get("collapse_times"):
        rows += [("Noise", str(Noise(**document["noise"]))), *_noise_rows(document)]
    known = next(
        (part.get("known") for part in document["belief"]["models"] if part.get("model") == best),
        None,
    )
    if known:
        rows.append(
            (
                "Known before",
                ", ".join(
                    f"{name} = {value:g} {PARAMETERS[name].unit}" for name, value in known.items()
                ),
            )
        )
    if "medium" in document:
        rows.append(("Medium", _medium(document)))
    rows += assumed_rows(document)
    if "software" in document:
        rows.append(("Made by", footer(document)))
    return rows


def _noise_rows(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How large the inferred noise is, curves with one of their own, frames that look bad, and
    whether their times jitter.
    """
    rows = [
        ("Noise of a frame", x)
        for x in noise_sentences(Noise(**document["noise"]), document.get("noise_interval"))
    ]
    for label, factor in document.get("noise_factors", {}).items():
        rows.append(("A noise of its own", f"{label}: {factor:.2f} times that of the other curves"))
    bad: Mapping[str, Any] = document.get("bad_frames") or {"frames": ()}
    for title, frames in (
        ("Frame that looks bad", bad["frames"]),
        ("Left out as bad", document.get("frames_left_out", ())),
    ):
        rows += [(title, str(BadFrame(**frame))) for frame in frames]
    if bad["frames"] and bad["intervals_without"]:
        values = "; ".join(
            f"{name} {PARAMETERS[name].interval(*x)}"
            for name, x in bad["intervals_without"].items()
        )
        rows.append(("Without those that stand alone", f"{values} (to first order)"))
    if jitter := document.get("frame_jitter"):
        rows.append(("Frame times", jitter["sentence"]))
    return rows


_PHYSICS = {
    "transport": "Keller-Miksis, with heat conduction and vapour transport",
    "polytropic": "Keller-Miksis, polytropic gas: no heat and vapour transport, so G and mu are biased on "
    "real gels",
}


def _medium(document: Mapping[str, Any]) -> str:
    parts = []
    for name, entry in document["medium"].items():
        spread = f" ± {entry['sd']:.2g}" if entry.get("sd") else ""
        value = f"{entry['value']:.5g}{spread} {entry['unit']}"
        parts.append(f"{name.replace('_', ' ')} {value} ({entry.get('source', 'assumed')})")
    return "; ".join([*parts, *document.get("medium_notes", ())])


def assumed_rows(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What assumed values of the medium would change in the parameters, a row each."""
    return [
        ("Were the medium another", x["sentence"]) for x in document.get("medium_sensitivities", ())
    ]


def frame_lines(document: Mapping[str, Any]) -> tuple[str, ...]:
    """For each curve how many frames were fitted, and every stretch that was not, with the reason."""
    lines = []
    for curve in document["curves"]:
        use = curve["frames"]
        why = "; ".join(
            f"{x['first']} to {x['last']} ({1e6 * x['start_s']:.4g} to {1e6 * x['end_s']:.4g} "
            f"µs): {x['reason']}"
            for x in use["not_fitted"]
        )
        lines.append(
            f"{curve['id']}: {use['fitted']} of {use['recorded']} frames fitted"
            + (f". Not fitted: {why}." if why else ".")
        )
    return tuple(lines)


def _probability(document: Mapping[str, Any], key: str) -> str:
    """The probability of a model with the error of its computation."""
    return model_probability(
        document["model_probabilities"][key], document["model_probability_errors"][key]
    )


def _models(document: Mapping[str, Any]) -> Table:
    order = sorted(document["models"], key=lambda key: -document["model_probabilities"][key])
    rows = []
    for key in order:
        entry = document["models"][key]
        probability = document["model_probabilities"][key]
        shown = _probability(document, key) if probability >= _IMPROBABLE else f"< {_IMPROBABLE:g}"
        values = "; ".join(
            f"{name} {PARAMETERS[name].interval(*triple)}"
            for name, triple in entry["intervals"].items()
        )
        rows.append((material(key).title, shown, f"{entry['rmse']:.4f}", values))
    return Table(
        tuple(rows),
        (
            "model",
            "probability",
            f"residual ({'R*' if document['curves'] else 't*'})",
            "parameters",
        ),
    )


def _certificates(document: Mapping[str, Any]) -> tuple[str, ...]:
    lines = []
    for key, entry in document["models"].items():
        found = entry["certificate"]
        word = "converged" if found["converged"] else "NOT CONVERGED"
        alone = found["agreement"] >= _ALONE
        of = found.get("compared", "starts")
        agree = (
            f"one of the {of} alone ended well"
            if alone
            else f"{of} agree within {found['agreement']:.2g} nats"
        )
        lines.append(
            f"{material(key).title}: {word} (gradient {found['gradient']:.1e} sd, {agree}, "
            f"{found['iterations']} iterations). "
            f"{entry['draws']}"
        )
    return tuple(lines)


def provenance_table(document: Mapping[str, Any]) -> Table:
    """Files with their hashes, medium, software, date and command."""
    rows = [
        (entry["name"], f"{entry['bytes']} bytes, SHA-256 {entry['sha256']}")
        for entry in document.get("files", ())
    ]
    if "medium" in document:
        rows.append(("Medium", _medium(document)))
    if "software" in document:
        rows.append(
            (
                "Software",
                ", ".join(f"{name} {number}" for name, number in document["software"].items()),
            )
        )
        rows.append(("Date", document["created"]))
    if document.get("command"):
        rows.append(("Command", document["command"]))
    return Table(tuple(rows))


def footer(document: Mapping[str, Any]) -> str:
    """Software, version, date and files in one line."""
    if "software" not in document:
        return ""
    names = ", ".join(entry["name"] for entry in document.get("files", ()))
    return f"imr_torch {document['software']['imr_torch']}, {document['created']}" + (
        f", from {names}" if names else ""
    )


def _next_step(document: Mapping[str, Any]) -> str:
    tested = document["fit_test"]
    if tested and tested["explained"] is False:
        return f"Find out what the model lacks before its numbers are quoted: {tested['command']}"
    loose = [
        key for key, entry in document["models"].items() if not entry["certificate"]["converged"]
    ]
    best = max(document["model_probabilities"], key=document["model_probabilities"].__getitem__)
    if best in loose:
        return (
            f"The fit of {material(best).title} did not converge: run it again with another "
            "--seed, or with fewer models."
        )
    if document["model_probabilities"][best] < 0.95 and len(document["models"]) > 1:
        again = "imr-torch design --belief RESULT.json --target model"
        return f"No model is sure yet: shoot the design that tells them apart best, {again}"
    return (
        "For narrower intervals shoot the design that is expected to tell most: imr-torch design "
        "--belief RESULT.json"
    )
