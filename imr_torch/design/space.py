"""The designs a laboratory can shoot: a box in (We, R_inf*), perhaps with settings, and the scatter
of achieved designs.

Nozzles, lenses and laser energies come in steps: either axis can be a list of settings, or the
whole space a list of designs. What is asked for is not what is achieved; ``scatter`` says by how
much, and the search then looks for the design that is most informative on average over what is then
achieved.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import torch
from jaxtyping import Float, Real
from torch import Tensor

from imr_torch.errors import InputDataError, ShapeError
from imr_torch.units import Surroundings

DESIGN_NAMES = ("We", "R_inf*")
"""The two numbers of a design, in the order of tensors of designs."""


@dataclass(frozen=True)
class DesignSpace:
    """A box of designs, or what of it a laboratory can set.

    Args:
        weber: smallest and largest We; it fixes Rmax.
        rest_radius: smallest and largest R_inf* = R_inf/Rmax.
        weber_settings: values of We that can be asked for; any in the box when empty.
        rest_radius_settings: the same for R_inf*.
        designs: whole designs that can be asked for, in place of settings.
        scatter: relative standard deviations of the achieved We and R_inf* about what was asked
            (log-normal); what is achieved is measured.

    >>> from imr_torch.design import DesignSpace
    >>> space = DesignSpace(weber=(150.0, 600.0), weber_settings=(200.0, 400.0))
    >>> space.bounds.tolist(), space.fixed_features
    ([[150.0, 0.14], [600.0, 0.3]], [{0: 200.0}, {0: 400.0}])
    """

    weber: tuple[float, float] = (100.0, 1000.0)
    rest_radius: tuple[float, float] = (0.14, 0.30)
    weber_settings: tuple[float, ...] = ()
    rest_radius_settings: tuple[float, ...] = ()
    designs: tuple[tuple[float, float], ...] = ()
    scatter: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name, (low, high), top in (
            ("weber", self.weber, 1e5),
            ("rest_radius", self.rest_radius, 1.0),
        ):
            if not 0.0 < low < high < top:
                raise InputDataError(
                    f"DesignSpace.{name} is ({low}, {high}); expected 0 < lower < upper < {top:g}."
                )
        for name, settings, (low, high) in (
            ("weber_settings", self.weber_settings, self.weber),
            ("rest_radius_settings", self.rest_radius_settings, self.rest_radius),
        ):
            if len(set(settings)) != len(settings) or not all(
                low <= value <= high for value in settings
            ):
                raise InputDataError(
                    f"DesignSpace.{name} is {settings}; expected different values within [{low}, "
                    f"{high}]."
                )
        if self.designs:
            if self.weber_settings or self.rest_radius_settings:
                raise InputDataError(
                    "DesignSpace takes a list of designs or settings of each axis, not both."
                )
            if len(set(self.designs)) != len(self.designs):
                raise InputDataError(f"DesignSpace.designs names a design twice: {self.designs}.")
            self.check(torch.tensor(self.designs, dtype=torch.float64))
        if len(self.scatter) != 2 or not all(0.0 <= s < 1.0 for s in self.scatter):
            raise InputDataError(
                f"DesignSpace.scatter is {self.scatter}; expected two relative standard "
                "deviations in [0, 1)."
            )

    @property
    def bounds(self) -> Float[Tensor, "2 2"]:
        """``2 x 2`` tensor, lower row and upper row, in BoTorch's layout."""
        return torch.tensor([self.weber, self.rest_radius], dtype=torch.float64).T.contiguous()

    @cached_property
    def choices(self) -> Float[Tensor, "designs 2"] | None:
        """``n x 2`` tensor of all designs that can be asked for; None when there is a continuum."""
        listed = self.designs or tuple(product(self.weber_settings, self.rest_radius_settings))
        return torch.tensor(listed, dtype=torch.float64) if listed else None

    @property
    def fixed_features(self) -> list[dict[int, float]]:
        """One entry per setting of the axis that has settings while the other has none, in
        BoTorch's form.
        """
        if self.choices is not None:
            return []
        axis, settings = (
            (0, self.weber_settings) if self.weber_settings else (1, self.rest_radius_settings)
        )
        return [{axis: value} for value in settings]

    def check(self, X: Real[Tensor, "*batch 2"]) -> None:
        """Raise unless every design of ``X`` (``... x 2``) lies in the box; achieved designs need
        not be settings.

        Raises:
            ShapeError: if the last dimension is not 2.
            InputDataError: naming the first design outside.
        """
        if X.shape[-1:] != (2,):
            raise ShapeError(f"X has shape {tuple(X.shape)}; expected ... x 2 with {DESIGN_NAMES}.")
        slack = 1e-9 * (self.bounds[1] - self.bounds[0])
        inside = ((self.bounds[0] - slack <= X) & (self.bounds[1] + slack >= X)).all(-1)
        if not bool(inside.all()):
            row = X[~inside][0].tolist()
            raise InputDataError(
                f"Design (We, R_inf*) = ({row[0]:g}, {row[1]:g}) is outside We {list(self.weber)}, "
                f"R_inf* {list(self.rest_radius)}; shoot inside, or widen the DesignSpace."
            )

    def settle(self, X: Real[Tensor, "designs 2"]) -> Real[Tensor, "designs 2"]:
        """The nearest designs that can be asked for, ``n x 2``.

        Of a list, each only once until all are taken.
        """
        scale = self.bounds[1] - self.bounds[0]
        if self.choices is not None:
            distance = ((X[:, None] - self.choices) / scale).norm(dim=-1)
            taken = torch.zeros(len(self.choices), dtype=torch.float64)
            rows = []
            for row in distance:
                rows.append(
                    int((row + math.sqrt(8.0) * taken).argmin())
                )  # farther than any two designs of the box are
                taken[rows[-1]] += 1.0
            return self.choices[rows]
        settled = X.clone()
        for axis, settings in enumerate((self.weber_settings, self.rest_radius_settings)):
            if settings:
                values = torch.tensor(settings, dtype=X.dtype)
                settled[:, axis] = values[(X[:, axis : axis + 1] - values).abs().argmin(1)]
        return settled

    def describe(self, design: Real[Tensor, "2"], surroundings: Surroundings) -> str:
        """A design in laboratory units."""
        radius = float(surroundings.max_radius(design[0]))
        return (
            f"We = {float(design[0]):.0f}, R_inf* = {float(design[1]):.3f} "
            f"(Rmax = {1e6 * radius:.0f} um, R_inf = {1e6 * radius * float(design[1]):.0f} um)"
        )
