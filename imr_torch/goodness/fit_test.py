"""A cheap test of whether a fitted model explains the curves: the gap test's generic blocks at a
fit that exists already.

No effect of the library is tried, so it costs a few dozen bubbles and names no cause;
:func:`imr_torch.gap.diagnose` does both. Noise that was estimated from the residuals as a whole
cannot be used: a misfit would widen it and so hide itself. The noise is that of single frames,
which a smooth misfit does not change (:func:`imr_torch.assimilate.infer_frame_noise`), as in a
diagnosis.
"""

import time
from dataclasses import dataclass

import torch

from imr_torch.assimilate import ModelFit, infer_frame_noise
from imr_torch.assimilate.noise_estimation import determines_noise
from imr_torch.files import Document
from imr_torch.goodness.linear import Linearisation, linearise_fit, whiten_rows
from imr_torch.goodness.phases import phase_clock, phase_name
from imr_torch.goodness.score import LEVEL, gap_test, generic_blocks
from imr_torch.html import render
from imr_torch.labels import p_value
from imr_torch.material import material
from imr_torch.observe import ExperimentBatch, Noise
from imr_torch.random import child
from imr_torch.simulate import Simulator

FORM = (
    "generic blocks of the gap test at the fit, without effects of the library; noise of single "
    "frames inferred"
)


@dataclass(frozen=True)
class FitTest:
    """Whether a fitted model explains the curves within their noise.

    Args:
        model: key of the model.
        p_value: of the smallest of all blocks, calibrated; None where it was not tested.
        block: name of the block with the smallest p-value.
        experiment: the curve with the largest residual.
        phase: phase of the event in which that residual lies.
        time: t* there.
        sigma: that residual, in standard deviations of the noise.
        bias_radius: root mean square of the residual beyond noise, in R*.
        noise: the noise law of the test.
        reason: why it was not tested; empty where it was.
        seconds: processor time.

    >>> from imr_torch.goodness import FitTest
    >>> FitTest("nhkv", 0.31).sentence()
    'Fit: the model explains the curves within their noise (p = 0.31, NHKV).'
    """

    model: str
    p_value: float | None
    block: str = ""
    experiment: str = ""
    phase: str = ""
    time: float = 0.0
    sigma: float = 0.0
    bias_radius: float = 0.0
    noise: Noise | None = None
    reason: str = ""
    seconds: float = 0.0

    @property
    def explained(self) -> bool | None:
        """Whether the test does not reject at its level of 4 %; None where it was not run."""
        return None if self.p_value is None else self.p_value >= LEVEL

    def sentence(self, command: str = "imr-torch diagnose") -> str:
        """The result in one sentence; ``command`` is what to try after a misfit."""
        names = {
            "p_value": p_value,
            "title": material(self.model).title,
            "command": command,
        }
        return render("fit_test.txt", test=self, **names).strip()

    def to_dict(self) -> Document:
        """JSON-ready values."""
        document = vars(self) | {"noise": None if self.noise is None else vars(self.noise)}
        return document | {
            "explained": self.explained,
            "level": LEVEL,
            "form": FORM,
            "sentence": self.sentence(),
        }


def check_fit(
    fit: ModelFit, batch: ExperimentBatch, simulator: Simulator, *, seed: int = 0
) -> FitTest:
    """Test whether a fitted model explains the curves that it was fitted to.

    Args:
        fit: the fit.
        batch: its data; their noise law is not used.
        simulator: makes the bubbles.
        seed: of the residuals drawn under the fitted model.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.assimilate import SearchOptions, assimilate
    >>> from imr_torch.goodness import check_fit
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> simulator, design = PolytropicSimulator(), torch.tensor([400.0, 0.22], dtype=torch.float64)
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=1)
    >>> batch, options = ExperimentBatch((laboratory.shoot(design, seed=0),)), SearchOptions(raw_samples=16, starts=2)
    >>> fit = assimilate(wide_prior(["nhkv"]), batch, simulator, seed=0, options=options)["nhkv"]
    >>> tested = check_fit(fit, batch, simulator)
    >>> tested.explained, tested.p_value > 0.04
    (True, True)
    """
    started = time.process_time()
    if not determines_noise(fit, batch):
        return FitTest(
            fit.model,
            None,
            reason="too few frames for the noise to be inferred from them; shoot more curves.",
        )
    # as the figures show them
    left = (
        (batch.mean - fit.prediction)
        * batch.counts.sqrt()
        / batch.of_frames.sd(fit.prediction)
    )
    left = torch.where(batch.mask, left, 0.0)
    clock = phase_clock(batch.times, fit.prediction, batch.mask)
    near = fit.linearise(batch, simulator)
    batch = infer_frame_noise(near).applied(batch)
    line = _move_to_noise(linearise_fit(fit, batch, simulator))
    test = gap_test(generic_blocks(line), line, seed=child(seed, "fit test"))
    if test.found and not fit.certificate.usable:
        return FitTest(
            fit.model,
            None,
            reason=f"the fit of {fit.prior.material.title} did not converge, and such a fit looks "
            "like a misfit.",
        )
    row, column = divmod(int(left.abs().argmax()), left.shape[1])
    return FitTest(
        fit.model,
        test.p_value,
        test.blocks[0].name,
        batch.experiments[row].label,
        phase_name(float(clock[row, column])),
        float(batch.times[row, column]),
        float(left[row, column]),
        test.bias_radius,
        batch.noise,
        seconds=time.process_time() - started,
    )


def _move_to_noise(line: Linearisation, *, far: float = 4.0) -> Linearisation:
    """The fit after one Gauss-Newton step under the noise of the test, where that lowers the cost
    and is longer than ``far`` posterior standard deviations in all.
    """
    if (line.basis.mT @ line.residual).norm() < far:
        return line
    posterior = line.near.posterior
    step = line.to_shift @ line.residual
    for factor in (1.0, 0.3):
        near = posterior.neighbourhood(
            posterior.point_at(line.near.coordinates + factor * step)
        )
        if not near.centre.isfinite().all():
            continue
        own = whiten_rows(near)
        if own.residual.square().sum() < line.residual.square().sum():
            return own
    return line
