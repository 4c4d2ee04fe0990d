"""The page of a search for the next experiment, drawn from its document alone: what to shoot, map,
evaluated designs.
"""

from collections.abc import Mapping
from typing import Any

from imr_torch.html import Block, Table, page
from imr_torch.results.figures import draw_figures
from imr_torch.results.page import footer, pictures_of, provenance_table


def design_page(document: Mapping[str, Any], *, title: str = "Next experiment") -> str:
    """The page as HTML.

    Args:
        document: of ``design``, with its header.
        title: of the page.

    >>> from imr_torch.html import page
    >>> from imr_torch.results import design_page, header
    >>> design = {"We": 400.0, "R_inf*": 0.2, "Rmax_m": 5.7e-4}
    >>> document = header("design") | {"design": design, "eig": 3.2, "eig_sd": 0.1, "evaluations": [], "map": None}
    >>> "Shoot We 400, R_inf* 0.200: Rmax 570 um, R_inf 114 um" in design_page(document)
    True
    """
    rows = [document, *document.get("further", ())]
    verdict = [
        f"Shoot {_place(rows[0]['design'])}. Expected information gain {_gain(rows[0])} nats."
    ]
    verdict += [
        f"Beside it, shoot {_place(row['design'])}; it adds {_gain(row)} nats." for row in rows[1:]
    ]
    if len(rows) > 1:
        verdict.append(f"Together {document['joint_eig']:.2f} nats.")
    pictures, failed = pictures_of(draw_figures(document)) if document.get("map") else ([], [])
    blocks = [Block("Where the information is", (*pictures, *failed))] if pictures or failed else []
    for number, row in enumerate(rows, start=1):
        heading = "Designs that were evaluated" + (f", search {number}" if len(rows) > 1 else "")
        blocks.append(Block(heading, (_evaluated(row),), folded=True))
    blocks.append(Block("How it was made", (provenance_table(document),), folded=True))
    return page(title, verdict, blocks, next_step=_NEXT, footer=footer(document))


_NEXT = "Shoot it, then characterise the new curves together with the earlier ones of this gel."


def _place(design: Mapping[str, float]) -> str:
    top = 1e6 * design["Rmax_m"]
    return (
        f"We {design['We']:.0f}, R_inf* {design['R_inf*']:.3f}: Rmax {top:.0f} um, R_inf "
        f"{top * design['R_inf*']:.0f} um"
    )


def _gain(row: Mapping[str, Any]) -> str:
    return f"{row['eig']:.2f} +- {row['eig_sd']:.2f}"


def _evaluated(row: Mapping[str, Any]) -> Table:
    """Every evaluated design, the most informative first."""
    known = sorted((e for e in row["evaluations"] if "eig" in e), key=lambda e: -e["eig"])
    cells = tuple(
        (
            f"{e['We']:.0f}",
            f"{e['R_inf*']:.3f}",
            f"{e['eig']:.2f} +- {e['sd']:.2f}",
            f"{e['parameters']:.2f}",
            f"{e['model']:.2f}",
        )
        for e in known
    )
    return Table(cells, head=("We", "R_inf*", "gain (nats)", "about parameters", "about the model"))
