"""Reproducible seeds: each stochastic step has its own, a function of the main seed and the name of
the step.

``child(seed, "eig", 3)`` depends on the names only, never on how many numbers were drawn before, so
a resumed campaign draws exactly what the uninterrupted one would have drawn. The global generator
is never touched here.
"""

import hashlib

import torch

SeedLike = int | torch.Generator


def child(seed: int, *names: str | int) -> int:
    """A 63-bit seed that is a function of ``seed`` and the path ``names`` alone.

    >>> from imr_torch.random import child
    >>> child(0, "noise", 1) == child(0, "noise", 1), child(0, "noise", 1) == child(0, "noise", 2)
    (True, False)
    """
    path = "/".join([str(seed), *map(str, names)])
    return int.from_bytes(hashlib.sha256(path.encode()).digest()[:8], "big") >> 1


def generator(seed: SeedLike) -> torch.Generator:
    """The generator of ``seed``; a generator is passed through, so functions can share one.

    >>> import torch
    >>> from imr_torch.random import generator
    >>> source = generator(7)
    >>> generator(source) is source, torch.rand(3, generator=source).shape
    (True, torch.Size([3]))
    """
    if isinstance(seed, torch.Generator):
        return seed
    return torch.Generator().manual_seed(seed)
