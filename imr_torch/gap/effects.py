"""The effect library: every unmodelled effect that a diagnosis may name, as parameters with a neutral value and a prior.

An effect frees one or more entries of the parameter vector that the base model leaves neutral; where and how they act is
defined with them (:mod:`imr_torch.material`, :mod:`imr_torch.simulate.effects`, :mod:`imr_torch.observe.distortion`). Here
stand what a diagnosis adds: how large the effect may be, where to start looking, and what it is easily mistaken for.
A user adds an effect by registering its parameter and one :class:`Effect`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from imr_torch.errors import InputDataError
from imr_torch.material import PARAMETERS, LogNormal, Marginal, TruncatedNormal, material

Place = Literal["material", "gas", "liquid", "geometry", "driving", "measurement"]


@dataclass(frozen=True)
class Effect:
    """One effect.

    Args:
        name: what a diagnosis calls it.
        meaning: one phrase for reports.
        place: where it acts.
        priors: parameter -> prior; the first is the amplitude, neutral at zero, the others say what it looks like.
        starts: values of the parameters, in the order of ``priors``, from which fits start and at which scores are taken.
        confused: names of effects that it is easily mistaken for, and the measurement that tells them apart.
        group: effects of one group, the same to first order or shapes of one thing, are reported as one class.
    """

    name: str
    meaning: str
    place: Place
    priors: dict[str, Marginal]
    starts: tuple[tuple[float, ...], ...]
    confused: str = ""
    group: str = ""
    names: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.priors))
        for name in self.names:
            PARAMETERS[name]
        if PARAMETERS[self.names[0]].neutral != 0.0:
            raise InputDataError(f"Effect {self.name!r}: its amplitude {self.names[0]!r} must be neutral at zero.")
        if not self.starts or any(len(start) != len(self.names) for start in self.starts):
            raise InputDataError(f"Effect {self.name!r} needs starts of {len(self.names)} values each, got {self.starts}.")

    @property
    def family(self) -> str:
        """The class that it is reported with: its group, or itself."""
        return self.group or self.name

    def applies(self, base: str) -> bool:
        """Whether a base model leaves the effect's parameters neutral and has what the effect acts on."""
        present = set(material(base).names)
        needs = {"alpha": "G", "damage": "G", "graded_modulus": "G", "permanent_set": "G", "tau": "mu", "thinning": "mu"}
        needed = needs.get(self.names[0])
        return not present & set(self.names) and (needed is None or needed in present)


def _two_sided(sd: float, *, lower: float | None = None, upper: float | None = None) -> TruncatedNormal:
    return TruncatedNormal(0.0, sd, **_bounds(lower, upper))


def _one_sided(sd: float) -> TruncatedNormal:
    return TruncatedNormal(0.0, sd, lower=0.0)


def _bounds(lower: float | None, upper: float | None) -> dict[str, float]:
    return {key: value for key, value in (("lower", lower), ("upper", upper)) if value is not None}


def _simple(name: str, meaning: str, place: Place, sd: float, *, one_sided: bool = False, confused: str = "", **more) -> Effect:
    """An effect of one parameter: two starts on either side, or two sizes of a one-sided one."""
    parameter = more.pop("parameter", name)
    group = more.pop("group", "")
    prior = _one_sided(sd) if one_sided else _two_sided(sd, **more)
    starts = ((0.3 * sd,), (1.2 * sd,)) if one_sided else ((0.4 * sd,), (-0.4 * sd,))
    return Effect(name, meaning, place, {parameter: prior}, starts, confused, group)


LIBRARY: dict[str, Effect] = {}
"""Name -> effect."""


def register_effect(effect: Effect) -> Effect:
    """Add an effect to the library; its name must be new."""
    if effect.name in LIBRARY:
        raise InputDataError(f"An effect of the name {effect.name!r} is registered already.")
    LIBRARY[effect.name] = effect
    return effect


def library(names: Sequence[str] | None = None, *, without: Sequence[str] = (), base: str = "nhkv") -> tuple[Effect, ...]:
    """The effects of given names (all by default) that can be put on a base model.

    Raises:
        InputDataError: for an unknown name; the message lists the known ones.
    """
    for name in (*(names or ()), *without):
        if name not in LIBRARY:
            raise InputDataError(f"Unknown effect {name!r}; known are {', '.join(LIBRARY)}.")
    chosen = LIBRARY if names is None else dict.fromkeys(names)
    return tuple(LIBRARY[name] for name in chosen if name not in without and LIBRARY[name].applies(base))


for _effect in (
    _simple(
        "strain_stiffening",
        "stress rises faster than the neo-Hookean with stretch",
        "material",
        0.5,
        one_sided=True,
        parameter="alpha",
        confused="shear modulus; another stretch 1/R_inf* tells",
    ),
    _simple(
        "stress_relaxation",
        "viscous stress relaxes within microseconds",
        "material",
        2e-6,
        one_sided=True,
        parameter="tau",
        confused="viscosity, shear thinning; another We (time scale) tells",
    ),
    Effect(
        "shear_thinning",
        "viscosity falls with the shear rate",
        "material",
        {"thinning": TruncatedNormal(0.0, 0.3, lower=0.0, upper=1.0), "shear_time": LogNormal(1e-5, 5.0)},
        ((0.15, 1e-5), (0.4, 1e-5)),
        "viscosity, relaxation; another We tells",
    ),
    _simple(
        "damage",
        "the gel softens with accumulated strain",
        "material",
        0.1,
        one_sided=True,
        confused="rest radius, stiffening; the second collapse tells",
    ),
    _simple("yield_stress", "the gel flows only above a stress", "material", 3e3, one_sided=True, confused="viscosity"),
    _simple("graded_modulus", "the modulus near the bubble differs", "material", 0.5, lower=-1.0, confused="shear modulus"),
    _simple("permanent_set", "growth has stretched the gel for good", "material", 0.02, confused="rest radius"),
    _simple("heat_exchange", "more or less heat crosses the bubble's wall", "gas", 1.0, confused="sound speed, viscosity"),
    _simple(
        "vapour_pressure",
        "vapour pressure off its saturation value",
        "gas",
        0.05,
        lower=-0.03,
        confused="shear modulus, far-field pressure, clock",
    ),
    _simple("condensation", "vapour is trapped by the collapse", "gas", 0.2, one_sided=True, confused="rest radius, heat"),
    _simple("gas_loss", "gas is lost at collapse", "gas", 0.2, one_sided=True, confused="heat, sound speed"),
    _simple("sound_speed", "the speed of sound differs", "liquid", 0.7, confused="heat exchange"),
    _simple(
        "surface_tension",
        "surface tension differs",
        "liquid",
        0.5,
        confused="anything: it is practically undetectable at these sizes",
    ),
    _simple("far_field_pressure", "pressure afar is not p_inf", "liquid", 0.015, confused="vapour pressure, clock"),
    _simple("wall", "a wall or another bubble is near", "liquid", 0.1, confused="shear modulus, damage"),
    _simple(
        "energy_loss",
        "energy goes into non-spherical modes at collapse",
        "liquid",
        0.7,
        one_sided=True,
        confused="viscosity, sound speed",
    ),
    _simple(
        "residual_velocity",
        "the wall still moves at time zero",
        "driving",
        0.05,
        group="start",
        confused="trigger offset: the same to first order; frames before the maximum tell",
    ),
    Effect(
        "sound_field",
        "a sound field rings on",
        "driving",
        {
            "sound_field": TruncatedNormal(0.0, 0.05),
            "sound_frequency": TruncatedNormal(1.5, 0.7),
            "sound_phase": TruncatedNormal(0.0, 2.0),
        },
        tuple((0.03, w, p) for w in (0.7, 1.4, 2.1) for p in (0.0, 1.57, 3.14, 4.71)),
        "damage; a pulse is a sound field of another shape; a hydrophone tells",
        group="sound",
    ),
    Effect(
        "pulse",
        "a reflected pulse arrives",
        "driving",
        {
            "pulse": TruncatedNormal(0.0, 0.1),
            "pulse_time": TruncatedNormal(1.5, 1.0, lower=0.0),
            "pulse_width": TruncatedNormal(-1.5, 0.7),
        },
        tuple((a, t, -1.5) for a in (0.03, -0.03) for t in (0.5, 1.5, 2.5)),
        "damage; a sound field is a pulse of another shape; a hydrophone tells",
        group="sound",
    ),
    _simple(
        "missed_maximum", "the true maximum was missed", "measurement", 0.015, confused="trigger offset, residual velocity"
    ),
    _simple(
        "trigger_offset",
        "the clock starts early or late",
        "measurement",
        0.025,
        group="start",
        confused="residual velocity: the same to first order; frames before the maximum tell",
    ),
    _simple("rinf_bias", "the rest radius is misread", "geometry", 0.05, confused="heat exchange, damage, viscosity"),
    _simple("clock", "frame rate or pixel size is off", "measurement", 0.025, confused="vapour pressure, shear modulus"),
    _simple(
        "exposure_blur", "frames average over their exposure", "measurement", 0.05, one_sided=True, confused="nothing alike"
    ),
    _simple("refraction", "the gel refracts: R is magnified as it grows", "measurement", 0.01, confused="missed maximum"),
):
    register_effect(_effect)
