"""The compiled engine: one bubble after the other in machine code, written once with the tensor
engine's laws.

:mod:`~imr_torch.simulate.compiled.run` takes tensors and gives tensors;
:mod:`~imr_torch.simulate.compiled.build` compiles and keeps the code;
:mod:`~imr_torch.simulate.compiled.transport` and :mod:`~imr_torch.simulate.compiled.polytropic`
integrate (:mod:`~imr_torch.simulate.compiled.step` is one step of the former);
:mod:`~imr_torch.simulate.compiled.wall` balances the wall and
:mod:`~imr_torch.simulate.compiled.output` fills in the output. ``python -m
imr_torch.simulate.compiled`` compiles everything ahead.
"""

from typing import Any

laws: Any = None
"""What :mod:`~imr_torch.simulate.compiled.build` generates; kernels are loaded anew beside it."""
