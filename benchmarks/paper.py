"""The published study again, a figure a subcommand, and the table of what the default does in its
place.

  python benchmarks/paper.py all --out FOLDER --workers 2      # campaigns of both cases and policies, every figure, the table
  python benchmarks/paper.py bo|ensembles|models|errors|limit --out FOLDER     # computes and draws
  python benchmarks/paper.py search --out FOLDER     # the cheap search against a dearer one; after the campaigns
  python benchmarks/paper.py campaigns --case stiff-pa --policy optimal --seeds 0:5 --designs 3
  --out FOLDER
  python benchmarks/paper.py sequence|trajectory|table --out FOLDER      # from the campaigns' journals

Study: Chu, Estrada & Bryngelson, arXiv 2409.00011. Each writes FOLDER/NAME.json (and .png and .pdf,
    two columns wide); what is
already in FOLDER is not computed again, so any of them may be interrupted, and seeds and designs
may be added. Truth and inference have full physics.
"""

import argparse
from itertools import product
from pathlib import Path

import paper_campaigns
import paper_figures
import torch

from imr_torch.files import write_json
from imr_torch.material import CASES

FIGURES = {
    "bo": paper_figures.bo,
    "search": paper_figures.search,
    "ensembles": paper_figures.ensembles,
    "models": paper_figures.models,
    "errors": paper_figures.errors,
    "limit": paper_figures.limit,
    "sequence": paper_figures.sequence,
    "trajectory": paper_figures.trajectory,
}


def main() -> None:
    """Run the part asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=("all", "campaigns", "table", *FIGURES))
    parser.add_argument("--out", metavar="FOLDER", required=True, type=Path)
    parser.add_argument("--case", choices=tuple(CASES), default="stiff-pa")
    parser.add_argument("--policy", choices=tuple(paper_campaigns.POLICIES), default="optimal")
    parser.add_argument("--mode", choices=paper_campaigns.MODES, default="exact")
    parser.add_argument(
        "--seeds", default="0:5", metavar="FROM:TO", help="seeds of campaigns, TO not included"
    )
    parser.add_argument("--designs", type=int, default=3)
    parser.add_argument("--workers", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(1)
    everything = args.part == "all"
    if everything or args.part == "campaigns":
        first, last = (int(text) for text in args.seeds.split(":"))
        wanted = (
            product(CASES, paper_campaigns.POLICIES) if everything else [(args.case, args.policy)]
        )
        for case, policy in wanted:
            chosen = (case, policy, args.mode, range(first, last), args.designs)
            paper_campaigns.run(args.out, *chosen, workers=args.workers)
    for name, draw in FIGURES.items():
        if everything or args.part == name:
            draw(args.out)
    if everything or args.part == "table":
        write_json(args.out / "table.json", paper_campaigns.table(args.out))


if __name__ == "__main__":
    main()
