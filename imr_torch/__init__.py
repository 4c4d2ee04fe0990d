"""Inertial microcavitation rheometry in PyTorch.

What the gel is (:mod:`~imr_torch.material`), what the bubble does (:mod:`~imr_torch.simulate`),
what the camera sees (:mod:`~imr_torch.observe`), what we learn (:mod:`~imr_torch.assimilate`),
which model (:mod:`~imr_torch.select`), what to shoot next (:mod:`~imr_torch.design`), and again
(:mod:`~imr_torch.campaign`). A stage imports only stages before it.

The names below are imported when they are first used, so that ``imr-torch --help`` does not wait
for PyTorch.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from imr_torch.characterization import Characterization, characterize
    from imr_torch.files import example_gel
    from imr_torch.material import Belief, reference_case, wide_prior
    from imr_torch.observe import load_traces
    from imr_torch.simulate import PolytropicSimulator, TransportSimulator

    __version__: str

_HOMES = {
    "Belief": "imr_torch.material",
    "Characterization": "imr_torch.characterization",
    "PolytropicSimulator": "imr_torch.simulate",
    "TransportSimulator": "imr_torch.simulate",
    "characterize": "imr_torch.characterization",
    "example_gel": "imr_torch.files",
    "load_traces": "imr_torch.observe",
    "reference_case": "imr_torch.material",
    "wide_prior": "imr_torch.material",
}

__all__ = [
    "Belief",
    "Characterization",
    "PolytropicSimulator",
    "TransportSimulator",
    "characterize",
    "example_gel",
    "load_traces",
    "reference_case",
    "wide_prior",
]


def __getattr__(name: str) -> Any:
    """A public name, from the module that defines it; kept here after the first use."""
    if name == "__version__":
        value = importlib.import_module("importlib.metadata").version("imr-torch")
    elif name in _HOMES:
        value = getattr(importlib.import_module(_HOMES[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES, "__version__"})
