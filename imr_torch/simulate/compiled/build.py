"""From laws to compiled code: what is compiled, where it is kept, and when it is compiled anew.

The common stress laws and all effects are put into one small generated module, ``laws``, each kind
as one function that calls those that act, beside the laws of the radial equation, its liquid and the
gas; every other stress law is a module by itself (:mod:`~imr_torch.simulate.compiled.address`). The
modules of this folder whose functions are kernels are loaded beside it as a package of their own,
so that a second registry gets kernels of its own. Numba compiles an entry point once and keeps the
machine code next to the generated module. The folder is named by a hash of the code of the engine
and of its laws, and of the versions of Python, Numba and NumPy; Numba itself tells processors
apart. So code of another version is never used, a killed compilation leaves files that nobody
reads, and a read-only installation works, since the folder is in the user's cache
(``IMR_TORCH_CACHE`` names another).
"""

import functools
import hashlib
import importlib.util
import os
import sys
import tempfile
import time
import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np

from imr_torch import elementary
from imr_torch.elementary import Law
from imr_torch.files import write_atomically
from imr_torch.html import render
from imr_torch.material import PARAMETERS, Effect, StressTerm
from imr_torch.simulate.bubbles import Numbers
from imr_torch.simulate.compiled import address, algebra, polytropic, transport


@dataclass(frozen=True)
class Registry:
    """All laws that one compiled engine knows.

    Args:
        terms: stress terms whose laws it holds.
        effects: effects with laws that act at every step.
        radial: law of the radial equation.
        liquid: law of its liquid.
        gas: law of polytropic gas.
    """

    terms: tuple[StressTerm, ...]
    effects: tuple[Effect, ...]
    radial: Law
    liquid: Law
    gas: Law

    def named_laws(self) -> dict[str, Law]:
        """Every law by its name in the generated module."""
        named = {"radial_law": self.radial, "liquid_law": self.liquid, "gas_law": self.gas}
        named |= {f"stress_{i}": term.law for i, term in enumerate(self.terms)}
        for i, effect in enumerate(self.effects):
            named |= {
                f"{kind}_{i}": getattr(effect, kind)
                for kind in ("gas_loss", "vapour", "far_field")
            }
        return {name: law for name, law in named.items() if law is not None}


@functools.cache
def load_engine(registry: Registry) -> types.ModuleType:
    """The generated module of a registry, with ``solve_transport`` and ``solve_polytropic``."""
    blocks = (transport.solve_block, polytropic.solve_block)
    return load_generated(source_of(registry), registry.named_laws(), blocks)


def load_generated(
    text: str, functions: Mapping[str, Law], more: Sequence[Any] = (), *, name: str = "laws"
) -> types.ModuleType:
    """A generated module, from the folder in which its compiled code is kept.

    Args:
        text: of the module.
        functions: name -> what it finds under this name.
        more: other functions on which its code depends. Their modules are loaded anew beside it.
        name: of its file.
    """
    folder = _cache_folder(_hash_of(text, (*functions.values(), *more)))
    path = folder / f"{name}.py"
    if not path.exists() or path.read_text() != text:
        write_atomically(path, lambda stream: stream.write(text.encode()))
    package = types.ModuleType(f"imr_torch_engine_{folder.name}")
    package.__path__ = [str(Path(__file__).parent)]
    sys.modules[package.__name__] = package
    spec = importlib.util.spec_from_file_location(f"{package.__name__}.{name}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    vars(module).update(functions)
    vars(package)[name] = sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except Exception:  # half a file, where compiled code is read at once
        for damaged in (folder / "__pycache__").glob("*.nb?"):
            damaged.unlink(missing_ok=True)
        spec.loader.exec_module(module)
    return module


def call_announced(module: types.ModuleType, entry: str, arguments: Sequence[Any]) -> Any:
    """Call an entry point that has not run in this process.

    Where it has to be compiled, say so and how long it took.
    """
    function = getattr(module, entry)
    path = Path(str(module.__file__))
    cached = list((path.parent / "__pycache__").glob(f"{path.stem}.{entry}-*.nb?"))
    if cached:
        try:
            return function(*arguments)
        # whatever unpickling half a file raises; what is wrong with the arguments is raised again
        # below
        except Exception:
            for damaged in cached:
                damaged.unlink(missing_ok=True)
    print(
        f"imr_torch: compiling {entry} (once on this machine; a busy or slow one takes minutes) ...",
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
    >>> "if on[0]:  # newtonian" in source_of(registry_of(Conditions()))
    True
    """
    return render(
        "engine.py.txt",
        terms=registry.terms,
        effects=registry.effects,
        PARAMETERS=PARAMETERS,
        count=len(Numbers._fields),
    )


def _cache_folder(name: str) -> Path:
    """Where code of a name is kept; made if need be."""
    root = os.environ.get("IMR_TORCH_CACHE")
    if root is None:
        home = (
            os.environ.get("LOCALAPPDATA")
            or os.environ.get("XDG_CACHE_HOME")
            or Path.home() / ".cache"
        )
        root = Path(home) / "imr_torch"
    folder = Path(root) / name
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


def _hash_of(text: str, functions: Sequence[Any]) -> str:
    """What compiled code depends on: its text and the functions that it calls."""
    digest = hashlib.sha256()
    for version in (sys.version, numba.__version__, llvmlite.__version__, np.__version__):
        digest.update(version.encode())
    # how functions are compiled
    for file in (__file__, elementary.__file__, algebra.__file__, address.__file__):
        digest.update(Path(file).read_bytes())
    for function in functions:
        for part in elementary.code_of(function):
            digest.update(part)
    digest.update(text.encode())
    return digest.hexdigest()[:20]
