"""One shot with an unknown pressure of its own: its bubble, and how its curve answers to a pressure
at each moment.

Whatever is missing in the equation of motion acts as a pressure ``w(t)`` at the bubble's wall. It is
represented by Gaussian pulses of equal width and spacing, which together make any smooth function;
the change of the curve by each pulse is its response (a Green's function of the trajectory). A
trajectory under a finite ``w`` is simulated with ``w`` as far-field driving of the opposite sign, so
responses can be taken about it again: nothing here is limited to small pressures.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate import Point, Posterior
from imr_torch.float64 import arange, ones, tensor
from imr_torch.material import (
    PARAMETERS,
    TERMS,
    Effect,
    ModelBelief,
    dimensionless,
    gel_response,
)
from imr_torch.observe import Experiment, ExperimentBatch, predict
from imr_torch.simulate import Simulator, TabulatedDriving
from imr_torch.types import Controls, FrameValues

Fine = Float[Tensor, "fine"]
"""A number at each of the fine times of a trajectory."""
ShapedEffects = Sequence[tuple[Effect, Sequence[float]]]
"""Effects, each with its parameters beside the strength."""
Pulses = Float[Tensor, "pulses"]
"""A pressure, or another number, of each pulse."""
SPACING = 0.04
"""Width and spacing of the pulses in t*: about a frame. Half of it changes the log evidence of two test sets by .2 and .7 nats,
and their pressures by .1 and .4 standard deviations (median)."""

USUAL_SIZE = 200e-6
"""Rmax in m to which sizes are referred."""

# pressure over p_inf at which responses are taken, in bubbles of the same steps
_STEP = 1e-4
_FINE = 0.0025  # spacing of a trajectory in t*, finer than a collapse lasts
_OVERLAP = math.sqrt(math.pi)  # sum of unit pulses whose spacing is their width


@dataclass(frozen=True)
class Path:
    """The trajectory of one bubble and what it holds.

    Args:
        times: dimensionless.
        radius: R/Rmax.
        velocity: over ``U_c``.
        rest_radius: R_inf/Rmax.
        size: Rmax over 200 um: gels and samples know no Rmax.
        own_stress: stress of the base model's gel over p_inf.
    """

    times: Fine
    radius: Fine
    velocity: Fine
    rest_radius: float
    size: float
    own_stress: Fine

    @property
    def rate(self) -> Fine:
        """Strain rate ``U/R``, in ``U_c`` over 200 um."""
        return self.velocity / self.radius / self.size

    @cached_property
    def strain(self) -> Fine:
        """Strain that the gel has gone through, ``int |U|/R dt``: the memory variable."""
        step = float(self.times[1] - self.times[0])
        return torch.cumsum((self.velocity / self.radius).abs(), 0) * step

    @property
    def contents(self) -> Fine:
        """Pressure of the contents over p_inf, about: gas of ``R_inf`` that follows a polytrope."""
        return self.rest_radius**3 * self.radius**-3.9


@dataclass(frozen=True)
class Response:
    """A shot about one state: all that a linear refit needs.

    Args:
        residual: ``T`` tensor, whitened.
        prediction: ``T`` tensor, R/Rmax.
        fitted: ``(d + w) x T`` tensor, whitened sensitivities to the gel and to the shot's uncertain
            nuisances.
        pressure: ``K x T`` tensor, whitened responses to a pressure p_inf in each pulse.
        path: the trajectory.
    """

    residual: FrameValues
    prediction: FrameValues
    fitted: Float[Tensor, "coordinates frames"]
    pressure: Float[Tensor, "pulses frames"]
    path: Path


@dataclass(frozen=True)
class Shot:
    """One experiment of a batch whose bubble may feel a pressure of its own.

    Args:
        prior: of the base model's gel.
        batch: the experiment alone, with the batch's noise.
        simulator: makes the bubbles.
    """

    prior: ModelBelief
    batch: ExperimentBatch
    simulator: Simulator

    @cached_property
    def moments(self) -> Pulses:
        """Centres of the pulses, t*."""
        beyond = 3.0 * SPACING
        last = float(self._experiment.times.max())
        return arange(-beyond, last + beyond, SPACING)

    @property
    def _experiment(self) -> Experiment:
        return self.batch.curves[0]

    def shape_pressure(
        self, times: Float[Tensor, "times"]
    ) -> Float[Tensor, "pulses times"]:
        """Pulses at given times; their sum is a constant pressure p_inf."""
        return (-((times - self.moments[:, None]) / SPACING).square()).exp() / _OVERLAP

    def average_pressure(
        self, times: Float[Tensor, "times"]
    ) -> Float[Tensor, "pulses times"]:
        """Weights that give each pulse its share of a pressure at given times, so that impulses
        stay what they are.
        """
        weights = self.shape_pressure(times)
        return weights / weights.sum(1, keepdim=True).clamp_min(1e-300)

    def driven(self, pressure: Pulses) -> Simulator:
        """The simulator with a pressure at the wall, over p_inf, beside the laboratory's own
        driving.
        """
        if not pressure.any():
            return self.simulator
        conditions = self.simulator.conditions
        surroundings = conditions.surroundings
        weber = self.batch.designs[0, 0]
        seconds = surroundings.time_scale(surroundings.max_radius(weber))
        times = arange(0.0, float(self.moments[-1]), SPACING / 4.0)
        pascals = -surroundings.far_field_pressure * (pressure @ self.shape_pressure(times))
        if conditions.driving is not None:
            pascals = pascals + conditions.driving(times * seconds)[0]
        driving = TabulatedDriving(
            tuple((times * seconds).tolist()), tuple(pascals.tolist())
        )
        conditions = replace(conditions, driving=driving)
        return replace(self.simulator, conditions=conditions)  # type: ignore[type-var]

    def predict(
        self,
        gel: Controls,
        nuisances: Float[Tensor, "nuisances"],
        pressure: Pulses,
    ) -> FrameValues:
        """The curve under a pressure."""
        posterior = Posterior(self.prior, self.batch, self.driven(pressure))
        return posterior.predict(Point(gel, nuisances[None]))[0]

    def respond(
        self,
        gel: Controls,
        nuisances: Float[Tensor, "nuisances"],
        pressure: Pulses,
    ) -> Response:
        """The curve under a pressure and its sensitivities there."""
        simulator = self.driven(pressure)
        posterior = Posterior(self.prior, self.batch, simulator)
        near = posterior.neighbourhood(Point(gel, nuisances[None]))
        parameters = self.prior.to_si(gel)
        shifts = nuisances[None] * self.batch.nuisance_sds
        moved = parameters.repeat(1 + len(self.moments), 1)
        names = PARAMETERS.index(["pulse", "pulse_time", "pulse_width"])
        moved[1:, names[0]] = -_STEP
        moved[1:, names[1]] = self.moments
        moved[1:, names[2]] = math.log(SPACING)
        # coarser bubbles collapse at other times: by their slopes strong unknowns do not converge
        curves = predict(simulator, moved, self.batch, shifts, bundled=True)[:, 0]
        changes = ((curves[1:] - curves[:1]) / (_STEP * _OVERLAP)).nan_to_num()
        centre = near.centre[0]
        sd = self.batch.sd(near.centre)
        return Response(
            residual=self.batch.whiten(self.batch.mean - near.centre, sd)[0],
            prediction=centre,
            fitted=self.whiten(near.jacobian[:, 0], centre),
            pressure=self.whiten(changes, centre),
            path=self._path(simulator, parameters, shifts),
        )

    def respond_to_effects(
        self,
        gel: Controls,
        nuisances: Float[Tensor, "nuisances"],
        pressure: Pulses,
        effects: ShapedEffects,
        *,
        step: float = 0.05,
    ) -> Float[Tensor, "effects frames"]:
        """Whitened changes of the curve under a pressure by effects, each with values of its other
        parameters, per prior standard deviation of its strength.
        """
        parameters = self.prior.to_si(gel)
        moved = [parameters]
        for effect, shape in effects:
            strength, *others = PARAMETERS.index(effect.names)
            row = parameters.clone()
            row[others] = tensor(shape)
            further = row.clone()
            further[strength] += step * effect.strength.sd
            moved += [row, further]
        shifts = nuisances[None] * self.batch.nuisance_sds
        simulator = self.driven(pressure)
        curves = predict(simulator, torch.stack(moved), self.batch, shifts, bundled=True)
        changes = (curves[2::2, 0] - curves[1::2, 0]) / step
        return self.whiten(changes.nan_to_num(), curves[0, 0])

    def reread(self, errors: Float[Tensor, "twice_frames"]) -> "Shot":
        """The shot as a camera without errors would have filmed it.

        Args:
            errors: of the radius in each frame, R*, then of the time, t*: what was read is too large
                and too early by them.

        Raises:
            InputDataError: where times would not increase.
        """
        by_radius, by_time = errors.unflatten(0, (2, -1))
        experiment = self._experiment
        times = experiment.times + by_time
        right = replace(experiment, times=times, radius=experiment.radius - by_radius)
        return replace(self, batch=replace(self.batch, experiments=(right,)))

    def project_errors(
        self, errors: Float[Tensor, "twice_frames errors"], prediction: FrameValues
    ) -> Float[Tensor, "errors frames"]:
        """Whitened changes of the curve by small errors of radius and time."""
        by_radius, by_time = errors.mT.unflatten(1, (2, -1)).unbind(1)
        slope = torch.gradient(prediction, spacing=(self._experiment.times,))[0]
        return self.whiten(by_radius + slope * by_time, prediction)

    def whiten(
        self, rows: Float[Tensor, "rows frames"], prediction: FrameValues
    ) -> Float[Tensor, "rows frames"]:
        """Changes of the curve in R* in units of its noise."""
        sd = self.batch.sd(prediction[None])
        return self.batch.whiten(rows[:, None], sd).nan_to_num()[:, 0]

    def _path(self, simulator: Simulator, parameters: Tensor, shifts: Tensor) -> Path:
        experiment = self._experiment
        times = arange(0.0, float(experiment.times.max()), _FINE)
        seen = replace(experiment, times=times, radius=ones(1, len(times)), motion=None)
        fine = replace(self.batch, experiments=(seen,))
        radius = predict(simulator, parameters, fine, shifts)[0]
        velocity = torch.gradient(radius, spacing=(times,))[0]
        rest = radius.new_tensor(experiment.design[1])
        surroundings = simulator.conditions.surroundings
        size = surroundings.max_radius(radius.new_tensor(experiment.design[0]))
        path = Path(times, radius, velocity, float(rest), float(size) / USUAL_SIZE, radius)
        return replace(path, own_stress=self.stress_along(path, parameters))

    def stress_along(self, path: Path, parameters: Tensor) -> Fine:
        """Stress over p_inf of a gel, ``p`` parameters in SI, whose wall moves as another may have.

        Memory has no value on a path, so a term that remembers is left out.
        """
        surroundings = self.simulator.conditions.surroundings
        size = path.radius.new_tensor(USUAL_SIZE * path.size)
        theta = dimensionless(parameters, size, surroundings)
        terms = [term for term in TERMS if not term.states and theta[term.switch] != 0.0]
        rest = path.radius.new_tensor(path.rest_radius)
        return gel_response(terms, path.radius, path.velocity, rest, theta)[0].value
