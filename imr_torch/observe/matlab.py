"""MATLAB files (v4 to v7.3): their variables, the curves in them, and which maximum radius belongs
to which curve.

Nothing here guesses units: a :class:`imr_torch.observe.load.Layout` says what a variable means. The
    one thing that is
worked out is which entries of a list of maximum radii belong to the curves when the list is longer
than the curves are
many: all curves of one camera must have the same frame spacing once their dimensionless times are
    undone.
"""

import itertools
import math
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy  # whose parts are imported when they are used

from imr_torch.errors import InputDataError
from imr_torch.observe.layout import Layout
from imr_torch.observe.npz import LARGEST
from imr_torch.observe.raw import RawCurve

SPACING_TOLERANCE = 0.01
COMMON_SPACING_TOLERANCE = 0.002
MAX_CHOICES = 20000

Variables = dict[str, Any]


def read_variables(path: Path) -> Variables:
    """All variables of a MATLAB file; the fields of a struct are named ``struct.field``.

    Raises:
        InputDataError: if the file cannot be read, or holds no variable.
    """
    import pymatreader  # takes long to import

    _check_size(path)
    try:
        content = pymatreader.read_mat(str(path))
    except Exception as error:  # SciPy, h5py and zlib each raise their own kinds on damaged files
        raise InputDataError(
            f"{path}: cannot be read as a MATLAB file ({type(error).__name__}: {error}). Save it "
            "again in MATLAB with "
            "save(name, '-v7'), or export time and radius as CSV."
        ) from error
    variables = _flatten(content)
    if not variables:
        raise InputDataError(
            f"{path}: holds no variables; save the radius and time vectors into it."
        )
    return variables


def names(path: Path) -> tuple[str, ...]:
    """Names of the variables of a MATLAB file, without reading them; none if it cannot be read."""
    try:
        if h5py.is_hdf5(path):
            with h5py.File(path) as file:
                return tuple(file)
        return tuple(name for name, _, _ in scipy.io.whosmat(str(path)))
    except Exception:  # a damaged file is reported where it is read
        return ()


def _check_size(path: Path) -> None:
    """Refuse a file whose variables would take more memory than ``LARGEST``."""
    sizes: dict[str, int] = {}
    try:
        if h5py.is_hdf5(path):
            with h5py.File(path) as file:
                file.visititems(
                    lambda name, x: (
                        sizes.update({name: x.nbytes}) if isinstance(x, h5py.Dataset) else None
                    )
                )
        else:
            sizes = {name: 8 * math.prod(shape) for name, shape, _ in scipy.io.whosmat(str(path))}
    except Exception:  # a damaged file is reported where it is read
        return
    if sum(sizes.values()) > LARGEST:
        name = max(sizes, key=lambda name: sizes[name])
        raise InputDataError(
            f"{path}: its variables take {sum(sizes.values()) / 2**30:.3g} GiB, above "
            f"{LARGEST / 2**30:.3g} (the largest "
            f"is '{name}'); it is damaged, or holds more than curves: save radius and time alone."
        )


def plain_vectors(variables: Variables) -> dict[str, np.ndarray]:
    """The variables that are one vector of real numbers, longer than 1."""
    found = {}
    for name, value in variables.items():
        array = None if isinstance(value, (dict, list, str)) else np.asarray(value)
        if (
            array is not None
            and array.dtype.kind in "fiub"
            and array.size > 1
            and max(array.shape) == array.size
        ):
            found[name] = array.astype(np.float64).reshape(-1)
    return found


def _flatten(content: dict[str, Any], prefix: str = "") -> Variables:
    flat: Variables = {}
    for name, value in content.items():
        if name.startswith(("__", "#")):
            continue
        if isinstance(value, dict):
            flat |= _flatten(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


def describe(variables: Variables) -> str:
    """Names and shapes, such as ``R (256,), All cell of 4 x (257,), Req scalar``."""
    return ", ".join(f"{name} {_shape(value)}" for name, value in variables.items())


def _shape(value: Any) -> str:
    if isinstance(value, str):
        return "text"
    if isinstance(value, list):
        shapes = sorted({str(np.shape(x)) for x in value if not isinstance(x, (dict, list))})
        return f"cell of {len(value)} x {' or '.join(shapes[:3]) or 'struct'}"
    shape = np.shape(value)
    return str(shape) if shape else "scalar"


def vectors(file: str, variables: Variables, name: str) -> list[np.ndarray]:
    """A variable as float64 vectors: one for a plain vector, one per cell for a cell array.

    Raises:
        InputDataError: if the variable is missing, is no vector, or does not hold real numbers.
    """
    if name not in variables:
        raise InputDataError(
            f"{file}: variable '{name}', named by the layout, is not in the file. It holds: "
            f"{describe(variables)}. "
            "Name one of these in --layout."
        )
    value = variables[name]
    cells = value if isinstance(value, list) else [value]
    out = []
    for i, cell in enumerate(cells):
        where = f"{file}: variable '{name}'" + (f", cell {i + 1}" if len(cells) > 1 else "")
        array = None if isinstance(cell, (dict, list, str)) else np.asarray(cell)
        if array is None or array.dtype.kind not in "fiub":
            raise InputDataError(
                f"{where} holds {str(cell)[:40]!r}, not real numbers; name a numeric variable in "
                "--layout."
            )
        if sum(n > 1 for n in array.shape) > 1:
            raise InputDataError(
                f"{where} has shape {array.shape}; expected a vector, or a cell array of vectors: "
                "save each curve as one cell."
            )
        out.append(array.astype(np.float64).reshape(-1))
    return out


def entries(file: str, variables: Variables, name: str) -> np.ndarray:
    """A variable as one list of numbers (a vector, a scalar, or a cell array of scalars)."""
    return np.concatenate(vectors(file, variables, name) or [np.empty(0)])


def number(
    file: str, variables: Variables, setting: str, value: str | float | None
) -> float | None:
    """A setting of the layout that is a number, or the name of a scalar variable.

    Raises:
        InputDataError: if the variable is missing, not scalar, or not a positive number.
    """
    if not isinstance(value, str):
        return value
    found = entries(file, variables, value)
    if found.size != 1 or not 0.0 < found[0] < math.inf:
        raise InputDataError(
            f"{file}: variable '{value}' ({setting}) is {_shape(variables[value])} {found[:4]!s}; "
            "expected one "
            f"positive number. Write {setting}=<number> into --layout instead."
        )
    return float(found[0])


def curves(path: Path, variables: Variables, layout: Layout) -> list[RawCurve]:
    """The curves of the file, in the units of the file.

    Raises:
        InputDataError: if a variable is missing or unusable, or counts or lengths of times and
            radii differ.
    """
    file = str(path)
    radii = vectors(file, variables, layout.radius)
    times = [None] * len(radii) if layout.time is None else vectors(file, variables, layout.time)
    if len(times) == 1:
        times = times * len(radii)
    if len(times) != len(radii):
        raise InputDataError(
            f"{file}: '{layout.time}' holds {len(times)} vectors and '{layout.radius}' "
            f"{len(radii)}; expected one "
            "vector of times for each curve, or one for all."
        )
    out = []
    for i, (time, radius) in enumerate(zip(times, radii, strict=True)):
        name = path.stem if len(radii) == 1 else f"{path.stem}_{i + 1:02d}"
        if time is not None and len(time) != len(radius):
            raise InputDataError(
                f"{file}: curve {i + 1}: '{layout.time}' has {len(time)} samples and "
                f"'{layout.radius}' {len(radius)}; "
                "give one time for every radius."
            )
        out.append(RawCurve(file, name, time, radius, np.arange(1, len(radius) + 1)))
    return out


def max_radii(
    file: str,
    variables: Variables,
    layout: Layout,
    raw: list[RawCurve],
    frame_interval: float | None,
) -> tuple[list[float | None], list[str]]:
    """The maximum radius of each curve, in the unit of the file, and notes on how it was chosen.

    Args:
        file: file name for messages.
        variables: variables of the file.
        layout: what they mean; ``max_radius`` and ``max_radius_entries`` matter here.
        raw: the curves.
        frame_interval: time between frames in s, if known.

    Raises:
        InputDataError: if the entries cannot be assigned to the curves in exactly one way.
    """
    if not isinstance(layout.max_radius, str):
        return [layout.max_radius] * len(raw), []
    found = entries(file, variables, layout.max_radius)
    if layout.max_radius_entries is not None:
        return [float(x) for x in _named_entries(file, layout, found, len(raw))], []
    if len(found) == 1:
        return [float(found[0])] * len(raw), []
    if len(found) == len(raw):
        return [float(x) for x in found], []
    if len(found) < len(raw):
        raise InputDataError(
            f"{file}: variable '{layout.max_radius}' has {len(found)} entries for {len(raw)} "
            "curves; one entry for "
            "each curve is needed: add the missing ones, or give max_radius as a number."
        )
    choice, note = _choose(file, layout, found, raw, frame_interval)
    return [float(found[i]) for i in choice], [note]


def _named_entries(file: str, layout: Layout, found: np.ndarray, n_curves: int) -> np.ndarray:
    named = layout.max_radius_entries or ()
    if len(named) != n_curves or max(named) > len(found):
        raise InputDataError(
            f"{file}: max_radius_entries={named} for {n_curves} curves and {len(found)} entries of "
            f"'{layout.max_radius}'; give one entry number (from 1 to {len(found)}) for each curve."
        )
    return found[np.array(named) - 1]


def _choose(
    file: str, layout: Layout, found: np.ndarray, raw: list[RawCurve], frame_interval: float | None
) -> tuple[tuple[int, ...], str]:
    """The one order-preserving choice of entries under which all curves have the same frame
    spacing.
    """
    counts = (
        f"{file}: variable '{layout.max_radius}' has {len(found)} entries for {len(raw)} curves"
    )
    numbers = "+".join(str(i + 1) for i in range(len(raw)))
    by_hand = f"max_radius_entries={numbers} in --layout (entry numbers from 1, one for each curve)"
    if layout.time_unit != "dimensionless":
        raise InputDataError(f"{counts}; say which belong to them with {by_hand}.")
    spacing = np.array([_median_step(curve) for curve in raw])
    implied = (
        spacing[:, None]
        * found
        * layout.length_factor(layout.max_radius_unit)
        * layout.time_per_length
    )
    if math.comb(len(found), len(raw)) > MAX_CHOICES:
        raise InputDataError(
            f"{counts}, too many choices to try; say which belong to them with {by_hand}."
        )
    choices = itertools.combinations(range(len(found)), len(raw))
    fitting = [c for c in choices if _agrees(implied[range(len(raw)), c], frame_interval)]
    if len(fitting) == 1:
        chosen = fitting[0]
        listed = ", ".join(f"{implied[k, i]:.4g}" for k, i in enumerate(chosen))
        how = (
            "they match the frame interval given"
            if frame_interval
            else "no other choice makes them equal"
        )
        return chosen, (
            f"{counts}: entries {', '.join(str(i + 1) for i in chosen)} are used, in order; the "
            "frame spacings they "
            f"imply are {listed} s, and {how}. Name them with max_radius_entries to override this."
        )
    table = "; ".join(
        f"curve {k + 1}: " + ", ".join(f"{x:.4g}" for x in row) for k, row in enumerate(implied)
    )
    why = f"{len(fitting)} choices fit" if fitting else "no choice fits"
    target = (
        f" of {frame_interval:g} s (within 1 %)"
        if frame_interval
        else ", equal for all curves (within 0.2 %)"
    )
    raise InputDataError(
        f"{counts}, and {why} a frame spacing{target}. Give frame_interval=<seconds between "
        f"frames>, or {by_hand}. "
        f"Frame spacings in s implied by each entry: {table}."
    )


def _median_step(curve: RawCurve) -> float:
    assert curve.time is not None
    return float(np.nanmedian(np.diff(curve.time)))


def _agrees(spacings: np.ndarray, frame_interval: float | None) -> bool:
    if frame_interval is not None:
        return bool(np.all(np.abs(spacings / frame_interval - 1.0) <= SPACING_TOLERANCE))
    return bool(spacings.max() - spacings.min() <= COMMON_SPACING_TOLERANCE * spacings.mean())
