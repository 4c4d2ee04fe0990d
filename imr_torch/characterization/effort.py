"""Choices of a characterisation: how far draws are weighted, and what is done about bad frames."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Effort:
    """How far draws are weighted where they do not settle the intervals of a model.

    Args:
        rounds: of draws, each up to twice as many as the one before.
        behind: nats behind the best model from which a model gets one round only.

    >>> from imr_torch.characterization import EFFORTS
    >>> EFFORTS["thorough"].rounds
    8
    """

    rounds: int
    behind: float


EFFORTS = {"normal": Effort(4, 3.0), "thorough": Effort(8, 7.0)}
FRAMES = ("all", "robust")
"""What is done about single bad frames: named only, or left out too."""
