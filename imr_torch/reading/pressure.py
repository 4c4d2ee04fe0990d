"""A measured pressure, such as the trace of a hydrophone, as driving of a bubble."""

from pathlib import Path

import numpy as np

from imr_torch.errors import InputDataError
from imr_torch.reading.layout import TIMES
from imr_torch.reading.names import read_heading
from imr_torch.reading.readers import read_contents
from imr_torch.simulate import TabulatedDriving

PRESSURES = {"pa": 1.0, "kpa": 1e3, "mpa": 1e6, "bar": 1e5, "atm": 101325.0}
"""Unit, in small letters -> Pa."""


def load_driving(path: str | Path) -> TabulatedDriving:
    r"""The pressure on top of the ambient one, from a file with columns of time and pressure.

    Args:
        path: a file of any container that curves are read from, with the units in its names, such
            as ``time (us),p (kPa)``. Time zero is the maximum radius of the bubble.

    Raises:
        InputDataError: for a column that is missing, twice there or without unit, and for samples
            that are no driving.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.reading import load_driving
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "p.csv").write_text("time (us),p (kPa)\n0,0\n10,-50\n20,0\n")
    ...     load_driving(Path(folder) / "p.csv").pressures
    (0.0, -50000.0, 0.0)
    """
    content = read_contents(Path(path))[0]
    columns = []
    for units, what, example in ((TIMES, "time", "time (us)"), (PRESSURES, "pressure", "p (kPa)")):
        found = {
            name: units[unit]
            for name in content.plain_vectors()
            if (unit := read_heading(name, content.units.get(name, ""), units).unit) is not None
        }
        if len(found) != 1:
            raise InputDataError(
                f"{path}: expected one column of {what} with its unit, such as '{example}', and "
                f"found {', '.join(found) or 'none'}. The file holds: {content.describe()}."
            )
        ((name, factor),) = found.items()
        columns.append(content.entries(name) * factor)
    times, pressures = columns
    kept = np.isfinite(times) & np.isfinite(pressures)
    try:
        return TabulatedDriving(tuple(times[kept].tolist()), tuple(pressures[kept].tolist()))
    except InputDataError as error:
        raise InputDataError(f"{path}: {error}") from None
