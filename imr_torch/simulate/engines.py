"""Choice of the engine that integrates the bubbles: compiled code, or tensors through
``torchdiffeq``.

``"compiled"``, the default, integrates one bubble after the other in machine code
(:mod:`imr_torch.simulate.compiled`), on several processor threads. ``"torchdiffeq"`` integrates
whole batches of tensors: on a GPU, with gradients by autograd, and with laws that have no compiled
form. Where the compiled engine cannot serve, the tensor engine takes over by itself, warns once,
and gives the same answer.
"""

import functools
import importlib.util
import warnings
from dataclasses import is_dataclass, replace
from typing import Literal

from imr_torch.errors import EngineWarning, InputDataError
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.simulator import Simulator

Engine = Literal["compiled", "torchdiffeq"]
"""What integrates the bubbles."""
ENGINES = ("compiled", "torchdiffeq")
"""The names of the engines."""


def check_engine(simulator: str, engine: str, threads: int | None) -> None:
    """Raise :class:`InputDataError` unless ``engine`` is one of ``ENGINES`` and ``threads`` a
    number of threads.
    """
    if engine not in ENGINES:
        raise InputDataError(
            f"{simulator}.engine is {engine!r}; expected one of {', '.join(ENGINES)}."
        )
    if threads is not None and threads < 1:
        raise InputDataError(
            f"{simulator}.threads is {threads}; expected at least 1, or None for all cores."
        )


def on_one_thread(simulator: Simulator) -> Simulator:
    """The simulator, using one thread: for workers that share the cores of a machine."""
    return (
        replace(simulator, threads=1)
        if is_dataclass(simulator) and hasattr(simulator, "threads")
        else simulator
    )


def compiles(engine: Engine, bubbles: Bubbles) -> bool:
    """Whether the compiled engine integrates a batch.

    If it was asked for and cannot, the reason is given once.
    """
    if engine != "compiled":
        return False
    reason = _obstacle(bubbles)
    if reason is not None:
        _say(
            f"Bubbles are integrated by the torchdiffeq engine, since {reason}; results are the "
            "same and take longer."
        )
    return reason is None


def _obstacle(bubbles: Bubbles) -> str | None:
    parameters = bubbles.parameters
    if not _has_numba():
        return "Numba is not installed (pip install numba)"
    if parameters.device.type != "cpu":
        return f"the compiled engine does not run on {parameters.device}"
    if str(parameters.dtype) != "torch.float64":
        return f"the compiled engine computes in float64, not in {parameters.dtype}"
    from imr_torch.simulate.compiled.run import obstacle

    return obstacle(bubbles)


@functools.cache
def _has_numba() -> bool:
    return importlib.util.find_spec("numba") is not None


@functools.cache
def _say(message: str) -> None:
    warnings.warn(message, EngineWarning, stacklevel=5)
