"""Compare two gels from their results: do they differ, in which parameter, and by how much.

  imr-torch compare gel_a/characterize.json gel_b/characterize.json
  imr-torch compare day1_results/shots/a.json day1_results/shots/b.json --model nhkv

Takes results of characterize or batch (written with --json or --out), of independent data. Ratios
and differences are of parameters, with 90 % intervals. The Bayes factor weighs one gel against two
with the same prior; it is given where the posteriors are Gaussian by their weighted draws and both
had the same prior. Without it, gels are said to differ if one has more of a parameter with a
probability of 97.5 %.
"""

import argparse

from imr_torch.cli.options.shared import add_output_arguments

NAME = "compare"
SUMMARY = "whether two gels differ, and by how much"
WITHOUT = ("seed", "engine")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("a", metavar="A.json", help="result of the first gel")
    parser.add_argument("b", metavar="B.json", help="result of the second gel")
    parser.add_argument(
        "--model",
        help="model whose parameters are compared (default: the most probable of both together)",
    )
    add_output_arguments(parser)
