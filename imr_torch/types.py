"""Types that every stage shares.

Shape words in docstrings follow BoTorch: ``batch_shape`` is any leading shape, ``q`` designs considered together, ``p`` the
length of the parameter vector, ``d`` the free parameters of one model, ``E`` experiments, ``T`` or ``n_t`` frames.
"""

from collections.abc import Callable

Progress = Callable[[str], None]
"""Called with one line of text per step of long work."""
