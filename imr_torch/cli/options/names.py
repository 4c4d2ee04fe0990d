"""Names and defaults that help texts and choices need, written out so that PyTorch is not imported
to print them.

A test compares each with the registry or setting that it is taken from.
"""

MODELS = (
    "newtonian",
    "nhe",
    "nhkv",
    "qkv",
    "gen_qkv",
    "linkv",
    "fung2",
    "fungexp",
    "maxwell",
    "zener",
    "sls",
    "sns",
    "ucm",
    "carreau",
)
"""Constitutive models."""

PARTS = (
    "neo_hookean, quadratic, fung2, fungexp, linear, mooney_rivlin, yeoh, gent, arruda_boyce, ogden; "
    "newtonian, carreau, carreau_yasuda, cross, powell_eyring, power_law, bingham, "
    "herschel_bulkley; jeffreys, maxwell, two_maxwell, springpot, sls, sns, ucm, "
    "giesekus, ptt"
)
"""Parts of composed models: elastic; viscous; memory."""

CASES = ("stiff-pa", "soft-pa")
"""Reference gels of the literature."""

MEDIA = (
    "water",
    "pbs",
    "agarose_0.5",
    "agarose_5",
    "gelatin_10",
    "polyacrylamide",
    "polyacrylamide_10",
    "peg8k_20",
    "peg8k_40",
    "peg8k_60",
    "peg8k_80",
)
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
