"""A simulator with a curved response, whose posterior over two parameters is a banana (with one peak), and its moments by quadrature; errors of moments of draws."""

import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from imr_torch.assimilate import ImportanceSample, ModelFit
from imr_torch.float64 import linspace
from imr_torch.material import PARAMETERS
from imr_torch.observe import ExperimentBatch, predict
from tests.formula import FormulaSimulator
from tests.linear import MEANS, SDS, LinearSimulator


@dataclass(frozen=True)
class CurvedSimulator(FormulaSimulator):
    """The linear simulator, shown ``mu + bend sd_mu ((G - mean_G)/sd_G)^2`` in place of mu, with G itself half mute.

    Args:
        bend: 0 gives a linear response.
        mute: factor by which the response to G is weaker than that to mu.
    """

    bend: float
    mute: float = 0.4

    def formula(self, parameters, designs, times):
        g, mu = PARAMETERS.index(["G", "mu"])
        standard = (parameters[..., g] - MEANS["G"]) / SDS["G"]
        shown = parameters.clone()
        shown[..., mu] = parameters[..., mu] + self.bend * SDS["mu"] * standard.square()
        shown[..., g] = MEANS["G"] + self.mute * SDS["G"] * standard
        return LinearSimulator().formula(shown, designs, times)


@dataclass(frozen=True)
class Quadrature:
    """Moments and evidence of a two-parameter posterior on a grid of its controls."""

    mean: Tensor
    covariance: Tensor
    log_evidence: float
    controls: Tensor
    weights: Tensor

    def below(self, column: int, value: float) -> float:
        """Probability that a coordinate is below a value."""
        return float(self.weights[self.controls[:, column] < value].sum())


def quadrature(
    fit: ModelFit, batch: ExperimentBatch, simulator: CurvedSimulator, *, points: int = 401
) -> Quadrature:
    """Rectangle rule over +-6 prior standard deviations: spectrally accurate for a density that
    vanishes at the edges.
    """
    axis = linspace(-6.0, 6.0, points)
    controls = torch.cartesian_prod(axis, axis)
    likelihood = batch.log_likelihood(
        predict(simulator, fit.parameters(controls), batch)
    ).sum(-1)
    logs = likelihood - 0.5 * controls.square().sum(-1) - math.log(2.0 * math.pi)
    weights = torch.softmax(logs, dim=0)
    mean = weights @ controls
    covariance = (weights[:, None] * (controls - mean)).mT @ (controls - mean)
    cell = 2.0 * math.log(float(axis[1] - axis[0]))
    return Quadrature(
        mean, covariance, float(torch.logsumexp(logs, dim=0)) + cell, controls, weights
    )


def mean_error(sample: ImportanceSample) -> Tensor:
    """``d`` tensor, Monte Carlo standard error of the mean (Owen 2013, section 9.2)."""
    return (sample.weights.square() @ (sample.controls - sample.mean).square()).sqrt()


def sd_error(sample: ImportanceSample) -> Tensor:
    """``d`` tensor, Monte Carlo standard error of the roots of the diagonal of the covariance."""
    variance = sample.covariance.diagonal()
    excess = (sample.controls - sample.mean).square() - variance
    return (sample.weights.square() @ excess.square()).sqrt() / (2.0 * variance.sqrt())


def assert_posterior(
    sample: ImportanceSample, mean: Tensor, covariance: Tensor, log_evidence: float
) -> Tensor:
    """That moments and evidence of the draws are within four standard errors; returns the true standard
    deviations.
    """
    assert sample.log_evidence == pytest.approx(
        log_evidence, abs=4.0 * sample.log_evidence_error
    )
    assert ((sample.mean - mean).abs() < 4.0 * mean_error(sample)).all()
    sds = covariance.diagonal().sqrt()
    found = sample.covariance.diagonal().sqrt()
    assert ((found - sds).abs() < 4.0 * sd_error(sample)).all()
    return sds
