"""Which entries of the catalogue change R(t) alike, once the usual parameters have been fitted, and
what tells them apart.

Each entry changes the curves of one base gel at three designs. What G, mu and each curve's Rmax, time zero and R_inf,
within their prior, can absorb to first order is projected out, as a diagnosis does (imr_torch.goodness.linear). The angle
between two remaining changes says how alike they are: after the best match, the sine of the angle is left of one.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from imr_torch.material import PARAMETERS
from imr_torch.observe import Film, predict
from imr_torch.simulate import ACCURACIES, TransportSimulator

BASE = {"G": 5000.0, "mu": 0.1}
DESIGNS = ((250.0, 0.17), (450.0, 0.20), (750.0, 0.24))
TIMES = torch.linspace(0.02, 3.0, 150, dtype=torch.float64)
SIMULATOR = TransportSimulator(accuracy=ACCURACIES["default"], threads=1)
NOISE = 0.003
"""In R*, of every frame."""
NUISANCES = (0.01, 0.01, 0.03)
"""Prior standard deviations of Rmax (relative), time zero (in Rmax/U_c) and R_inf (relative)."""
_STEP = 1e-2  # of the fitted parameters, relative to their size or prior
_PHASES = (
    "before the first collapse",
    "at the first collapse",
    "in the first rebound",
    "at the second collapse",
    "later",
)
_NEAR = 0.08  # in Rmax/U_c, what counts as at a collapse


def film() -> Film:
    """The three planned experiments."""
    return Film(torch.tensor(DESIGNS, dtype=torch.float64), TIMES.expand(len(DESIGNS), -1))


def curves(rows: list[dict[str, float]], shifts: torch.Tensor | None = None) -> np.ndarray:
    """``K x E x T`` radii as filmed, of parameters given one dictionary a row; NaN where a solve
    failed.
    """
    parameters = torch.stack([PARAMETERS.pack(row) for row in rows])
    return predict(SIMULATOR, parameters, film(), shifts).numpy()


@dataclass(frozen=True)
class Likeness:
    """Another entry that looks alike: the angle between the changes in degrees, and where the rest
    is largest.
    """

    name: str
    angle: float
    where: str
    weber: float


class LookAlikes:
    """Changes of R(t) by name, compared with each other.

    Args:
        changes: name -> parameters of the changed gel, all of them.
    """

    def __init__(self, changes: dict[str, dict[str, float]]) -> None:
        self.base = curves([BASE])[0]
        self.free = len(DESIGNS) * len(NUISANCES)
        changed = curves(list(changes.values())) - self.base
        self.raw = {
            name: self._row(row)
            for name, row in zip(changes, changed, strict=True)
            if np.isfinite(row).all()
        }

    def _row(self, change: np.ndarray) -> np.ndarray:
        """A change of the curves over the noise, with zeros for the priors of the nuisances."""
        return np.concatenate((change.ravel() / NOISE, np.zeros(self.free)))

    @cached_property
    def fitted(self) -> np.ndarray:
        """``N x k`` orthonormal basis of what gel and nuisances absorb."""
        gel = (
            curves([{**BASE, name: value * (1.0 + _STEP)} for name, value in BASE.items()])
            - self.base
        )
        columns = [self._row(row) / _STEP for row in gel]
        for number in range(self.free):
            experiment, kind = divmod(number, len(NUISANCES))
            shift = torch.zeros(1, len(DESIGNS), len(NUISANCES), dtype=torch.float64)
            shift[0, experiment, kind] = _STEP * NUISANCES[kind]
            column = self._row(curves([BASE], shift)[0] - self.base) / _STEP
            column[len(column) - self.free + number] = -1.0
            columns.append(column)
        return np.linalg.qr(np.stack(columns, 1))[0]

    @cached_property
    def left(self) -> dict[str, np.ndarray]:
        """Name -> unit change that is left beside the fitted parameters; entries that are absorbed
        wholly are left out.
        """
        found = {}
        for name, row in self.raw.items():
            rest = row - self.fitted @ (self.fitted.T @ row)
            if np.linalg.norm(rest) > 1e-3 * np.linalg.norm(row):
                found[name] = rest / np.linalg.norm(rest)
        return found

    def absorbed(self, name: str) -> float:
        """Share of the change of ``name`` (of its norm) that gel and nuisances absorb."""
        row = self.raw[name]
        return float(np.linalg.norm(self.fitted.T @ row) / np.linalg.norm(row))

    def nearest(self, name: str, *, most: int = 4, within: float = 60.0) -> list[Likeness]:
        """The entries whose changes enclose the smallest angles with that of ``name``, up to
        ``within`` degrees.
        """
        if name not in self.left:
            return []
        own, found = self.left[name], []
        for other, row in self.left.items():
            cosine = float(own @ row)
            angle = float(np.degrees(np.arccos(min(1.0, abs(cosine)))))
            if other != name and angle <= within:
                found.append(Likeness(other, angle, *self._where(own - cosine * row)))
        return sorted(found, key=lambda one: one.angle)[:most]

    def _where(self, rest: np.ndarray) -> tuple[str, float]:
        """The phase of a bubble's life with most of what is left, and the Weber number of the
        design.
        """
        square = rest[: -self.free].reshape(self.base.shape) ** 2
        design = int(square.sum(1).argmax())
        phases = _phase(self.base[design])
        shares = [square[design][phases == number].sum() for number in range(len(_PHASES))]
        return _PHASES[int(np.argmax(shares))], DESIGNS[design][0]


def _phase(radius: np.ndarray) -> np.ndarray:
    """The phase of each frame, from the minima of the base curve."""
    times = TIMES.numpy()
    inner = (radius[1:-1] < radius[:-2]) & (radius[1:-1] <= radius[2:])
    first, second, *_ = [*times[1:-1][inner], times[-1], times[-1]]
    phase = np.where(times < first, 0, np.where(times < second, 2, 4))
    phase[np.abs(times - second) < _NEAR] = 3
    phase[np.abs(times - first) < _NEAR] = 1
    return phase
