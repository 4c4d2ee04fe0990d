"""A simulated laboratory: noisy R(t) curves of a gel with given true parameters, at any design."""

from dataclasses import dataclass, field, replace

from jaxtyping import Float
from torch import Tensor

from imr_torch.errors import ConvergenceError, check_at_least
from imr_torch.float64 import linspace, ones, randn, tensor
from imr_torch.observe.experiments import Experiment, ExperimentBatch
from imr_torch.observe.noise import Noise
from imr_torch.observe.nuisance import Nuisance
from imr_torch.observe.prediction import predict
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.types import Design, FrameValues


@dataclass(frozen=True)
class SimulatedLaboratory:
    """Makes experiments on a known gel.

    Args:
        simulator: the truth's physics.
        truth: the gel's parameters, SI, with errors of the camera that all experiments share, which
            act as in predictions.
        noise: observation noise.
        repeats: curves per design.
        times: dimensionless frame times; 81 frames up to t* = 4 by default.
        scatter: relative standard deviations of the achieved We and R_inf* about what was asked;
            the achieved values are measured and reported, with ``nuisance`` as their error.
        nuisance: errors of the measured design and clock.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> laboratory = SimulatedLaboratory(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=3)
    >>> experiment = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> experiment.label, tuple(experiment.radius.shape)  # repeats x frames
    ('We 400, R_inf* 0.220', (3, 81))
    """

    simulator: Simulator
    truth: Float[Tensor, "parameters"]
    noise: Noise = Noise()
    repeats: int = 100
    times: FrameValues = field(default_factory=lambda: linspace(0.0, 4.0, 81))
    scatter: tuple[float, float] = (0.0, 0.0)
    nuisance: Nuisance = Nuisance()

    def __post_init__(self) -> None:
        check_at_least(self, 1, "repeats")

    def shoot(self, design: Design, *, seed: int, label: str = "") -> Experiment:
        """One experiment at ``design`` (2 numbers, We and R_inf*).

        Raises:
            ConvergenceError: if the truth itself cannot be simulated at this design.
        """
        source = generator(child(seed, "laboratory"))
        wobble = randn(2, generator=source) * tensor(self.scatter)
        true = design * wobble.exp()
        shifts = randn(3, generator=source) * self.nuisance.sds()
        scale = 1.0 + float(shifts[0])
        rest = 1.0 + float(shifts[2])
        measured = (float(true[0]) / scale, float(true[1]) * scale / rest)
        name = label or f"We {measured[0]:.0f}, R_inf* {measured[1]:.3f}"
        blank = Experiment(
            name,
            measured,
            self.times,
            ones(1, len(self.times)),
            self.nuisance,
        )
        clean = predict(
            self.simulator, self.truth, ExperimentBatch((blank,)), shifts[None]
        )[0]
        if not clean.isfinite().all():
            solution = self.simulator(self.truth, true, self.times)
            raise ConvergenceError(
                f"The laboratory's own bubble at {true.tolist()} failed: {solution.summary()}"
            )
        radius = self.noise.draw(clean, self.times, self.repeats, generator=source)
        return replace(blank, radius=radius)
