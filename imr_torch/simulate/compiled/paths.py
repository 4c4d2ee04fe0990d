"""Steps of bubbles that were integrated lately, so that others can follow them without integrating
them again.

A search near a minimum asks for bundle after bundle behind one leader. What a follower takes of its
leader is the length and the time scale of each step, and what a leader gives does not depend on who
follows it, bit for bit: so both are kept. Only bubbles of small batches are; those of a large one
would displace all others.
"""

import threading
from collections import OrderedDict
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np

EXHAUSTED = -2
"""Status of a bundle whose followers need more steps than are known of its leader."""

_KEPT = 256  # bubbles
_BATCH = 64  # bundles in a batch, at most, whose leaders are kept
_STEPS = 4096  # steps, and times, of a bubble that is kept, at most


class Path(NamedTuple):
    """A bubble that was integrated to its end.

    Args:
        steps: ``n x 2``, length and time scale of each step.
        curves: ``3 x n_t``, radius, velocity and pressure.
        nodes: of its path up to its last time.
    """

    steps: np.ndarray
    curves: np.ndarray
    nodes: int


_paths: OrderedDict[Hashable, Path] = OrderedDict()
_lock = threading.Lock()


class Leaders:
    """The leaders of a batch: those whose steps are known, and room for the steps of the others.

    Args:
        bundles: in the batch.
        times: of each bubble.
        max_steps: attempted steps after which a bundle is given up.

    Attributes:
        steps: ``bundles x most x 2``; of no length where none is kept.
        known: how many steps are known of each leader; 0 of one that is to be integrated.
    """

    def __init__(self, bundles: int, times: int, max_steps: int) -> None:
        small = bundles <= _BATCH and times <= _STEPS
        self.steps = np.empty((bundles, min(max_steps, _STEPS) if small else 0, 2))
        self.known = np.zeros(bundles, np.int64)
        self._paths: list[Path | None] = [None] * bundles
        self._keys: Sequence[Hashable] = ()

    @property
    def kept(self) -> bool:
        """Whether leaders of this batch are kept."""
        return bool(self.steps.shape[1])

    def recall(self, keys: Sequence[Hashable]) -> None:
        """Look up leaders by all that what they give depends on."""
        self._keys = keys
        with _lock:
            self._paths = [_paths.get(key) for key in keys]
            for key, path in zip(keys, self._paths, strict=True):
                if path is not None:
                    _paths.move_to_end(key)
        for bundle, path in enumerate(self._paths):
            if path is not None:
                self.known[bundle] = len(path.steps)
                self.steps[bundle, : len(path.steps)] = path.steps

    def forget(self, bundles: np.ndarray) -> None:
        """Have the leaders of some bundles integrated."""
        self.known[bundles] = 0
        for bundle in bundles:
            self._paths[bundle] = None

    def keep(self, curves: np.ndarray, done: np.ndarray, counts: np.ndarray) -> None:
        """Fill in what known leaders give, and keep those that were integrated to their ends.

        Args:
            curves: ``3 x bundles x n_t``, of the leaders; those of known ones are filled in.
            done: which bundles reached their ends.
            counts: nodes of the path of each leader; those of known ones are filled in.
        """
        for bundle, (key, path) in enumerate(zip(self._keys, self._paths, strict=True)):
            if path is not None:
                curves[:, bundle], counts[bundle] = path.curves, path.nodes
            elif done[bundle] and self.known[bundle]:
                steps = self.steps[bundle, : self.known[bundle]].copy()
                path = Path(steps, curves[:, bundle].copy(), int(counts[bundle]))
                with _lock:
                    _paths[key] = path
                    while len(_paths) > _KEPT:
                        _paths.popitem(last=False)


def forget_all() -> None:
    """Keep no bubble: the next ones are integrated."""
    with _lock:
        _paths.clear()
