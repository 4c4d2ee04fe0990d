"""The designs that may be shot: a box in (We, R_inf*)."""

from dataclasses import dataclass

from jaxtyping import Float, Real
from torch import Tensor

from imr_torch.errors import InputDataError, ShapeError
from imr_torch.float64 import tensor
from imr_torch.types import Design
from imr_torch.units import Surroundings

DESIGN_NAMES = ("We", "R_inf*")
"""The two numbers of a design, in the order of tensors of designs."""


@dataclass(frozen=True)
class DesignSpace:
    """A box of designs.

    Args:
        weber: smallest and largest We; it fixes Rmax.
        rest_radius: smallest and largest R_inf* = R_inf/Rmax.

    >>> from imr_torch.design import DesignSpace
    >>> DesignSpace(weber=(150.0, 600.0)).bounds.tolist()
    [[150.0, 0.14], [600.0, 0.3]]
    """

    weber: tuple[float, float] = (100.0, 1000.0)
    rest_radius: tuple[float, float] = (0.14, 0.30)

    def __post_init__(self) -> None:
        for name, (low, high), top in (
            ("weber", self.weber, 1e5),
            ("rest_radius", self.rest_radius, 1.0),
        ):
            if not 0.0 < low < high < top:
                raise InputDataError(
                    f"DesignSpace.{name} is ({low}, {high}); expected 0 < lower < upper < {top:g}."
                )

    @property
    def bounds(self) -> Float[Tensor, "2 2"]:
        """``2 x 2`` tensor, lower row and upper row, in BoTorch's layout."""
        return tensor([self.weber, self.rest_radius]).T.contiguous()

    def check_inside(self, X: Real[Tensor, "*batch 2"]) -> None:
        """Raise unless every design of ``X`` (``... x 2``) lies in the box.

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

    def describe(self, design: Design, surroundings: Surroundings) -> str:
        """A design in laboratory units."""
        radius = float(surroundings.max_radius(design[0]))
        return (
            f"We = {float(design[0]):.0f}, R_inf* = {float(design[1]):.3f} "
            f"(Rmax = {1e6 * radius:.0f} um, R_inf = {1e6 * radius * float(design[1]):.0f} um)"
        )
