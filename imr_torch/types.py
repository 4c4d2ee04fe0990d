"""Types that every stage shares.

Annotations name the axes of a tensor, ``Float[Tensor, "*batch experiments frames"]``: an axis has
one size throughout a call, ``*`` is any number of axes, ``#`` broadcasts, ``_`` is free;
``parameters`` is the parameter vector, ``controls`` the free parameters of one model, ``members``
the bubbles of a batch. ``pytest --check-shapes`` checks them in every call.

Shape words in docstrings follow BoTorch: ``batch_shape`` is any leading shape, ``q`` designs
considered together, ``p`` the length of the parameter vector, ``d`` the free parameters of one
model, ``E`` experiments, ``T`` or ``n_t`` frames.
"""

from collections.abc import Callable

from jaxtyping import Float, Inexact
from torch import Tensor

Progress = Callable[[str], None]
"""Called with one line of text per step of long work."""

Members = Inexact[Tensor, "*#batch"]
"""A number of each member of a batch."""

States = Inexact[Tensor, "states *#batch"]
"""The memory states of each member of a batch."""

Values = Float[Tensor, "*batch"]
"""Numbers of any shape, on which a function acts elementwise."""

Frames = Float[Tensor, "*#batch experiments frames"]
"""A number of each frame of each experiment, of each member of a batch."""

ExperimentFrames = Float[Tensor, "experiments frames"]
"""A number of each frame of each experiment."""
