"""Arrays of numbers from ``.npz`` files, whose declared sizes are checked before anything is read
into memory.
"""

import math
import zipfile
from collections.abc import Collection
from pathlib import Path

import numpy as np

from imr_torch.errors import InputDataError
from imr_torch.reading.content import LARGEST, Content

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def is_npz(path: Path, head: bytes) -> bool:
    """Whether a file is an ``.npz``."""
    return head.startswith(b"PK") and path.suffix.lower() == ".npz"


def read_npz(path: Path) -> list[Content]:
    """One curve, or one a row, in SI units."""
    arrays = read_arrays(path, ("time_s", "radius_m"))
    time = arrays["time_s"]
    radius = arrays["radius_m"]
    fits = time.ndim in (1, radius.ndim) and time.shape[-1:] == radius.shape[-1:]
    if radius.ndim not in (1, 2) or not fits:
        raise InputDataError(
            f"{path}: time_s has shape {time.shape} and radius_m {radius.shape}; expected frames, "
            "or curves x frames, with one time for every radius. Sets of repeated designs "
            "(designs x repeats x frames) are read by imr-torch diagnose."
        )
    if time.ndim == 2 and len(time) != len(radius):
        raise InputDataError(
            f"{path}: time_s has {len(time)} curves and radius_m {len(radius)}; give one row of "
            "times each."
        )
    values = {name: x if x.ndim == 1 else list(x) for name, x in arrays.items()}
    return [Content(path, values)]


def read_arrays(path: str | Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Arrays of an ``.npz`` file as float64.

    Args:
        path: the file.
        names: arrays that it must hold.

    Raises:
        InputDataError: if the file is missing or no ``.npz``, lacks an array, or declares arrays
            that are no numbers, or larger than ``LARGEST`` together.

    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy
    >>> from imr_torch.reading.npz import read_arrays
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     numpy.savez(Path(folder) / "gel.npz", time_s=[0.0, 1e-6])
    ...     read_arrays(Path(folder) / "gel.npz", ["time_s"])["time_s"].shape
    (2,)
    """
    path = Path(path)
    if not path.is_file():
        raise InputDataError(
            f"{path}: no such file; check the name and the folder ({path.parent.resolve()})."
        )
    try:
        with zipfile.ZipFile(path) as archive:
            held = {
                name.removesuffix(".npy"): name
                for name in archive.namelist()
                if name.endswith(".npy")
            }
            missing = [name for name in names if name not in held]
            if missing:
                raise InputDataError(
                    f"{path}: no array {missing[0]!r}; expected {', '.join(names)}, got "
                    f"{', '.join(held) or 'none'}."
                )
            _check_sizes(path, archive, {name: held[name] for name in names})
            arrays = {}
            for name in names:
                with archive.open(held[name]) as stream:
                    array = np.lib.format.read_array(stream, allow_pickle=False)
                    arrays[name] = np.asarray(array, dtype=np.float64)
            return arrays
    except InputDataError:
        raise
    except Exception as error:  # zipfile and NumPy each raise their own kinds on damaged files
        raise InputDataError(
            f"{path}: cannot be read as .npz arrays of numbers ({error}); write it with "
            "numpy.savez."
        ) from error


def _check_sizes(path: Path, archive: zipfile.ZipFile, members: dict[str, str]) -> None:
    """Refuse arrays by what their headers declare, and by what their members unpack to."""
    total = 0
    for name, member in members.items():
        with archive.open(member) as stream:
            version = np.lib.format.read_magic(stream)
            if version not in _HEADERS:
                raise InputDataError(
                    f"{path}: array {name!r} is of .npy version {version}; write it with "
                    "numpy.savez."
                )
            shape, _, dtype = _HEADERS[version](stream)
        if dtype.kind not in "fiub":
            raise ValueError(f"array {name!r} holds {dtype}, not real numbers")
        declared = math.prod(shape) * max(dtype.itemsize, 8)
        total += max(declared, archive.getinfo(member).file_size)
        if total > LARGEST:
            raise InputDataError(
                f"{path}: array {name!r} of shape {shape} takes the file to {total / 2**30:.3g} "
                f"GiB, more than {LARGEST / 2**30:.3g} GiB; it is damaged, or must be divided into "
                "several files."
            )
