"""The page of a campaign, drawn from its document alone: what to shoot next, the gel so far,
figures, then details.
"""

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt

from imr_torch.html import Block, Table, page
from imr_torch.material import PARAMETERS, material
from imr_torch.results.campaign_figures import campaign_figures
from imr_torch.results.page import footer, pictures_of, provenance_table, setting_rows
from imr_torch.results.population import population_block

_SHOWN = 0.01  # probability below which a cause is not listed


def campaign_page(document: Mapping[str, Any], *, title: str = "") -> str:
    """The page of a campaign as HTML: what to shoot next, the gel so far, figures, then details.

    Args:
        document: of ``campaign``, with its header.
        title: of the page.

    >>> import tempfile
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.campaign import Campaign
    >>> from imr_torch.results import campaign_page, header
    >>> from imr_torch.results.campaign import campaign_document
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     document = campaign_document(Campaign(folder, reference_case("soft-pa").prior, PolytropicSimulator()))
    >>> "No experiment was told yet" in campaign_page(header("campaign") | document)
    True
    """
    pictures, failed = pictures_of(campaign_figures(document))
    blocks = [
        Block("The cause of the gap", (_causes(document),)) if document.get("findings") else None,
        Block(
            "The gel so far"
            if document.get("goal") != "population"
            else "The median of the gels so far",
            (_gel(document),),
        ),
        Block("Does the gel differ from shot to shot?", population_block(document["population"]))
        if document.get("population")
        else None,
        Block("Shoot next", (_designs(document["proposals"]),)) if document["proposals"] else None,
        Block("What was assumed", (Table(tuple(_assumed(document))),)),
        Block("Figures", (*pictures, *failed)),
        Block("Experiments that count", (_experiments(document),), folded=True)
        if document["experiments"]
        else None,
        Block("All models", (_models(document),), folded=True)
        if len(document["model_probabilities"]) > 1
        else None,
        Block("Files, medium and software", (provenance_table(document),), folded=True),
    ]
    text = page(
        title or "Campaign",
        [headline(document)],
        [block for block in blocks if block is not None],
        next_step=_next_step(document),
        footer=footer(document),
    )
    for picture in pictures:
        plt.close(picture.figure)
    return text


def headline(document: Mapping[str, Any]) -> str:
    """The state of a campaign in one sentence."""
    count = len(document["experiments"])
    best = _best(document)
    if not count:
        return "No experiment was told yet; what follows is what was believed before."
    if found := document.get("findings"):
        return f"After {count} experiment(s): {cause_sentence(found[-1])}"
    if found := document.get("population"):
        return f"After {count} shots: {found['sentence']} Median: {_values(document, best)}."
    lost = f" ({document['forgotten']} more were forgotten)" if document["forgotten"] else ""
    probability = document["model_probabilities"][best]
    said = (
        f"After {count} experiment(s){lost} {material(best).title} has a probability of "
        f"{probability:.3f}"
    )
    return f"{said}: {_values(document, best)}."


def _values(document: Mapping[str, Any], model: str) -> str:
    """Parameters of a model with their intervals."""
    return "; ".join(
        f"{n} {PARAMETERS[n].interval(*v)}" for n, v in document["intervals"][model].items()
    )


def cause_sentence(found: Mapping[str, Any]) -> str:
    """What a diagnosis says, in one sentence and its reason."""
    named = " or ".join(found["causes"])
    said = found["reason"]
    if not found["converged"]:
        return f"no verdict on the cause, since a fit did not converge. {said}"
    if found["verdict"] in ("effect", "class"):
        chance = sum(found["probabilities"].get(name, 0.0) for name in _hypotheses(found))
        return f"what the model lacks is {named}, with a probability of {chance:.2f}. {said}"
    if found["verdict"] == "other":
        return f"what the model lacks is an effect that is not in the library. {said}"
    return (
        f"{'no gap between model and data was found' if found['verdict'] == 'none' else 'no cause can be named yet'}. "
        f"{said}"
    )


def _hypotheses(found: Mapping[str, Any]) -> list[str]:
    """The hypotheses whose effects the verdict names: one after the other if selected together,
    else each alone.
    """
    names = found["causes"]
    together = "+".join(names)
    return [together] if together in found["probabilities"] else names


def _beside(found: Mapping[str, Any]) -> str:
    """With which effects the parameters of the base model were inferred, and whether they can be
    quoted.
    """
    if found["verdict"] == "none":
        return "alone, which explains the curves"
    if found["verdict"] == "effect":
        return f"with {' and '.join(found['causes'])}"
    return (
        "alone, which does not explain the curves: values below are biased by an unknown amount, "
        "do not quote them"
    )


def _causes(document: Mapping[str, Any]) -> Table:
    """The probabilities of the causes after each experiment."""
    rows = []
    for found in document["findings"]:
        ranked = sorted(found["probabilities"].items(), key=lambda item: -item[1])
        listed = (
            ", ".join(f"{name} {p:.2f}" for name, p in ranked if p >= _SHOWN)
            or "no test finds a gap"
        )
        verdict = (
            f"{found['verdict']}: {', '.join(found['causes'])}"
            if found["causes"]
            else found["verdict"]
        )
        rows.append((str(found["step"]), verdict, listed))
    return Table(tuple(rows), ("after experiment", "verdict", "probabilities"))


def _best(document: Mapping[str, Any]) -> str:
    return max(document["model_probabilities"], key=document["model_probabilities"].__getitem__)


def _gel(document: Mapping[str, Any]) -> Table:
    best = _best(document)
    rows = [
        (
            "Model",
            f"{material(best).title}, probability {document['model_probabilities'][best]:.3f}",
        )
    ]
    if found := document.get("findings"):
        rows = [("Model", f"{material(best).title} {_beside(found[-1])}")]
    truth = document.get("truth") or {}
    for name, triple in document["intervals"][best].items():
        entry = PARAMETERS[name]
        known = (
            f"; truth {entry.display_scale * truth[name]:.4g} {entry.display_unit or entry.unit}"
            if name in truth
            else ""
        )
        rows.append((f"{name}, {entry.meaning}", entry.interval(*triple) + known))
    return Table(tuple(rows))


def _designs(proposals: Any) -> Table:
    rows = []
    for design in proposals:
        gain = "-" if design["gain"] is None else f"{design['gain']:.2f} +- {design['gain_sd']:.2f}"
        sizes = (f"{1e6 * design['Rmax_m']:.0f}", f"{1e6 * design['R_inf_m']:.1f}")
        rows.append(
            (str(design["step"]), f"{design['We']:.0f}", f"{design['R_inf*']:.3f}", *sizes, gain)
        )
    return Table(
        tuple(rows),
        ("number", "We", "R_inf/Rmax", "Rmax (µm)", "R_inf (µm)", "expected gain (nats)"),
    )


def _experiments(document: Mapping[str, Any]) -> Table:
    found = zip(document["experiments"], document["labels"], document["designs"], strict=True)
    rows = tuple(
        (str(number), label, f"{we:.0f}", f"{rest:.3f}") for number, label, (we, rest) in found
    )
    return Table(rows, ("number", "name", "We", "R_inf/Rmax"))


def _models(document: Mapping[str, Any]) -> Table:
    rows = []
    for key, probability in sorted(
        document["model_probabilities"].items(), key=lambda item: -item[1]
    ):
        rows.append((material(key).title, f"{probability:.3f}", _values(document, key)))
    return Table(tuple(rows), ("model", "probability", "parameters"))


def _assumed(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    whose = "each of a gel of its own" if document.get("goal") == "population" else "of one gel"
    return [
        ("Experiments", f"{len(document['experiments'])} that count, {whose}"),
        *setting_rows(document, _best(document)),
    ]


def _next_step(document: Mapping[str, Any]) -> str:
    if document.get("stopped"):
        return f"Enough: {document['stopped']}."
    if document["proposals"]:
        first = document["proposals"][0]
        size = f"Rmax {1e6 * first['Rmax_m']:.0f} µm and R_inf {1e6 * first['R_inf_m']:.1f} µm"
        said = f" {first['reason']}" if first.get("reason") else ""
        return (
            f"Shoot We {first['We']:.0f}, R_inf/Rmax {first['R_inf*']:.3f} ({size}), then "
            f"--resume --tell FILE.{said}"
        )
    return ""
