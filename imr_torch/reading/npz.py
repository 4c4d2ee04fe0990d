"""Arrays of numbers from ``.npz`` files, whose sizes are checked before anything is read into
memory.
"""

from collections.abc import Collection
from pathlib import Path

import numpy as np

from imr_torch.errors import InputDataError
from imr_torch.reading.content import LARGEST, Content


def is_npz(path: Path, head: bytes) -> bool:
    """Whether a file is an ``.npz``."""
    return head.startswith(b"PK") and path.suffix.lower() == ".npz"


def read_npz(path: Path) -> list[Content]:
    """One curve, or one a row, in SI units."""
    arrays = read_arrays(path, ("time_s", "radius_m"))
    time = arrays["time_s"]
    radius = arrays["radius_m"]
    if radius.ndim not in (1, 2) or time.ndim not in (1, radius.ndim):
        raise InputDataError(
            f"{path}: time_s has shape {time.shape} and radius_m {radius.shape}; expected frames, "
            "or curves x frames, with one time for every radius. Sets of repeated designs "
            "(designs x repeats x frames) are read by imr-torch diagnose."
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
            that are no numbers, or take more than ``LARGEST`` together.

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
    arrays = {}
    try:
        with np.load(path, allow_pickle=False) as archive:
            missing = [name for name in names if name not in archive.files]
            if missing:
                raise InputDataError(
                    f"{path}: no array {missing[0]!r}; expected {', '.join(names)}, got "
                    f"{', '.join(archive.files) or 'none'}."
                )
            size = sum(archive.zip.getinfo(f"{name}.npy").file_size for name in names)
            if size > LARGEST:
                raise InputDataError(
                    f"{path}: its arrays take {size / 2**30:.3g} GiB, more than "
                    f"{LARGEST / 2**30:.3g} GiB; it is damaged, or must be divided into several "
                    "files."
                )
            for name in names:
                array = archive[name]
                if array.dtype.kind not in "fiub":
                    raise ValueError(f"array {name!r} holds {array.dtype}, not real numbers")
                arrays[name] = array.astype(np.float64)
    except InputDataError:
        raise
    except Exception as error:  # zipfile and NumPy each raise their own kinds on damaged files
        raise InputDataError(
            f"{path}: cannot be read as .npz arrays of numbers ({error}); write it with "
            "numpy.savez."
        ) from error
    return arrays
