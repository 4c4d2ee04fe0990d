"""What compiled code is known by: everything that the meaning of a law depends on, and nothing
else.
"""

import torch

from imr_torch.elementary import code_of


def scaled(x: torch.Tensor, factor: float = 2.0) -> torch.Tensor:
    return factor * x


def law(x: torch.Tensor) -> torch.Tensor:
    return scaled(x)


def test_that_another_default_of_a_helper_is_other_code():
    before = b"".join(code_of(law))
    assert b"".join(code_of(law)) == before
    kept = scaled.__defaults__
    try:
        scaled.__defaults__ = (3.0,)
        assert b"".join(code_of(law)) != before
    finally:
        scaled.__defaults__ = kept
    assert b"".join(code_of(law)) == before
