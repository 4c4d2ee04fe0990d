"""The page of a campaign, drawn from its document alone: what to shoot next, the gel so far, figures, then details."""

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt

from imr_torch.html import Block, Table, page
from imr_torch.material import PARAMETERS, material
from imr_torch.results.campaign_figures import campaign_figures
from imr_torch.results.page import footer, pictures_of, provenance_table, setting_rows


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
        Block("The gel so far", (_gel(document),)),
        Block("Shoot next", (_designs(document["proposals"]),)) if document["proposals"] else None,
        Block("What was assumed", (Table(tuple(_assumed(document))),)),
        Block("Figures", (*pictures, *failed)),
        Block("Experiments that count", (_experiments(document),), folded=True) if document["experiments"] else None,
        Block("All models", (_models(document),), folded=True) if len(document["model_probabilities"]) > 1 else None,
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
    count, best = len(document["experiments"]), _best(document)
    if not count:
        return "No experiment was told yet; what follows is what was believed before."
    lost = f" ({document['forgotten']} more were forgotten)" if document["forgotten"] else ""
    probability = document["model_probabilities"][best]
    said = f"After {count} experiment(s){lost} {material(best).title} has a probability of {probability:.3f}"
    values = "; ".join(f"{n} {PARAMETERS[n].interval(*v)}" for n, v in document["intervals"][best].items())
    return f"{said}: {values}."


def _best(document: Mapping[str, Any]) -> str:
    return max(document["model_probabilities"], key=document["model_probabilities"].__getitem__)


def _gel(document: Mapping[str, Any]) -> Table:
    best = _best(document)
    rows = [("Model", f"{material(best).title}, probability {document['model_probabilities'][best]:.3f}")]
    truth = document.get("truth") or {}
    for name, triple in document["intervals"][best].items():
        entry = PARAMETERS[name]
        known = f"; truth {entry.display_scale * truth[name]:.4g} {entry.display_unit or entry.unit}" if name in truth else ""
        rows.append((f"{name}, {entry.meaning}", entry.interval(*triple) + known))
    return Table(tuple(rows))


def _designs(proposals: Any) -> Table:
    rows = []
    for design in proposals:
        gain = "-" if design["gain"] is None else f"{design['gain']:.2f} +- {design['gain_sd']:.2f}"
        sizes = (f"{1e6 * design['Rmax_m']:.0f}", f"{1e6 * design['R_inf_m']:.1f}")
        rows.append((str(design["step"]), f"{design['We']:.0f}", f"{design['R_inf*']:.3f}", *sizes, gain))
    return Table(tuple(rows), ("number", "We", "R_inf/Rmax", "Rmax (µm)", "R_inf (µm)", "expected gain (nats)"))


def _experiments(document: Mapping[str, Any]) -> Table:
    found = zip(document["experiments"], document["labels"], document["designs"], strict=True)
    rows = tuple((str(number), label, f"{we:.0f}", f"{rest:.3f}") for number, label, (we, rest) in found)
    return Table(rows, ("number", "name", "We", "R_inf/Rmax"))


def _models(document: Mapping[str, Any]) -> Table:
    rows = []
    for key, probability in sorted(document["model_probabilities"].items(), key=lambda item: -item[1]):
        values = "; ".join(f"{n} {PARAMETERS[n].interval(*v)}" for n, v in document["intervals"][key].items())
        rows.append((material(key).title, f"{probability:.3f}", values))
    return Table(tuple(rows), ("model", "probability", "parameters"))


def _assumed(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [("Experiments", f"{len(document['experiments'])} that count, of one gel"), *setting_rows(document, _best(document))]


def _next_step(document: Mapping[str, Any]) -> str:
    if document.get("stopped"):
        return f"Enough: {document['stopped']}."
    if document["proposals"]:
        first = document["proposals"][0]
        size = f"Rmax {1e6 * first['Rmax_m']:.0f} µm and R_inf {1e6 * first['R_inf_m']:.1f} µm"
        return f"Shoot We {first['We']:.0f}, R_inf/Rmax {first['R_inf*']:.3f} ({size}), then --resume --tell FILE."
    return ""
