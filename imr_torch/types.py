"""Types that every stage shares.

Annotations name the axes of a tensor, ``Float[Tensor, "*batch experiments frames"]``: an axis has
one size throughout a call, ``*`` is any number of axes, ``#`` broadcasts, ``_`` is free;
``parameters`` is the parameter vector, ``controls`` the free parameters of one model, ``members``
the bubbles of a batch. ``pytest --check-shapes`` checks them in every call.

Shape words in docstrings follow BoTorch: ``batch_shape`` is any leading shape, ``q`` designs
considered together, ``p`` the length of the parameter vector, ``d`` the free parameters of one
model, ``E`` experiments, ``T`` or ``n_t`` frames.
"""

from jaxtyping import Bool, Float, Inexact, Int, Real
from torch import Tensor

# commands import imr_torch.progress itself, which loads no torch
from imr_torch.progress import Progress as Progress
from imr_torch.progress import ProgressLine as ProgressLine
from imr_torch.progress import report_progress as report_progress
from imr_torch.progress import within as within

Members = Inexact[Tensor, "*#batch"]
"""A number of each member of a batch, which may be complex."""

States = Inexact[Tensor, "states *#batch"]
"""The memory states of each member of a batch."""

BroadcastValues = Float[Tensor, "*#batch"]
"""Numbers that broadcast with the others of a call."""

Values = Float[Tensor, "*batch"]
"""A number of each member of a batch of any shape."""

ParameterVectors = Real[Tensor, "*#batch parameters"]
"""Parameter vectors, as a simulator takes them."""

DesignVectors = Real[Tensor, "*#batch 2"]
"""Designs ``(We, R_inf*)``, as a simulator takes them."""

Design = Real[Tensor, "2"]
"""One design ``(We, R_inf*)``."""

Designs = Real[Tensor, "designs 2"]
"""Designs ``(We, R_inf*)``, one a row."""

FrameTimes = Real[Tensor, "*#batch frames"]
"""Dimensionless times of frames, as a simulator takes them."""

BatchParameters = Float[Tensor, "*batch parameters"]
"""A batch of parameter vectors."""

BubbleValues = Float[Tensor, "members"]
"""A number of each bubble that is simulated."""

BubbleStates = Float[Tensor, "state members"]
"""The integrated state of each bubble that is simulated."""

BubbleFrames = Float[Tensor, "members frames"]
"""A number of each frame of each bubble that is simulated."""

FrameValues = Float[Tensor, "frames"]
"""A number of each frame of one experiment."""

Frames = Float[Tensor, "*#batch experiments frames"]
"""A number of each frame of each experiment, of each member of a batch that broadcasts."""

BatchFrames = Float[Tensor, "*batch experiments frames"]
"""A number of each frame of each experiment, of each member of a batch."""

ExperimentFrames = Float[Tensor, "experiments frames"]
"""A number of each frame of each experiment."""

FrameMask = Bool[Tensor, "experiments frames"]
"""Which frames of each experiment count."""

Controls = Float[Tensor, "controls"]
"""The free parameters of one model, or a number of each of them."""

ControlMatrix = Float[Tensor, "controls controls"]
"""A covariance of the free parameters of one model, its inverse or its Cholesky factor."""

BatchControls = Float[Tensor, "*batch controls"]
"""A batch of vectors of the free parameters of one model, as controls or in SI units."""

BatchControlMatrix = Float[Tensor, "*batch controls controls"]
"""A batch of matrices over the free parameters of one model."""

DrawnValues = Float[Tensor, "draws"]
"""A number of each draw, such as its weight or log density."""

DrawnControls = Float[Tensor, "draws controls"]
"""Draws of the free parameters of one model."""


Directions = Float[Tensor, "_ rows"]
"""Directions in the whitened data, one a row."""
DirectionsByName = dict[str, Directions]
"""Directions of each of several effects, or of other things that have a name."""

Coordinates = Float[Tensor, "coordinates"]
"""The free parameters of one model and the nuisances of its experiments, as one vector."""

CoordinateMatrix = Float[Tensor, "coordinates coordinates"]
"""A matrix over them: a covariance, its inverse or its Cholesky factor."""

BatchCoordinates = Float[Tensor, "*batch coordinates"]
"""A batch of such vectors."""

MemberCoordinates = Float[Tensor, "members coordinates"]
"""Such a vector of each member of an ensemble."""

Nuisances = Float[Tensor, "experiments nuisances"]
"""Nuisances of each experiment, or a number of each of them."""

BatchNuisances = Float[Tensor, "*batch experiments nuisances"]
"""The same of each member of a batch."""

LawValues = Float[Tensor, "laws"]
"""A number of each noise law."""

RowNumbers = Int[Tensor, "rows"]
"""Numbers of some rows, such as those of experiments."""

ColumnNumbers = Int[Tensor, "columns"]
"""Numbers of some columns."""

GelSlopes = Float[Tensor, "*batch experiments frames controls"]
"""Sensitivities of each frame to the controls."""

NuisanceSlopes = Float[Tensor, "*batch experiments frames nuisances"]
"""Sensitivities of each frame to the nuisances of its experiment."""

BundleFrames = Float[Tensor, "*batch bundle experiments frames"]
"""A number of each frame of each bubble of a bundle, of each member of a batch."""
