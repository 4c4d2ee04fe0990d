"""Names and defaults that help texts and choices need, read from tables or written out, so that
PyTorch is not imported to print them.

A test compares each with the registry or setting that it is taken from.
"""

from imr_torch.files import read_table

_models = read_table("models")
MODELS = tuple(_models["models"])
"""Constitutive models."""

PARTS = "; ".join(
    ", ".join(name for name, part in _models["parts"].items() if part["kind"] == kind)
    for kind in ("elastic", "viscous", "memory")
)
"""Parts of composed models: elastic; viscous; memory."""

CASES = tuple(read_table("cases"))
"""Reference gels of the literature."""

MEDIA = tuple(read_table("media"))
"""Media whose properties are known."""

PHYSICS = ("polytropic", "transport")
RADIAL = (
    "rayleigh_plesset",
    "keller_miksis",
    "keller_miksis_enthalpy",
    "herring",
    "gilmore",
    "second_order",
)
LIQUIDS = ("constant_density", "tait", "noble_abel", "mie_gruneisen")
ENGINES = ("compiled", "torchdiffeq")
METHODS = ("map", "en4dvar")
EFFORTS = ("normal", "thorough")
TARGETS = ("parameters", "model", "both")
FORMATS = ("png", "pdf", "svg")

DEFAULT_MODELS = "newtonian,nhkv,gen_qkv"
COLLAPSES = 2
"""Collapses in the fitted window, if not said otherwise."""
SCATTER_SCALE = 0.3
EVALUATIONS = 25
EFFECTS_ADDED = 2
