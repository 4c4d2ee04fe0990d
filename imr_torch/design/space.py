"""The designs that may be shot: a box in (We, R_inf*), or those of a list."""

from dataclasses import dataclass
from pathlib import Path

import torch
from botorch.utils.sampling import draw_sobol_samples
from jaxtyping import Float, Real
from torch import Tensor

from imr_torch.errors import InputDataError, ShapeError
from imr_torch.float64 import rand, tensor
from imr_torch.random import generator
from imr_torch.reading.load import read_contents
from imr_torch.types import Design, Designs, Values
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

    @property
    def listed(self) -> Designs | None:
        """The designs (``n x 2``) that alone can be set; None where all can."""
        return None

    def draw_design(self, *, seed: int) -> Design:
        """One of the designs, all equally probable."""
        low, high = self.bounds
        return torch.lerp(low, high, rand(2, generator=generator(seed)))

    def spread_designs(self, count: int, *, seed: int) -> Designs:
        """So many designs that leave no region out: the first of a scrambled Sobol sequence."""
        return draw_sobol_samples(self.bounds, n=count, q=1, seed=seed % 2**31)[:, 0]

    def cost(self, designs: Designs) -> Values:
        """Cost of a shot at each design (``n x 2``), ``n``, over that of an ordinary one."""
        return torch.ones_like(designs[:, 0])

    def check_inside(self, X: Real[Tensor, "*batch 2"]) -> None:
        """Raise unless every design of ``X`` (``... x 2``) lies in the box.

        Raises:
            ShapeError: if the last dimension is not 2.
            InputDataError: naming the first design outside.
        """
        if X.shape[-1:] != (2,):
            raise ShapeError(
                f"X has shape {tuple(X.shape)}; expected ... x 2 with {DESIGN_NAMES}."
            )
        slack = 1e-9 * (self.bounds[1] - self.bounds[0])
        inside = ((self.bounds[0] - slack <= X) & (self.bounds[1] + slack >= X)).all(-1)
        if not inside.all():
            row = X[~inside][0].tolist()
            raise InputDataError(
                f"Design (We, R_inf*) = ({row[0]:g}, {row[1]:g}) is outside We {list(self.weber)}, "
                f"R_inf* {list(self.rest_radius)}; shoot inside, or widen the DesignSpace."
            )

    def name_edges(self, design: Design) -> list[str]:
        """A sentence for each end of the space that a design lies at, beyond which a better one may
        be.

        >>> from imr_torch.design import DesignSpace
        >>> DesignSpace().name_edges(tensor([100.0, 0.2]))
        ['We is the smallest of 100 to 1000: what lies beyond may tell more, if it can be shot.']
        """
        low, high = self.bounds
        near = 0.01 * (high - low)
        return [
            f"{name} is the {end} of {float(low[i]):g} to {float(high[i]):g}: what lies beyond may "
            "tell more, if it can be shot."
            for i, name in enumerate(DESIGN_NAMES)
            for end, distance in (
                ("smallest", design[i] - low[i]),
                ("largest", high[i] - design[i]),
            )
            if distance < near[i]
        ]

    def describe(self, design: Design, surroundings: Surroundings) -> str:
        """A design in laboratory units."""
        radius = float(surroundings.max_radius(design[0]))
        return (
            f"We = {float(design[0]):.0f}, R_inf* = {float(design[1]):.3f} "
            f"(Rmax = {1e6 * radius:.0f} um, R_inf = {1e6 * radius * float(design[1]):.0f} um)"
        )


@dataclass(frozen=True)
class ListedDesigns(DesignSpace):
    """Designs that a laboratory can set, in a box that holds them.

    Args:
        rows: We, R_inf* and cost over that of an ordinary shot.

    >>> from imr_torch.design import ListedDesigns
    >>> ListedDesigns(rows=((200.0, 0.2, 1.0), (800.0, 0.2, 3.0))).listed[:, 0].tolist()
    [200.0, 800.0]
    """

    rows: tuple[tuple[float, float, float], ...] = ()

    @property
    def listed(self) -> Designs:
        """The designs (``n x 2``)."""
        return tensor(self.rows)[:, :2]

    def draw_design(self, *, seed: int) -> Design:
        """One of the list, all equally probable."""
        return self.spread_designs(1, seed=seed)[0]

    def spread_designs(self, count: int, *, seed: int) -> Designs:
        """So many of the list, or all: a random one, then always the farthest from those before."""
        unit = self.listed / self.bounds.diff(dim=0)
        order = [int(torch.randint(len(unit), (), generator=generator(seed)))]
        while len(order) < min(count, len(unit)):
            order.append(int(torch.cdist(unit, unit[order]).amin(1).argmax()))
        return self.listed[order]

    def name_edges(self, design: Design) -> list[str]:
        """None: nothing beyond the list can be set."""
        return []

    def cost(self, designs: Designs) -> Values:
        """Cost of a shot at each design (``n x 2``), as of the nearest that is listed."""
        nearest = torch.cdist(designs.log(), self.listed.log()).argmin(1)
        return tensor(self.rows)[nearest, 2]


def load_designs(path: str | Path) -> ListedDesigns:
    r"""Designs that can be set, from a table with columns ``we``, ``rinf`` and, optional, ``cost``.

    Args:
        path: the file; ``rinf`` is R_inf/Rmax, and without ``cost`` all shots cost the same.

    Raises:
        InputDataError: for a column that is missing, or a number that is no design or cost.

    >>> import tempfile
    >>> from imr_torch.design import load_designs
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "can.csv").write_text("we,rinf,cost\n200,0.2,1\n800,0.2,3\n")
    ...     load_designs(Path(folder) / "can.csv").rows
    ((200.0, 0.2, 1.0), (800.0, 0.2, 3.0))
    """
    content = read_contents(Path(path))[0]
    names = {name.strip().lower(): name for name in content.values}
    columns = []
    for what, top in (("we", 1e5), ("rinf", 0.999), ("cost", torch.inf)):
        if what in names:
            values = content.entries(names[what]).tolist()
        elif what == "cost":
            values = [1.0] * len(columns[0])
        else:
            raise InputDataError(
                f"{path}: no column {what!r}; expected we, rinf (R_inf/Rmax) and, optional, cost. "
                f"The file holds: {content.describe()}."
            )
        for row, value in enumerate(values):
            if not 0.0 < value < top:
                raise InputDataError(
                    f"{path}: row {content.lines(row)}, column {what!r} is {value:g}; expected a "
                    f"number above 0 and below {top:g}."
                )
        columns.append(values)
    rows = tuple(dict.fromkeys(zip(*columns, strict=True)))
    if len(rows) < 2:
        raise InputDataError(f"{path}: holds one design; list 2 or more to choose from.")
    weber, rest = ((0.99 * min(column), 1.001 * max(column)) for column in columns[:2])
    return ListedDesigns(weber, rest, rows)


def design_document(design: Design, surroundings: Surroundings) -> dict[str, float]:
    """A design (We, R_inf*), JSON-ready: dimensionless, and as sizes in m.

    >>> from imr_torch.units import Surroundings
    >>> round(design_document(tensor([400.0, 0.25]), Surroundings())["Rmax_m"], 6)
    0.000442
    """
    weber, rest = design.tolist()
    size = float(surroundings.max_radius(weber))
    return {"We": weber, "R_inf*": rest, "Rmax_m": size, "R_inf_m": rest * size}
