"""Makers of tensors in double precision, in which everything above the simulators computes, whatever
the default of PyTorch is.

>>> from imr_torch.float64 import tensor, zeros
>>> zeros(2).dtype, tensor([1, 2]).dtype
(torch.float64, torch.float64)
"""

from functools import partial

import torch

tensor = partial(torch.tensor, dtype=torch.float64)
linspace = partial(torch.linspace, dtype=torch.float64)
arange = partial(torch.arange, dtype=torch.float64)
zeros = partial(torch.zeros, dtype=torch.float64)
ones = partial(torch.ones, dtype=torch.float64)
full = partial(torch.full, dtype=torch.float64)
eye = partial(torch.eye, dtype=torch.float64)
rand = partial(torch.rand, dtype=torch.float64)
randn = partial(torch.randn, dtype=torch.float64)
