"""The parameter vector that all stages share: names, units, bounds and neutral values.

Each entry has a name, a unit, hard bounds and a *neutral value* at which it does nothing. A
constitutive model is a set of names; everything else stays neutral, so one batch may mix models.
Tensors of parameters have the shape ``batch_shape x p`` with ``p = len(PARAMETERS)``, in SI units,
in the order of registration. All entries of the package are in the tables below, whatever stage
gives them their meaning; users register their own.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Real
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.material.marginals import LogNormal, Marginal, TruncatedNormal
from imr_torch.types import BatchParameters, BroadcastValues
from imr_torch.units import Surroundings

Dimension = Literal["pressure", "viscosity", "time", "rate", "length", "drag", "ratio", "none"]


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

    def __post_init__(self) -> None:
        if not self.lower <= self.neutral <= self.upper:
            raise InputDataError(
                f"Parameter {self.name!r}: neutral value {self.neutral} lies outside its bounds "
                f"[{self.lower}, {self.upper}]."
            )

    @property
    def label(self) -> str:
        """``meaning (unit)`` in display units."""
        unit = self.display_unit or self.unit
        return f"{self.name} ({unit})" if unit not in ("", "1") else self.name

    def interval(self, low: float, middle: float, high: float) -> str:
        """A value with its 90 % interval, SI, as text in display units.

        >>> from imr_torch.material import PARAMETERS
        >>> PARAMETERS["G"].interval(8100.0, 8310.0, 8500.0)
        '8.31 kPa (90 %: 8.1 to 8.5)'
        """
        if self.dimension == "ratio":
            low, middle, high = map(math.exp, (low, middle, high))
            return f"{middle:.4g} times the stated one (90 %: {low:.4g} to {high:.4g})"
        unit = self.display_unit or self.unit
        shown = "" if unit in ("", "1") else f" {'µ' + unit[1:] if unit in ('us', 'um') else unit}"
        low, middle, high = (self.display_scale * x for x in (low, middle, high))
        return f"{middle:.4g}{shown} (90 %: {low:.4g} to {high:.4g})"


class ParameterVector:
    """The ordered register of parameters, and the layout of every parameter tensor.

    Attributes:
        size: number of parameters, the last dimension of every parameter tensor.
    """

    size: int = 0

    def __init__(self) -> None:
        self._entries: dict[str, Parameter] = {}
        self._columns: dict[str, int] = {}

    def register(self, parameter: Parameter) -> Parameter:
        """Append an entry; a second one of the same name must be identical."""
        known = self._entries.get(parameter.name)
        if known is not None and known != parameter:
            raise InputDataError(
                f"Parameter {parameter.name!r} is registered already with another definition: "
                f"{known}."
            )
        self._entries[parameter.name] = parameter
        self._columns = {name: column for column, name in enumerate(self._entries)}
        self.size = len(self._entries)
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
        for name in names:
            if name not in self._columns:
                self[name]  # names the parameters that are known
        return [self._columns[name] for name in names]

    def neutral(self, *batch_shape: int, dtype: torch.dtype = torch.float64) -> BatchParameters:
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

    def pack(self, values: Mapping[str, float | Real[Tensor, "*#batch"]]) -> BatchParameters:
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
            name: torch.as_tensor(value, dtype=None if isinstance(value, Tensor) else torch.float64)
            for name, value in values.items()
        }
        for name, column in columns.items():
            self.check(name, column)
        like = [x for x in values.values() if isinstance(x, Tensor) and x.is_floating_point()]
        like = next((x for x in like if x.ndim), torch.zeros((), dtype=torch.float64))
        shape = torch.broadcast_shapes(*(column.shape for column in columns.values()))
        rows = [
            columns.get(p.name, like.new_tensor(p.neutral)).to(like).expand(shape) for p in self
        ]
        return torch.stack(rows, -1)

    def check(self, name: str, value: Real[Tensor, "*batch"]) -> None:
        """Raise :class:`InputDataError` where a value is not finite or outside the bounds of
        ``name``.
        """
        entry = self[name]
        bad = ~((value >= entry.lower) & (value <= entry.upper))
        if bool(bad.any()):
            worst = float(value[bad].flatten()[0])
            raise InputDataError(
                f"Parameter {name!r} is {worst:g} {entry.unit}; expected a value in "
                f"[{entry.lower:g}, {entry.upper:g}] {entry.unit} ({entry.meaning}). Parameters "
                "are given in SI units."
            )


_QUOTED: dict[Dimension, tuple[str, float, str]] = {
    "pressure": ("Pa", 1e-3, "kPa"),
    "viscosity": ("Pa s", 1.0, ""),
    "time": ("s", 1e6, "us"),
    "rate": ("1/s", 1e-3, "1/ms"),
    "length": ("m", 1e6, "um"),
    "drag": ("Pa s/m^2", 1e-6, "MPa s/m^2"),
    "ratio": ("1", 1.0, ""),
    "none": ("1", 1.0, ""),
}
"""Dimension -> SI unit, and the factor to the unit in which people quote it."""


def _make_entry(
    name: str,
    meaning: str,
    lower: float,
    upper: float,
    dimension: Dimension = "none",
    prior: Marginal | None = None,
    neutral: float = 0.0,
) -> Parameter:
    """An entry that is neutral at 0, or does nothing by itself whatever its value; of one without a
    prior nothing is believed but as an effect.
    """
    unit, scale, quoted = _QUOTED[dimension]
    return Parameter(name, meaning, unit, dimension, lower, upper, neutral, scale, quoted, prior)


def _make_modulus(name: str, meaning: str) -> Parameter:
    """A shear modulus, within 1-25 kPa at 68 %."""
    return _make_entry(name, meaning, 0.0, 1e7, "pressure", LogNormal(median=5e3, factor=5.0))


def _make_shape(name: str, meaning: str, lower: float, upper: float, sd: float) -> Parameter:
    """A number that is most likely small and not negative."""
    prior = TruncatedNormal(0.0, sd, lower=0.0, upper=min(upper, 100.0 * sd))
    return _make_entry(name, meaning, lower, upper, prior=prior)


def _make_time(name: str, meaning: str) -> Parameter:
    """A time from 0 (neutral) to a second, within 2-50 us at 68 %."""
    return _make_entry(name, meaning, 0.0, 1.0, "time", LogNormal(median=1e-5, factor=5.0))


PARAMETERS = ParameterVector()
"""The one parameter vector, with every registered parameter."""

for _entry in (
    # of constitutive models
    _make_modulus("G", "shear modulus"),
    _make_entry("mu", "viscosity", 0.0, 100.0, "viscosity", LogNormal(median=0.1, factor=3.0)),
    _make_entry(
        "alpha",
        "strain stiffening",
        -1.0,
        100.0,
        prior=TruncatedNormal(0.0, 0.5, lower=0.0),
    ),
    _make_modulus("G_lin", "shear modulus at small strain"),
    _make_shape("alpha_fung2", "stiffening, Fung to second order", -1.0, 100.0, 0.1),
    _make_shape("alpha_fung", "stiffening, exponential Fung", -1.0, 10.0, 0.02),
    _make_shape("thinning", "shear thinning 1 - n (Carreau)", 0.0, 1.0, 0.3),
    _make_time("shear_time", "time scale of shear thinning (Carreau)"),
    _make_time("tau", "relaxation time (Maxwell branch)"),
    _make_shape("retardation", "retardation over relaxation time", 0.0, 1.0, 0.3),
    _make_time("tau_sls", "relaxation time (standard linear solid)"),
    _make_time("tau_sns", "relaxation time (standard nonlinear solid)"),
    _make_time("tau_ucm", "relaxation time (upper-convected branch)"),
    # of parts that few models have
    _make_time("tau_giesekus", "relaxation time (Giesekus)"),
    _make_shape("mobility", "mobility factor (Giesekus)", 0.0, 1.0, 0.2),
    _make_time("tau_ptt", "relaxation time (Phan-Thien-Tanner)"),
    _make_shape("extensibility", "extensibility (Phan-Thien-Tanner)", 0.0, 1.0, 0.1),
    _make_shape("mooney", "share of the second invariant (Mooney-Rivlin)", 0.0, 1.0, 0.3),
    _make_shape("cubic", "stiffening, cubic (Yeoh)", 0.0, 10.0, 0.005),
    _make_shape("gent", "1/J, inverse limit of I1 - 3 (Gent)", 0.0, 1.0, 0.01),
    _make_shape("chain", "1/N, inverse segments of a chain (Arruda-Boyce)", 0.0, 0.9, 0.02),
    _make_entry(
        "ogden",
        "exponent less 2 (Ogden)",
        -1.5,
        18.0,
        prior=TruncatedNormal(0.0, 1.0, -1.5, 18.0),
    ),
    _make_shape("thinning_yasuda", "shear thinning 1 - n (Carreau-Yasuda)", 0.0, 1.0, 0.3),
    _make_entry(
        "yasuda",
        "exponent of the onset (Carreau-Yasuda)",
        0.3,
        5.0,
        neutral=2.0,
        prior=TruncatedNormal(2.0, 0.7, 0.3, 5.0),
    ),
    _make_shape("plateau", "viscosity at infinite shear rate over mu", 0.0, 1.0, 0.1),
    _make_time("cross_time", "time scale of shear thinning (Cross)"),
    _make_entry(
        "cross_exponent",
        "exponent (Cross)",
        0.3,
        3.0,
        neutral=1.0,
        prior=TruncatedNormal(0.8, 0.2, 0.3, 3.0),
    ),
    _make_time("eyring_time", "time scale of shear thinning (Powell-Eyring)"),
    _make_shape("power_thinning", "shear thinning 1 - n (power law)", -1.0, 0.95, 0.3),
    _make_entry(
        "reference_rate", "rate at which mu or G_frac holds", 1.0, 1e9, "rate", neutral=1e5
    ),
    _make_modulus("G_arm", "modulus of a Maxwell arm"),
    _make_time("tau_arm", "its relaxation time"),
    _make_modulus("G_arm_slow", "modulus of a second Maxwell arm"),
    _make_entry(
        "tau_arm_slow", "its relaxation time", 0.0, 1.0, "time", LogNormal(median=1e-4, factor=5.0)
    ),
    _make_modulus("G_frac", "modulus of a springpot at the reference rate"),
    _make_entry(
        "fractional",
        "order of a springpot",
        0.05,
        0.95,
        neutral=0.5,
        prior=TruncatedNormal(0.3, 0.2, 0.05, 0.95),
    ),
    # of the gel
    _make_entry("damage", "softening per unit of accumulated strain", 0.0, 10.0),
    _make_entry(
        "yield_stress",
        "yield stress",
        0.0,
        1e6,
        "pressure",
        TruncatedNormal(0.0, 3e3, lower=0.0),
    ),
    _make_entry("graded_modulus", "excess modulus at the wall", -1.0, 10.0),
    _make_entry("permanent_set", "part of the stretch that stays", -0.5, 0.5),
    _make_entry("healing", "rate at which damage heals", 0.0, 1e7, "rate"),
    _make_entry("viscous_damage", "loss of viscosity per unit of accumulated strain", 0.0, 10.0),
    _make_entry("law_stretch", "generic stress in lambda - 1, over p_inf", -1.0, 1.0),
    _make_entry("law_stretch_squared", "generic stress in (lambda - 1)^2, over p_inf", -1.0, 1.0),
    _make_entry("law_compression", "generic stress in lambda^-3 - 1, over p_inf", -1.0, 1.0),
    _make_entry("law_compression_steep", "generic stress in lambda^-6 - 1, over p_inf", -1.0, 1.0),
    _make_entry("law_velocity", "generic stress in U, over p_inf", -1.0, 1.0),
    _make_entry("law_velocity_squared", "generic stress in U|U|, over p_inf", -1.0, 1.0),
    _make_entry("law_rate_squared", "generic stress in (U/R)|U/R|, over p_inf", -1.0, 1.0),
    # of the bubble
    _make_entry("heat_exchange", "log factor of heat conduction in the bubble", -6.0, 6.0),
    _make_entry("vapour_pressure", "vapour pressure beyond saturation, over p_inf", -0.03, 0.5),
    _make_entry("condensation", "power with which trapped vapour follows compression", 0.0, 1.0),
    _make_entry("gas_loss", "share of gas lost per unit of strain below R_inf", 0.0, 5.0),
    _make_entry("sound_speed", "log factor of the sound speed", -3.0, 5.0),
    _make_entry(
        "compressibility", "share of the terms of second order in the Mach number", 0.0, 1.0
    ),
    _make_entry("surface_tension", "log factor of the surface tension at the wall", -3.0, 3.0),
    _make_entry("far_field_pressure", "far-field pressure beyond p_inf, over p_inf", -0.5, 0.5),
    _make_entry("wall", "strength of a mirror bubble, Rmax over twice the distance", -0.5, 0.5),
    _make_entry("energy_loss", "loss to shape modes near collapse, in U|U|", 0.0, 20.0),
    _make_entry("size_drag", "drag pressure over R U", 0.0, 1e10, "drag"),
    _make_entry("residual_velocity", "wall velocity at time zero over U_c", -1.0, 1.0),
    _make_entry("sound_field", "amplitude of a residual sound field over p_inf", -1.0, 1.0),
    _make_entry("sound_frequency", "log of its angular frequency, in U_c/Rmax", -4.0, 6.0),
    _make_entry("sound_phase", "its phase", -20.0, 20.0),
    _make_entry("pulse", "amplitude of a reflected pulse over p_inf", -3.0, 3.0),
    _make_entry("pulse_time", "when it arrives, in Rmax/U_c", -1.0, 20.0),
    _make_entry("pulse_width", "log of its width, in Rmax/U_c", -6.0, 3.0),
    _make_entry(
        "excess_gas", "log of the gas at time zero over that which rests at R_inf", -2.0, 2.0
    ),
    _make_entry(
        "hot_contents",
        "mean temperature of the contents at time zero over T_inf, less 1",
        -0.3,
        0.6,
    ),
    _make_entry(
        "rinf_drift", "relative rate at which the gas's rest radius grows", -1e5, 1e5, "rate"
    ),
    # of the medium
    _make_entry("density", "log of the medium's density over the stated one", -2.0, 2.0, "ratio"),
    _make_entry(
        "medium_tension",
        "log of the medium's surface tension over the stated one",
        -3.0,
        3.0,
        "ratio",
    ),
    _make_entry(
        "medium_pressure",
        "log of the medium's far-field pressure over the stated one",
        -2.0,
        2.0,
        "ratio",
    ),
    _make_entry(
        "medium_temperature",
        "log of the medium's temperature in K over the stated one",
        -0.2,
        0.2,
        "ratio",
    ),
    # of the camera
    _make_entry("missed_maximum", "true Rmax over the measured one, less 1", -0.2, 0.2),
    _make_entry("trigger_offset", "time of the first frame, in Rmax/U_c", -0.3, 0.3),
    _make_entry("rinf_bias", "true R_inf over the measured one, less 1", -0.5, 0.5),
    _make_entry("clock", "log of true over measured time at a fixed time scale", -0.3, 0.3),
    _make_entry("exposure_blur", "exposure, in Rmax/U_c", 0.0, 0.5),
    _make_entry("refraction", "relative error of R that grows with R*", -0.2, 0.2),
    _make_entry("edge_error", "measured less true radius", -2e-5, 2e-5, "length"),
):
    PARAMETERS.register(_entry)


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
        entry.name: column * factor[entry.dimension] if entry.dimension in factor else column
        for entry, column in zip(PARAMETERS, parameters.unbind(-1), strict=True)
    }
