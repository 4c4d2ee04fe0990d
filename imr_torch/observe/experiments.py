"""Experiments: dimensionless curves, each with its own design and times, padded to one batch.

An :class:`Experiment` is one design shot once or several times. :class:`ExperimentBatch` pads all
of them to a common number of frames, so that any number of experiments is one tensor;
:func:`imr_torch.observe.predict` says what the camera would see.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from imr_torch.errors import InputDataError, ShapeError
from imr_torch.float64 import randn, tensor
from imr_torch.material import PARAMETERS
from imr_torch.observe.collapse import CollapseTime
from imr_torch.observe.noise import Noise, NoiseLaws, frame_bends, previous
from imr_torch.observe.nuisance import NUISANCES, Nuisance
from imr_torch.simulate import check_designs
from imr_torch.types import BatchFrames, ExperimentFrames, FrameMask, Frames, FrameValues

_pad = partial(pad_sequence, batch_first=True)


@dataclass(frozen=True, eq=False)
class Experiment:
    """Repeats of one design; kept in float64 on the CPU, where everything above the simulators
    computes.

    Args:
        label: name in reports.
        design: (We, R_inf*) as achieved and measured.
        times: dimensionless, from the maximum radius on.
        radius: R/Rmax; NaN where a repeat lacks a frame that another has.
        nuisance: what is uncertain about the design and the clock.
        exposure: known exposure of a frame over ``Rmax/U_c``, over which predictions are averaged;
            0 for an instant.
        noise_factor: noise of this experiment over the law of its batch.
        noise_factor_sd: standard deviation of its logarithm.
        weight: how often its log likelihood counts; below 1 for a shot that stands out from its set
            (:meth:`imr_torch.record.Record.weighted`).
        motion: how far the bubble moves from frame to frame, R*: the larger of what a fit says
            (:func:`imr_torch.assimilate.frame_motions`) and how much the curve bends
            (:func:`imr_torch.observe.noise.frame_bends`); the latter where there is no fit yet.

    >>> import torch
    >>> from imr_torch.observe import Experiment
    >>> times = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    >>> radius = torch.tensor([[1.0, 0.84, 0.31], [1.0, 0.86, float("nan")]], dtype=torch.float64)  # R/Rmax of two repeats
    >>> experiment = Experiment("shot 1", (400.0, 0.22), times, radius)
    >>> experiment.repeats, experiment.counts.tolist()
    (2, [2, 2, 1])
    """

    label: str
    design: tuple[float, float]
    times: FrameValues
    radius: Float[Tensor, "repeats frames"]
    nuisance: Nuisance = Nuisance()
    exposure: float = 0.0
    noise_factor: float = 1.0
    noise_factor_sd: float = 0.0
    weight: float = 1.0
    motion: FrameValues | None = None

    def __post_init__(self) -> None:
        for name in ("times", "radius"):
            object.__setattr__(self, name, getattr(self, name).to("cpu", torch.float64))
        if self.radius.ndim != 2 or self.times.shape != self.radius.shape[1:]:
            raise ShapeError(
                f"Experiment {self.label!r}: expected radius n_repeats x n_t and times n_t, "
                f"got {tuple(self.radius.shape)} and {tuple(self.times.shape)}."
            )
        if self.motion is not None and self.motion.shape != self.times.shape:
            raise ShapeError(
                f"Experiment {self.label!r}: expected the motion of {len(self.times)} frames, "
                f"got {tuple(self.motion.shape)}."
            )
        check_designs(tensor([self.design]))
        infinite = torch.isinf(self.radius).nonzero().tolist()
        if infinite:
            repeat, frame = infinite[0]
            raise InputDataError(
                f"Experiment {self.label!r}: radius of repeat {repeat}, frame {frame} is "
                f"{self.radius[repeat, frame]}; mark a missing frame by NaN."
            )
        longest = PARAMETERS["exposure_blur"].upper
        lost = (self.counts == 0).nonzero()[:, 0].tolist()
        rises = (self.times.diff() > 0.0).all() and self.times.isfinite().all()
        for wrong, text in (
            (self.repeats < 1, "has no repeat; give at least one row of radius"),
            (len(self.times) < 2, f"has {len(self.times)} frames; at least 2 are needed"),
            (lost, f"has frames {lost} that are NaN in every repeat; leave them out"),
            (not rises, "has times that are not finite or do not increase"),
            (
                not 0.0 <= self.exposure <= longest,
                f"has an exposure of {self.exposure:g} Rmax/U_c; expected 0 to {longest:g}",
            ),
            (
                not 0.0 < self.noise_factor < math.inf,
                f"has the noise_factor {self.noise_factor:g}; expected a factor above 0",
            ),
            (
                not 0.0 < self.weight <= 1.0,
                f"has the weight {self.weight:g}; expected one above 0, 1 at most",
            ),
        ):
            if wrong:
                raise InputDataError(f"Experiment {self.label!r} {text}.")

    @property
    def repeats(self) -> int:
        """Number of repeats."""
        return self.radius.shape[0]

    @cached_property
    def counts(self) -> Int[Tensor, "frames"]:
        """Repeats that have each frame."""
        return self.radius.isfinite().sum(0)

    @cached_property
    def mean(self) -> FrameValues:
        """Mean over the repeats that have each frame."""
        return self.radius.nanmean(0)

    @property
    def has_gaps(self) -> bool:
        """Whether a repeat lacks a frame that another has."""
        return bool((self.counts < self.repeats).any())

    def until(self, last: float) -> "Experiment":
        """The experiment cut off after the dimensionless time ``last``."""
        return self.at(self.times <= last)

    def at(self, frames: Bool[Tensor, "frames"]) -> "Experiment":
        """The experiment at some of its frames (``n_t`` boolean tensor)."""
        motion = None if self.motion is None else self.motion[frames]
        return replace(
            self, times=self.times[frames], radius=self.radius[:, frames], motion=motion
        )


@dataclass(frozen=True)
class Film:
    """Designs that are planned, and when the camera will see them; there are no data.

    Args:
        designs: (We, R_inf*).
        times: frame times, dimensionless, increasing.
        nuisance_sds: prior standard deviations of each design's nuisances, columns as in
            ``NUISANCES``; known exactly when not given.

    Raises:
        InputDataError: for a design that no bubble has.
        ShapeError: if designs, times and nuisances do not fit.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import Film, predict
    >>> film = Film(torch.tensor([[400.0, 0.22]]).double(), torch.tensor([[0.0, 0.5, 1.0]]).double())
    >>> seen = predict(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), film)
    >>> [round(x, 3) for x in seen[0].tolist()]
    [1.0, 0.846, 0.418]
    """

    designs: Float[Tensor, "experiments 2"]
    times: ExperimentFrames
    nuisance_sds: Float[Tensor, "experiments 3"] = None  # type: ignore[assignment]  # zeros

    def __post_init__(self) -> None:
        if self.nuisance_sds is None:
            object.__setattr__(
                self, "nuisance_sds", self.times.new_zeros(len(self.times), len(NUISANCES))
            )
        count = len(self.times)
        shapes = [tuple(x.shape) for x in (self.designs, self.times, self.nuisance_sds)]
        if (
            self.times.ndim != 2
            or shapes[0] != (count, 2)
            or shapes[2] != (count, len(NUISANCES))
        ):
            raise ShapeError(
                f"Film: expected designs E x 2, times E x T, nuisance_sds E x 3; got {shapes[0]}, "
                f"{shapes[1]} and {shapes[2]}."
            )
        check_designs(self.designs)

    @property
    def mask(self) -> FrameMask:
        """Frames that exist: all."""
        return torch.ones_like(self.times, dtype=torch.bool)


@dataclass(frozen=True)
class ExperimentBatch:
    """Experiments padded to ``E x T``.

    Args:
        experiments: the experiments: curves, and shots of which the collapse time alone is known
            (one frame, whose value is a time with an error of its own).
        noise: the law of the observation noise of curves.
        between: positive parameter -> standard deviation of its logarithm between experiments, each
            of which then has a value of its own: the deviations are nuisances, beside those of the
            experiments. All experiments have the same parameters where empty.
        noise_laws: what is known of the law where it was inferred; None where it is taken as known.

    >>> import torch
    >>> from imr_torch.observe import Experiment, ExperimentBatch
    >>> times = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    >>> radius = torch.tensor([[1.0, 0.84, 0.31]], dtype=torch.float64)
    >>> batch = ExperimentBatch((Experiment("shot 1", (400.0, 0.22), times, radius),))
    >>> round(float(batch.log_likelihood(radius)), 2), round(float(batch.log_likelihood(radius - 0.02)), 2)
    (12.38, -40.33)
    """

    experiments: tuple[Experiment | CollapseTime, ...]
    noise: Noise = Noise()
    between: Mapping[str, float] = field(default_factory=dict)
    noise_laws: NoiseLaws | None = None

    def __post_init__(self) -> None:
        if not self.experiments:
            raise InputDataError("At least one experiment is needed.")
        for name, scatter in self.between.items():
            PARAMETERS[name]
            if not 0.0 < scatter < math.inf:
                raise InputDataError(
                    f"ExperimentBatch.between: the scatter of {name} is {scatter}; it must be "
                    "positive and finite."
                )
        gaps = [e.label for e in self.experiments if e.has_gaps]
        if gaps and self.noise.correlation_time > 0.0:
            raise InputDataError(
                f"Experiment {gaps[0]!r}: a repeat lacks frames that another has, and "
                f"Noise.correlation_time is {self.noise.correlation_time:g}; leave these frames "
                "out of all repeats, or take 0."
            )

    @cached_property
    def curves(self) -> tuple[Experiment, ...]:
        """The experiments that are curves."""
        return tuple(e for e in self.experiments if isinstance(e, Experiment))

    @cached_property
    def collapse(self) -> Bool[Tensor, "experiments"]:
        """Experiments whose datum is a collapse time."""
        return torch.tensor([isinstance(e, CollapseTime) for e in self.experiments])

    @cached_property
    def _collapse_sds(self) -> Tensor:
        """Errors of collapse times; 1 for curves."""
        return tensor([[getattr(e, "whole_sd", 1.0)] for e in self.experiments])

    @cached_property
    def designs(self) -> Float[Tensor, "experiments 2"]:
        """``E x 2`` tensor, measured (We, R_inf*)."""
        return tensor([e.design for e in self.experiments])

    @cached_property
    def exposures(self) -> Float[Tensor, "experiments"]:
        """``E`` tensor, known exposure of a frame, dimensionless."""
        return tensor([e.exposure for e in self.experiments])

    @cached_property
    def noise_factors(self) -> Float[Tensor, "experiments 1"]:
        """``E x 1`` tensor: noise of each experiment over the law, by which its squares count as
        often as its weight says; 1 for collapse times.
        """
        return tensor([[e.noise_factor / math.sqrt(e.weight)] for e in self.experiments])

    @property
    def of_frames(self) -> "ExperimentBatch":
        """The same data with the noise of single frames, in shots of any weight, where fits were
        made with that of all that they leave.
        """
        shots = tuple(
            replace(e, weight=1.0) if isinstance(e, Experiment) else e
            for e in self.experiments
        )
        laws = self.noise_laws and self.noise_laws.frames
        noise = laws.laws[int(laws.weights.argmax())] if laws else self.noise.of_frames
        return replace(
            self, experiments=shots, noise=noise, noise_laws=laws or self.noise_laws
        )

    def log_noise_ratios(
        self,
        prediction: ExperimentFrames,
        count: int,
        *,
        generator: torch.Generator,
    ) -> Float[Tensor, "draws experiments frames"]:
        """Logarithms of noise drawn from what is known of it over that of :attr:`noise`.

        Zeros where that is taken as known.
        """
        laws = self.noise_laws
        if laws is None:
            return self.times.new_zeros(count, *self.times.shape)
        rows = torch.multinomial(laws.weights, count, replacement=True, generator=generator)
        scales = laws.log_scale_sds[rows] * randn(count, generator=generator)
        each = [
            law.sd(prediction, self.times, self.motions).log()
            for law in (self.noise, *laws.laws)
        ]
        logs = (torch.stack(each[1:]) - each[0])[rows] + scales[:, None, None]
        sds = tensor([e.noise_factor_sd for e in self.experiments])
        own = sds * randn(count, len(sds), generator=generator)
        return torch.where(self.mask, logs + own[..., None], 0.0)

    def noise_interval(self, prediction: ExperimentFrames) -> list[float]:
        """5, 50 and 95 % quantiles of the noise of the median single frame at a prediction, R*."""
        frames = self.of_frames
        level = frames.sd(prediction)[self.mask].median()
        logs = frames.log_noise_ratios(
            prediction, 1000, generator=torch.Generator().manual_seed(0)
        )
        means = logs[:, self.mask].mean(1)
        return [float(level * means.quantile(q).exp()) for q in (0.05, 0.5, 0.95)]

    @cached_property
    def mask(self) -> FrameMask:
        """Frames that exist."""
        kept = [torch.ones_like(e.times, dtype=torch.bool) for e in self.experiments]
        return _pad(kept)

    @cached_property
    def times(self) -> ExperimentFrames:
        """``E x T`` tensor, dimensionless; padding continues each row, so that rows increase."""
        times = _pad([e.times for e in self.experiments])
        tail = 1e-3 * torch.cumsum((~self.mask).to(times), dim=1)
        return torch.where(self.mask, times, times.amax(1, keepdim=True) + tail)

    @cached_property
    def mean(self) -> ExperimentFrames:
        """Mean over repeats; 0 in the padding."""
        return _pad([e.mean for e in self.experiments])

    @cached_property
    def motions(self) -> ExperimentFrames:
        """How far each bubble moves from frame to frame, R*; 0 in the padding."""
        return _pad(
            [
                frame_bends(e.mean) if e.motion is None else e.motion
                for e in self.experiments
            ]
        )

    @cached_property
    def counts(self) -> ExperimentFrames:
        """Repeats behind each frame of the mean; 1 in the padding."""
        counts = [e.counts.double() for e in self.experiments]
        return _pad(counts, padding_value=1.0)

    @cached_property
    def innovations(
        self,
    ) -> tuple[ExperimentFrames, ExperimentFrames]:
        """:meth:`Noise.innovations` of these frames."""
        return self.noise.innovations(self.times, self.mask)

    @cached_property
    def _repeat_scatter(self) -> tuple[Tensor, Tensor]:
        """Deviations of the repeats from their mean, squared, and times those of the frame before:
        two ``E x T`` tensors.
        """
        deviations = [(e.radius - e.mean).nan_to_num() for e in self.experiments]
        squares = [x.square().sum(0) for x in deviations]
        products = [(x * previous(x)).sum(0) for x in deviations]
        return _pad(squares), _pad(products)

    @cached_property
    def nuisance_sds(self) -> Float[Tensor, "experiments nuisances"]:
        """``E x w`` tensor of prior standard deviations.

        Columns as in ``NUISANCES``, then in ``between``.
        """
        own = tensor(list(self.between.values())).expand(len(self.experiments), -1)
        return torch.cat(
            (torch.stack([e.nuisance.sds() for e in self.experiments]), own), 1
        )

    def sd(self, prediction: BatchFrames) -> BatchFrames:
        """Noise of one repeat at a prediction ``... x E x T``; 1 in the padding."""
        noise = self.noise.sd(prediction, self.times, self.motions)
        sd = torch.where(self.collapse[:, None], self._collapse_sds, noise)
        return torch.where(self.mask, sd * self.noise_factors, 1.0)

    def whiten(
        self,
        values: Frames,
        sd: Frames,
    ) -> Frames:
        """Scale differences ``... x E x T`` so that the mean of the repeats has unit, independent
        noise.
        """
        scaled = torch.where(self.mask, values / sd, 0.0)
        own, before = self.innovations
        return (own * scaled - before * previous(scaled)) * self.counts.sqrt()

    def square(self, prediction: ExperimentFrames) -> float:
        """Whitened squared residual of a prediction; NaN where it is."""
        left = self.whiten(self.mean - prediction, self.sd(prediction))
        return float(left.square().sum())

    def terms(
        self,
        prediction: Frames,
        sd: Frames,
        innovations: tuple[Frames, Frames],
    ) -> tuple[Float[Tensor, "*#batch experiments"], Float[Tensor, "*#batch experiments"]]:
        """Squared misfit and normaliser of each experiment under any noise: two ``... x E``
        tensors, the second in nats.

        The log likelihood is minus half the first, minus the second; noise that is ``s`` times as
        large divides the first by ``s**2`` and adds ``log s`` for each observation (:attr:`sizes`)
        to the second.

        Args:
            prediction: ``... x E x T`` tensor.
            sd: noise of one repeat; 1 in the padding.
            innovations: as of :meth:`Noise.innovations`, ``... x E x T`` each.
        """
        own, before = innovations
        weight = torch.where(self.mask, 1.0 / sd, 0.0)
        misfit = weight * (self.mean - prediction)
        misfit = own * misfit - before * previous(misfit)
        counts = torch.where(self.mask, self.counts, 0.0)
        square = counts * misfit.square()
        normaliser = counts * ((sd / own).log() + 0.5 * math.log(2.0 * math.pi))
        if (
            max(e.repeats for e in self.experiments) > 1
        ):  # and their deviations from the mean
            squares, products = self._repeat_scatter
            last = before * previous(weight)
            weight = own * weight
            square = square + weight.square() * squares - 2.0 * weight * last * products
            square = square + last.square() * previous(squares)
        return square.sum(-1), self.weights * normaliser.sum(-1)

    @cached_property
    def weights(self) -> Float[Tensor, "experiments"]:
        """``E`` tensor: how often the log likelihood of each experiment counts."""
        return tensor([e.weight for e in self.experiments])

    @cached_property
    def sizes(self) -> Float[Tensor, "experiments"]:
        """Observations of each experiment, all repeats and frames, as often as it counts."""
        return self.weights * torch.where(self.mask, self.counts, 0.0).sum(-1)

    def log_likelihood(
        self, prediction: BatchFrames
    ) -> Float[Tensor, "*batch experiments"]:
        """Log density of all repeats and frames of each experiment; ``-inf`` for NaN."""
        square, normaliser = self.terms(prediction, self.sd(prediction), self.innovations)
        value = -0.5 * square - normaliser
        return torch.where(value.isnan(), -torch.inf, value)
