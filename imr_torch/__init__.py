"""Inertial microcavitation rheometry in PyTorch.

What the gel is (:mod:`~imr_torch.material`), what the bubble does (:mod:`~imr_torch.simulate`), what the camera sees
(:mod:`~imr_torch.observe`), what we learn (:mod:`~imr_torch.assimilate`), which model (:mod:`~imr_torch.select`), what to
shoot next (:mod:`~imr_torch.design`), and again (:mod:`~imr_torch.campaign`). A stage imports only stages before it.
"""

from importlib.metadata import version

from imr_torch.characterize import Characterization, characterize
from imr_torch.material import Belief, reference_case, wide_prior
from imr_torch.observe import load_traces
from imr_torch.simulate import PolytropicSimulator, TransportSimulator

__version__ = version("imr-torch")

__all__ = [
    "Belief",
    "Characterization",
    "PolytropicSimulator",
    "TransportSimulator",
    "characterize",
    "load_traces",
    "reference_case",
    "wide_prior",
]
