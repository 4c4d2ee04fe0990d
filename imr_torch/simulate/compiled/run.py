"""The compiled engine: tensors in, tensors out, bubbles shared among processor threads.

Bubbles are independent and each is integrated by itself, so results depend neither on the batch nor
on the number of threads, bit for bit.
"""

import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import get_ident
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.html import render
from imr_torch.material import LIBRARY, MATERIALS, PARAMETERS, StressTerm
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.clock import memory_share
from imr_torch.simulate.compiled import polytropic, step
from imr_torch.simulate.compiled.algebra import pad_matrix
from imr_torch.simulate.compiled.build import (
    Registry,
    call_announced,
    load_engine,
    load_generated,
)
from imr_torch.simulate.compiled.wall import Batch, Setup
from imr_torch.simulate.conditions import Conditions, Stepping
from imr_torch.simulate.driving import TabulatedDriving
from imr_torch.simulate.grids import Grid, Resolution
from imr_torch.simulate.radial import NEARLY_SONIC
from imr_torch.threads import cores

COMMON = tuple(dict.fromkeys(MATERIALS["qkv"].terms + MATERIALS["maxwell"].terms))
"""The stress terms whose laws are compiled into the engine: ``newtonian``, ``neo_hookean``,
``stiffening`` and ``maxwell``.
"""
_NO_DRIVING = TabulatedDriving((0.0, 1.0, 2.0), (0.0, 0.0, 0.0))


def registry_of(conditions: Conditions) -> Registry:
    """The common stress terms, the effects that have a compiled form, and the laws of a simulator's
    conditions.
    """
    motion = conditions.motion
    return Registry(
        terms=COMMON,
        effects=tuple(
            e
            for e in LIBRARY.values()
            if e.compilable and (e.gas_loss or e.vapour or e.far_field)
        ),
        radial=type(motion).law,
        liquid=type(motion.liquid).law,
        gas=type(conditions.gas).law,
    )


def solve_transport(
    bubbles: Bubbles,
    times: Float[Tensor, "members times"],
    width: int,
    resolution: Resolution,
    limits: tuple[float, int, float],
    threads: int | None,
) -> tuple[Tensor, ...]:
    """Integrate bubbles with heat and vapour transport; see :func:`_solve_bundles` for arguments and
    results.

    Args:
        bubbles: the batch.
        times: ``B x n_t`` tensor.
        width: members of a bundle.
        resolution: grids inside and outside the bubble.
        limits: tolerance, steps at most, and length of the first step.
        threads: that share the bubbles; all cores if None.
    """
    space = _space_of(resolution)
    work = (step.work_for, len(space.y), len(space.shear))
    settings = (space, *limits)
    return _solve_bundles("solve_transport", bubbles, times, width, settings, work, threads)


def solve_polytropic(
    bubbles: Bubbles,
    times: Float[Tensor, "members times"],
    width: int,
    stepping: Stepping,
    threads: int | None,
) -> tuple[Tensor, ...]:
    """Integrate bubbles of polytropic gas; see :func:`_solve_bundles` for arguments and results."""
    steps = [stepping.step * 0.5**attempt for attempt in range(stepping.retries + 1)]
    attempts = np.array([(step, memory_share(step)) for step in steps])
    settings = (attempts, stepping.max_steps)
    work = (polytropic.work_for,)
    return _solve_bundles(
        "solve_polytropic", bubbles, times, width, settings, work, threads
    )


@functools.lru_cache(maxsize=64)
def _own_arrays(work_for: Callable[..., Any], *sizes: int) -> Any:
    """What the entry point works in.

    The last number is the thread whose arrays these are, which nothing else uses.
    """
    return work_for(*sizes[:-1])


def _solve_bundles(
    entry: str,
    bubbles: Bubbles,
    times: Tensor,
    width: int,
    settings: tuple[Any, ...],
    work: tuple[Any, ...],
    threads: int | None,
) -> tuple[Tensor, ...]:
    """Integrate a batch, bundle after bundle.

    Args:
        entry: ``"solve_transport"`` or ``"solve_polytropic"``.
        bubbles: the batch, ``B`` members.
        times: ``B x n_t`` tensor.
        width: members of a bundle.
        settings: what the entry point takes of the simulator's.
        work: what makes the arrays that the entry point works in, and the sizes that it takes
            before memory states and width of a bundle.
        threads: that share the bubbles; all cores if None.

    Returns:
        Radius, velocity, pressure (``B x n_t`` each), status and steps (``B`` each; of the
        leaders).
    """
    registry = registry_of(bubbles.conditions)
    module = load_engine(registry)
    count = len(times) // width
    theta = bubbles.parameters.T.contiguous().numpy()
    others = tuple(term for term in bubbles.terms if term not in registry.terms)
    terms = (*registry.terms, *others)
    of_terms = PARAMETERS.index([term.switch for term in terms])
    of_effects = PARAMETERS.index([effect.names[0] for effect in registry.effects])
    acts = _acting_parts(theta[:, of_terms], terms, bubbles.terms, width)
    batch = Batch(
        width=width,
        numbers=torch.stack(bubbles.numbers, 1).numpy(),
        theta=theta,
        terms=acts,
        memory=_memory_of(bubbles, terms, acts.repeat(width, 0)),
        fading=bubbles.fastest_relaxation().numpy(),
        effects=_acting_parts(
            theta[:, of_effects], registry.effects, bubbles.effects, width
        ),
        times=times.contiguous().numpy(),
        curves=np.empty((3, *times.shape)),
        status=np.empty(count, np.int64),
        steps=np.empty(count, np.int64),
        setup=_setup_of(bubbles, others),
    )
    states = batch.terms @ np.array([term.states for term in terms])

    for number in np.unique(states):
        bundles = np.flatnonzero(states == number)
        sizes = (*work, int(number), width)
        _share_out(module, entry, bundles, (batch, settings), sizes, threads or cores())
    every = (
        torch.from_numpy(x).repeat_interleave(width) for x in (batch.status, batch.steps)
    )
    return *torch.from_numpy(batch.curves).unbind(0), *every


def _acting_parts(
    switches: np.ndarray, known: Sequence[Any], chosen: Sequence[Any], width: int
) -> np.ndarray:
    """Which of the engine's terms or effects act in each bundle, ``bundles x known``.

    What is not zero is switched on.
    """
    acts = (switches != 0.0) & np.array([x in chosen for x in known], dtype=bool)
    return np.ascontiguousarray(acts.reshape(len(acts) // width, width, len(known)).any(1))


@functools.cache
def locate_law(term: StressTerm) -> tuple[int, int, int]:
    """Addresses of a law for real and complex numbers, and its memory states; compiled if need be."""
    laws = {"law": term.law} | ({"excess": term.excess} if term.excess else {})
    text = render("law.py.txt", term=term, PARAMETERS=PARAMETERS)
    module = load_generated(text, laws, name="law")
    real, imaginary = (pointer.address for pointer in module.pointers)
    return real, imaginary, term.states


def _memory_of(
    bubbles: Bubbles, terms: Sequence[StressTerm], acts: np.ndarray
) -> np.ndarray:
    """What each member's memory starts from, in the order of its terms that act (``members x
    terms``).
    """
    theta = bubbles.theta
    parts = [term.memory_start(bubbles.numbers.rest_radius, theta) for term in terms]
    on = acts.repeat([term.states for term in terms], 1)
    start = np.where(on, torch.cat(parts).T.numpy(), 0.0)
    return np.take_along_axis(start, (~on).argsort(1, kind="stable"), 1)


def _setup_of(bubbles: Bubbles, others: tuple[StressTerm, ...]) -> Setup:
    """What all bubbles of a batch share."""
    conditions = bubbles.conditions
    motion = conditions.motion
    knots, cubics = (conditions.driving or _NO_DRIVING).pieces
    return Setup(
        bubbles.constants,
        tuple(map(float, (*motion.form, *motion.constants))),
        tuple(map(float, motion.liquid.constants)),
        NEARLY_SONIC * motion.sonic,
        conditions.driving is not None,
        knots.numpy(),
        cubics.numpy(),
        1.0 / conditions.surroundings.far_field_pressure,
        np.array([locate_law(term) for term in others], np.int64).reshape(-1, 3),
    )


def _share_out(
    module: Any,
    entry: str,
    bundles: np.ndarray,
    arguments: tuple[Any, ...],
    work: tuple[Any, ...],
    threads: int,
    *,
    chunk: int = 64,
    shares: int = 8,
) -> None:
    """Call an entry point for some bundles, in chunks, on some threads.

    Args:
        module: the engine.
        entry: name of the entry point.
        bundles: their numbers.
        arguments: what the entry point takes beside bundles and arrays to work in.
        work: see :func:`_own_arrays`.
        threads: how many.
        chunk: bundles between two looks at the keyboard, at most.
        shares: chunks a thread, at least, so that none waits long for the last.
    """
    threads = min(threads, len(bundles))
    size = chunk if threads == 1 else max(1, min(chunk, len(bundles) // (shares * threads)))
    chunks = [bundles[first : first + size] for first in range(0, len(bundles), size)]
    function = getattr(module, entry)
    if not function.overloads:  # is compiled before threads begin
        own = _own_arrays(*work, get_ident())
        call_announced(module, entry, (chunks.pop(0), *arguments, own))

    def solve_chunk(part: np.ndarray) -> None:
        function(part, *arguments, _own_arrays(*work, get_ident()))

    if threads == 1 or len(chunks) == 1:
        for part in chunks:
            solve_chunk(part)
    else:
        list(_thread_pool(threads).map(solve_chunk, chunks))


@functools.cache
def _thread_pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="imr_torch")


if hasattr(os, "register_at_fork"):
    # threads do not survive a fork, and waiting for them never ends
    os.register_at_fork(after_in_child=_thread_pool.cache_clear)


@functools.cache
def _space_of(resolution: Resolution) -> step.Space:
    """The grids; read only."""
    inside, outside = resolution.grids()

    def columns_of(matrix: Tensor) -> np.ndarray:
        return pad_matrix(matrix.T.numpy())

    def operators_of(grid: Grid) -> np.ndarray:
        parts = (grid.first[1:], grid.laplacian, grid.first[:1])
        return pad_matrix(np.concatenate([columns_of(part) for part in parts], 1))

    y = outside.nodes
    return step.Space(
        inside=operators_of(inside),
        outside=operators_of(outside),
        first=columns_of(inside.first[1:, 1:]),
        laplacian=columns_of(inside.laplacian[:, 1:]),
        rows=columns_of(inside.first[1:, 1:].T),
        outer_first=columns_of(outside.first[1:, 1:]),
        outer_laplacian=columns_of(outside.laplacian[:, 1:]),
        y=inside.nodes.contiguous().numpy(),
        stretching=(y**-2 - y).numpy(),
        shear=(y**-6).numpy(),
    )
