"""Seeds are a function of their path alone, and a generator is shared, not copied."""

import itertools

import pytest
import torch

from imr_torch.random import child, generator


def test_that_a_child_seed_is_the_same_in_every_process_and_whatever_was_drawn():
    """The first 63 bits of SHA-256 of the path: not Python's ``hash``, which is salted per process."""
    torch.randn(100)
    child(7, "something else")
    assert child(0) == 3456079177858693020


def test_that_different_paths_and_seeds_have_different_children():
    paths = [
        (),
        ("a",),
        ("b",),
        ("a", "b"),
        ("b", "a"),
        ("a", 0),
        ("a", 1),
        ("a", 10),
        (1,),
        (1, 0),
    ]
    seeds = [
        child(seed, *path) for seed, path in itertools.product((0, 1, 10, 2**40), paths)
    ]
    assert len(set(seeds)) == len(seeds)


def test_that_a_seed_gives_a_fresh_generator_each_time():
    first, second = (torch.randn(4, generator=generator(5)) for _ in range(2))
    assert torch.equal(first, second)


@pytest.mark.parametrize(
    "call", [lambda: child(1, "a"), lambda: torch.randn(3, generator=generator(1))]
)
def test_that_the_global_generator_is_not_touched(call):
    state = torch.get_rng_state()
    call()
    assert torch.equal(torch.get_rng_state(), state)
