"""The parameter vector that all stages share: names, units, bounds and neutral values.

Each entry has a name, a unit, hard bounds and a *neutral value* at which it does nothing. A
constitutive model is a set of names; everything else stays neutral, so one batch may mix models.
Tensors of parameters have the shape ``batch_shape x p`` with ``p = len(PARAMETERS)``, in SI units,
in the order of registration. All entries of the package are in ``data/parameters.toml``, whatever
stage gives them their meaning; users register their own.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Real
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.files import Document, read_table
from imr_torch.material.marginals import MARGINALS, Marginal
from imr_torch.types import BatchParameters, BroadcastValues
from imr_torch.units import Surroundings

Dimension = Literal[
    "pressure", "viscosity", "time", "rate", "length", "drag", "ratio", "none"
]


@dataclass(frozen=True)
class Parameter:
    """One entry of the parameter vector.

    Args:
        name: key used everywhere, for example ``"G"``.
        meaning: one phrase for tables and axis labels.
        unit: SI unit as printed.
        dimension: which scale makes it dimensionless (see :func:`dimensionless`).
        lower: smallest admissible value (physics, not belief).
        upper: largest admissible value.
        neutral: value at which the entry does nothing, exactly.
        display_scale: factor from SI to ``display_unit``.
        display_unit: unit in which people quote it.
        prior: what is believed of it in a soft gel of which nothing is known, for models that infer
            it.

    >>> from imr_torch.material import PARAMETERS
    >>> PARAMETERS["mu"].meaning, PARAMETERS["mu"].unit, PARAMETERS["mu"].neutral
    ('viscosity', 'Pa s', 0.0)
    """

    name: str
    meaning: str
    unit: str
    dimension: Dimension
    lower: float
    upper: float
    neutral: float
    display_scale: float = 1.0
    display_unit: str = ""
    prior: Marginal | None = None
    symbol: str = ""

    def __post_init__(self) -> None:
        if not self.lower <= self.neutral <= self.upper:
            raise InputDataError(
                f"Parameter {self.name!r}: neutral value {self.neutral} lies outside its bounds "
                f"[{self.lower}, {self.upper}]."
            )

    @property
    def shown_unit(self) -> str:
        """The unit in which it is shown; empty for a number without one.

        >>> from imr_torch.material import PARAMETERS
        >>> PARAMETERS["G"].shown_unit, PARAMETERS["alpha"].shown_unit
        ('kPa', '')
        """
        unit = self.display_unit or self.unit
        return {"1": "", "us": "µs", "um": "µm"}.get(unit, unit)

    @property
    def label(self) -> str:
        r"""Symbol (the name where there is none) and unit, for an axis.

        >>> from imr_torch.material import PARAMETERS
        >>> PARAMETERS["G"].label, PARAMETERS["alpha"].label
        ('$G$ (kPa)', '$\\alpha$')
        """
        symbol = self.symbol or self.name
        return f"{symbol} ({self.shown_unit})" if self.shown_unit else symbol

    @property
    def export_name(self) -> str:
        """The name in tables that leave the package, which says where values are logarithms.

        >>> from imr_torch.material import PARAMETERS
        >>> PARAMETERS["G"].export_name, PARAMETERS["density"].export_name
        ('G', 'ln_density_ratio')
        """
        return f"ln_{self.name}_ratio" if self.dimension == "ratio" else self.name

    def interval(self, low: float, middle: float, high: float) -> str:
        """A value with its 90 % interval, SI, as text in display units.

        >>> from imr_torch.material import PARAMETERS
        >>> PARAMETERS["G"].interval(8100.0, 8310.0, 8500.0)
        '8.31 kPa (90 %: 8.1 to 8.5)'
        """
        if self.dimension == "ratio":
            low, middle, high = map(math.exp, (low, middle, high))
            return f"{middle:.4g} times that of the medium (90 %: {low:.4g} to {high:.4g})"
        low, middle, high = (self.display_scale * x for x in (low, middle, high))
        return (
            f"{middle:.4g} {self.shown_unit}".rstrip() + f" (90 %: {low:.4g} to {high:.4g})"
        )


class ParameterVector:
    """The ordered register of parameters, and the layout of every parameter tensor, whose last
    dimension is as long as this.
    """

    def __init__(self) -> None:
        self._entries: dict[str, Parameter] = {}

    def register(self, parameter: Parameter) -> Parameter:
        """Append an entry; a second one of the same name must be identical."""
        known = self._entries.get(parameter.name)
        if known is not None and known != parameter:
            raise InputDataError(
                f"Parameter {parameter.name!r} is registered already with another definition: "
                f"{known}."
            )
        self._entries[parameter.name] = parameter
        return parameter

    def __repr__(self) -> str:
        return f"ParameterVector of {', '.join(self._entries)}"

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self):
        return iter(self._entries.values())

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __getitem__(self, name: str) -> Parameter:
        try:
            return self._entries[name]
        except KeyError:
            raise InputDataError(
                f"Unknown parameter {name!r}; known are {', '.join(self._entries)}."
            ) from None

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of the tensor's last dimension."""
        return tuple(self._entries)

    def index(self, names: Sequence[str]) -> list[int]:
        """Columns of ``names`` in a parameter tensor."""
        order = self.names
        return [order.index(self[name].name) for name in names]

    def neutral(
        self, *batch_shape: int, dtype: torch.dtype = torch.float64
    ) -> BatchParameters:
        """A ``batch_shape x p`` tensor of neutral values: a bubble in an inviscid liquid without
        elasticity.
        """
        row = torch.tensor([p.neutral for p in self], dtype=dtype)
        return row.expand(*batch_shape, len(self)).clone()

    def acting(self, rows: Float[Tensor, "parameters members"]) -> frozenset[str]:
        """Names of the parameters (``rows``, ``p x B``, in SI or dimensionless) that are not
        neutral in some member.
        """
        neutral = self.neutral(dtype=rows.dtype).to(rows.device)
        moved = (rows != neutral[:, None]).any(1)
        return frozenset(
            name for name, acts in zip(self.names, moved.tolist(), strict=True) if acts
        )

    def pack(
        self, values: Mapping[str, float | Real[Tensor, "*#batch"]]
    ) -> BatchParameters:
        """Put named values into a parameter tensor; what is not named is neutral.

        Args:
            values: name -> number or tensor, SI units; tensors broadcast to a common
                ``batch_shape``.

        Returns:
            ``batch_shape x p`` tensor in the dtype and device of the given tensors (float64 for
            plain numbers).

        Raises:
            InputDataError: for an unknown name, or a value that is not finite or outside the
                parameter's bounds.
        """
        columns = {
            name: torch.as_tensor(
                value, dtype=None if isinstance(value, Tensor) else torch.float64
            )
            for name, value in values.items()
        }
        for name, column in columns.items():
            self.check(name, column)
        like = [
            x for x in values.values() if isinstance(x, Tensor) and x.is_floating_point()
        ]
        like = next((x for x in like if x.ndim), torch.zeros((), dtype=torch.float64))
        shape = np.broadcast_shapes(*(column.shape for column in columns.values()))
        rows = [
            columns.get(p.name, like.new_tensor(p.neutral)).to(like).expand(shape)
            for p in self
        ]
        return torch.stack(rows, -1)

    def check(self, name: str, value: Real[Tensor, "*batch"]) -> None:
        """Raise :class:`InputDataError` where a value is not finite or outside the bounds of
        ``name``.
        """
        entry = self[name]
        bad = ~((value >= entry.lower) & (value <= entry.upper))
        if bad.any():
            worst = float(value[bad].flatten()[0])
            raise InputDataError(
                f"Parameter {name!r} is {worst:g} {entry.unit}; expected a value in "
                f"[{entry.lower:g}, {entry.upper:g}] {entry.unit} ({entry.meaning}). Parameters "
                "are given in SI units."
            )


def _make_entry(name: str, row: Document) -> Parameter:
    """An entry by its row of the table, with the units of its dimension."""
    row = {"dimension": "none", "neutral": 0.0, **row}
    lower, upper = row.pop("bounds")
    kind, *numbers = row.pop("prior", (None,))
    prior = MARGINALS[kind](*numbers) if kind else None
    units = _DIMENSIONS[row["dimension"]]
    return Parameter(name, lower=lower, upper=upper, prior=prior, **row, **units)


_DIMENSIONS = read_table("dimensions")
PARAMETERS = ParameterVector()
"""The one parameter vector, with every registered parameter."""

for _name, _entry in read_table("parameters").items():
    PARAMETERS.register(_make_entry(_name, _entry))


def dimensionless(
    parameters: Float[Tensor, "*#batch parameters"],
    max_radius: BroadcastValues,
    surroundings: Surroundings,
) -> dict[str, BroadcastValues]:
    """The parameters of each bubble in dimensionless form.

    Args:
        parameters: SI.
        max_radius: m.
        surroundings: the liquid side.

    Returns:
        By name: moduli as ``1/Ca = G/p_inf``, viscosities as ``1/Re = mu U_c/(p_inf Rmax)``,
        times as ``De = tau U_c/Rmax`` (Estrada et al. 2018, section 2.3), rates and lengths over
        ``U_c/Rmax`` and ``Rmax``, drags as ``k Rmax U_c/p_inf``.

    >>> import torch
    >>> from imr_torch.material import PARAMETERS, dimensionless
    >>> from imr_torch.units import Surroundings
    >>> theta = dimensionless(PARAMETERS.pack({"G": 10132.5}), torch.tensor(200e-6), Surroundings())
    >>> round(float(theta["G"]), 3)  # 1/Ca = G/p_inf
    0.1
    """
    time = surroundings.time_scale(max_radius)
    pressure = surroundings.far_field_pressure
    factor = {
        "pressure": 1.0 / pressure,
        "viscosity": 1.0 / (pressure * time),
        "time": 1.0 / time,
        "rate": time,
        "length": 1.0 / max_radius,
        "drag": max_radius**2 / (pressure * time),
    }
    return {
        entry.name: column * factor[entry.dimension]
        if entry.dimension in factor
        else column
        for entry, column in zip(PARAMETERS, parameters.unbind(-1), strict=True)
    }
