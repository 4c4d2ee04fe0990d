"""From laws to compiled code: what is compiled, where it is kept, and when it is compiled anew.

The laws of all registries (stress terms, effects, radial equations, gas laws) are put
into one small generated module, ``laws``, each kind as one function that calls those that act. The
modules of this folder whose functions are kernels are loaded beside it as a package of their own,
so that a second registry gets kernels of its own. Numba compiles an entry point once and keeps the
machine code next to the generated module. The folder is named by a hash of the code of the engine
and of every law, and of the versions of Python, Numba and NumPy; Numba itself tells processors
apart. So code of another version is never used, a killed compilation leaves files that nobody
reads, and a read-only installation works, since the folder is in the user's cache
(``IMR_TORCH_CACHE`` names another).
"""

import functools
import hashlib
import importlib.util
import inspect
import os
import sys
import tempfile
import time
import types
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np

from imr_torch import elementary
from imr_torch.elementary import Law
from imr_torch.files import write_atomically
from imr_torch.material import PARAMETERS, Effect, StressTerm
from imr_torch.simulate.bubbles import Numbers
from imr_torch.simulate.compiled import algebra, polytropic, transport


@dataclass(frozen=True)
class Registry:
    """All laws that one compiled engine knows.

    Args:
        terms: stress terms.
        effects: effects with laws that act at every step.
        radial: laws of radial equations.
        liquids: laws of liquids.
        gases: laws of polytropic gas.
    """

    terms: tuple[StressTerm, ...]
    effects: tuple[Effect, ...]
    radial: tuple[Law, ...]
    liquids: tuple[Law, ...]
    gases: tuple[Law, ...]

    def named_laws(self) -> Iterator[tuple[str, Law]]:
        """Every law with its name in the generated module."""
        groups: dict[str, Sequence[Law | None]] = {
            "law": [term.law for term in self.terms],
            "start": [term.start for term in self.terms],
            "fastest": [term.fastest for term in self.terms],
            **{kind: [getattr(effect, kind) for effect in self.effects] for kind in _EFFECTS},
            "radial": self.radial,
            "liquid": self.liquids,
            "gas": self.gases,
        }
        for kind, group in groups.items():
            yield from ((f"{kind}_{i}", law) for i, law in enumerate(group) if law is not None)


@functools.cache
def switch_columns(registry: Registry) -> tuple[list[int], list[int]]:
    """Columns of the parameters that switch each term and each effect on."""
    return PARAMETERS.index([t.switch for t in registry.terms]), PARAMETERS.index(
        [e.names[0] for e in registry.effects]
    )


@functools.cache
def load_engine(registry: Registry) -> types.ModuleType:
    """The generated module of a registry, with ``solve_transport`` and ``solve_polytropic``."""
    folder = _cache_folder(registry)
    path = folder / "laws.py"
    text = source_of(registry)
    if not path.exists() or path.read_text() != text:
        write_atomically(path, lambda stream: stream.write(text.encode()))
    package = types.ModuleType(f"imr_torch_engine_{folder.name}")
    package.__path__ = [str(Path(__file__).parent)]
    sys.modules[package.__name__] = package
    spec = importlib.util.spec_from_file_location(f"{package.__name__}.laws", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    vars(module).update(registry.named_laws())
    vars(package)["laws"] = sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def _cached_files(module: types.ModuleType, entry: str) -> list[Path]:
    """The files in which an entry point of an engine is kept in compiled form."""
    assert module.__file__ is not None
    path = Path(module.__file__)
    return list((path.parent / "__pycache__").glob(f"{path.stem}.{entry}-*.nb?"))


def call_announced(module: types.ModuleType, entry: str, arguments: Sequence[Any]) -> Any:
    """Call an entry point that has not run in this process.

    Where it has to be compiled, say so and how long it took.
    """
    function = getattr(module, entry)
    if cached := _cached_files(module, entry):
        try:
            return function(*arguments)
        # whatever unpickling half a file raises; what is wrong with the arguments is raised again
        # below
        except Exception:
            for path in cached:
                path.unlink(missing_ok=True)
    print(
        f"imr_torch: compiling {entry} (once on this machine, about a minute) ...",
        file=sys.stderr,
        flush=True,
    )
    begin = time.perf_counter()
    result = function(*arguments)
    print(
        f"imr_torch: compiled {entry} in {time.perf_counter() - begin:.0f} s",
        file=sys.stderr,
        flush=True,
    )
    return result


def source_of(registry: Registry) -> str:
    """The text of the generated module.

    >>> from imr_torch.simulate import Conditions
    >>> from imr_torch.simulate.compiled.build import source_of
    >>> from imr_torch.simulate.compiled.run import registry_of
    >>> "if on[0]:  # newtonian" in source_of(registry_of(Conditions(), None))
    True
    """
    parts = [
        _HEAD,
        _write_stress(registry.terms),
        _write_memory(registry.terms),
        _write_effects(registry.effects),
        _write_choice("radial", registry.radial),
        _write_choice("liquid", registry.liquids),
        _write_choice("gas", registry.gases),
        _write_numbers(),
        _write_entry("transport", transport.solve_block),
        _write_entry("polytropic", polytropic.solve_block),
    ]
    return "\n\n\n".join(parts) + "\n"


_HEAD = '''"""Generated by imr_torch from the laws of its registries; made anew whenever they change."""

import functools

from imr_torch.elementary import kernel
from imr_torch.simulate.bubbles import Numbers'''


def _write_entry(physics: str, block: Any) -> str:
    """An entry point that is kept in compiled form."""
    arguments = ", ".join(inspect.signature(block).parameters)
    return f"""from .{physics} import solve_block as {physics}_block


@functools.partial(kernel, cache=True)
def solve_{physics}({arguments}):
    {physics}_block({arguments})"""


def _theta_columns(names: Sequence[str]) -> str:
    return "".join(f", theta[{i}]" for i in PARAMETERS.index(list(names)))


def _write_stress(terms: Sequence[StressTerm]) -> str:
    """The sum of the terms that act, and the rates of their memory."""
    lines = ["@kernel", "def stress(radius, velocity, rest_radius, on, theta, memory, rates):"]
    lines += [
        "    value = 0.0 * radius",
        "    rate = value",
        "    acceleration = value",
        "    k = 0",
    ]
    for i, term in enumerate(terms):
        states = "".join(f", memory[k + {j}]" for j in range(term.states))
        changes = "".join(f", z{j}" for j in range(term.states))
        lines += [
            f"    if on[{i}]:  # {term.name}",
            f"        v, r, a{changes} = law_{i}(radius, velocity, "
            f"rest_radius{states}{_theta_columns(term.names)})",
            "        value += v",
            "        rate += r",
            "        acceleration += a",
        ]
        lines += [f"        rates[k + {j}] = z{j}" for j in range(term.states)]
        lines += [f"        k += {term.states}"] if term.states else []
    return "\n".join([*lines, "    return value, rate, acceleration"])


def _write_memory(terms: Sequence[StressTerm]) -> str:
    """Where memory states start, and how fast they fade."""
    begin = ["@kernel", "def start(rest_radius, on, theta, memory):", "    k = 0"]
    fade = ["@kernel", "def fastest(on, theta):", "    rate = 0.0"]
    for i, term in enumerate(terms):
        if not term.states:
            continue
        begin += [f"    if on[{i}]:"]
        if term.start is None:
            begin += [f"        memory[k + {j}] = 0.0" for j in range(term.states)]
        else:
            names = "".join(f"z{j}, " for j in range(term.states))
            begin += [f"        {names[:-1]} = start_{i}(rest_radius{_theta_columns(term.names)})"]
            begin += [f"        memory[k + {j}] = z{j}" for j in range(term.states)]
        begin += [f"        k += {term.states}"]
        if term.fastest is not None:
            arguments = _theta_columns(term.names)[2:]
            fade += [f"    if on[{i}]:", f"        rate = max(rate, fastest_{i}({arguments}))"]
    return "\n\n\n".join("\n".join(x) for x in (begin, [*fade, "    return rate"]))


_EFFECTS = {
    "gas_loss": ("radius, velocity, rest_radius", "0.0 * radius", "+"),
    "vapour": ("compression", "1.0 + 0.0 * compression", "*"),
    "far_field": ("time", "(0.0, 0.0, 0.0)", "+"),
}
"""Kind of law -> its arguments beside parameters, its value where none acts, and how several add up."""


def _write_effects(effects: Sequence[Effect]) -> str:
    """The laws of effects, each kind put together."""
    functions = []
    for kind, (arguments, nothing, operator) in _EFFECTS.items():
        lines = ["@kernel", f"def {kind}({arguments}, on, theta):", f"    total = {nothing}"]
        for i, effect in enumerate(effects):
            if getattr(effect, kind) is None:
                continue
            call = f"{kind}_{i}({arguments}{_theta_columns(effect.names)})"
            lines += [f"    if on[{i}]:  # {effect.name}"]
            if kind == "far_field":
                lines += [
                    f"        v, r, a = {call}",
                    "        total = (total[0] + v, total[1] + r, total[2] + a)",
                ]
            else:
                lines += [f"        total = total {operator} {call}"]
        functions.append("\n".join([*lines, "    return total"]))
    return "\n\n\n".join(functions)


def _write_choice(kind: str, laws: Sequence[Law]) -> str:
    """One function that calls the law of a number.

    Arguments that the shortest law lacks come out of one array.
    """
    signatures = [tuple(inspect.signature(law).parameters) for law in laws]
    common = min(signatures, key=len)
    arguments = ", ".join(common)
    lines = ["@kernel", f"def {kind}(kind, {arguments}, constants):"]
    for i, (law, own) in enumerate(zip(laws, signatures, strict=True)):
        call = f"{kind}_{i}({arguments}{_entries(len(own) - len(common))})"
        lines += [f"    if kind == {i}:  # {law.__qualname__}", f"        return {call}"]
    lines[-2] = "    # " + laws[-1].__qualname__
    lines[-1] = lines[-1][4:]
    return "\n".join(lines)


def _entries(count: int) -> str:
    return "".join(f", constants[{j}]" for j in range(count))


def _write_numbers() -> str:
    values = ", ".join(f"row[{i}]" for i in range(len(Numbers._fields)))
    return f"@kernel\ndef numbers(row):\n    return Numbers({values})"


def _cache_folder(registry: Registry) -> Path:
    """Where the code of a registry is kept; made if need be."""
    root = os.environ.get("IMR_TORCH_CACHE")
    if root is None:
        home = (
            os.environ.get("LOCALAPPDATA")
            or os.environ.get("XDG_CACHE_HOME")
            or Path.home() / ".cache"
        )
        root = Path(home) / "imr_torch"
    folder = Path(root) / _hash_of(registry)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        print(
            f"imr_torch: {folder} cannot be written, so compiled code is not kept; set "
            "IMR_TORCH_CACHE.",
            file=sys.stderr,
        )
        return Path(tempfile.mkdtemp(prefix="imr_torch_"))


def _hash_of(registry: Registry) -> str:
    """What the compiled code depends on."""
    digest = hashlib.sha256()
    for version in (sys.version, numba.__version__, llvmlite.__version__, np.__version__):
        digest.update(version.encode())
    for file in (__file__, elementary.__file__, algebra.__file__):  # how functions are compiled
        digest.update(Path(file).read_bytes())
    for function in (
        transport.solve_block,
        polytropic.solve_block,
        *dict(registry.named_laws()).values(),
    ):
        for part in elementary.code_of(function):
            digest.update(part)
    digest.update(source_of(registry).encode())
    return digest.hexdigest()[:20]
