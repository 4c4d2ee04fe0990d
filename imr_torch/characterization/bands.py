"""Posterior predictive bands of curves, and as JSON-ready values from which they are drawn again;
patterns in the residuals of collapse times.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from imr_torch.assimilate import Assimilation
from imr_torch.files import Document, drawn_numbers
from imr_torch.float64 import arange, tensor
from imr_torch.material import LEVELS, Belief
from imr_torch.observe import predict
from imr_torch.observe.collapse import serial_correlation
from imr_torch.simulate import Simulator


def find_patterns(
    shots: Sequence[Document], *, fewest: int = 12, largest: float = 2.6
) -> list[str]:
    """Where residuals of collapse times follow the size or the stretch of a bubble: they are no
    independent errors.

    Args:
        shots: from :meth:`imr_torch.Characterization.collapse_times`.
        fewest: shots from which on a pattern is looked for.
        largest: correlation that is none yet, in standard deviations; one set in 200 has more by
            chance.
    """
    if len(shots) < fewest:
        return []
    left = tensor([x["t_star"] - x["predicted"] for x in shots])
    found = {
        words: serial_correlation(left, tensor([x[key] for x in shots]))
        for key, words in (("Rmax_m", "maximum radius"), ("R_inf*", "stretch"))
    }
    return [
        f"Residuals of the collapse times are correlated in the order of {words} ({size:.1f} "
        "standard deviations): they are no independent errors, intervals are too narrow, and the "
        "model or a calibration misses something."
        for words, size in found.items()
        if size > largest
    ]


def predictive_band(
    result: Assimilation,
    posterior: Belief,
    simulator: Simulator,
    model: str,
    *,
    draws: int = 100,
    seed: int = 0,
    times: Tensor,
) -> Tensor:
    """Posterior predictive quantiles (5, 50, 95 %) of single frames, over gel and noise: a ``3 x E
    x T`` tensor, R/Rmax.

    Args:
        result: the fits, for the data and the nuisances.
        posterior: belief after the data.
        simulator: makes the bubbles.
        model: whose prediction.
        draws: posterior draws.
        seed: of the draws.
        times: ``E x T`` tensor, dimensionless, increasing.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import assimilate
    >>> from imr_torch.characterization import predictive_band
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, Noise, SimulatedLaboratory
    >>> simulator, prior = PolytropicSimulator(), reference_case("soft-pa").prior
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=4)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> result = assimilate(prior, ExperimentBatch((shot,), Noise()), simulator, seed=0)
    >>> low, middle, high = predictive_band(result, prior, simulator, "nhkv", draws=20, times=result.batch.times)
    >>> bool((low < middle).all()), bool((middle < high).all())
    (True, True)
    """
    fit = result[model]
    batch = result.batch
    part = posterior[model]
    controls = part.controls(draws, seed=seed)
    shifts = (fit.nuisances * batch.nuisance_sds).expand(draws, -1, -1)
    prediction = predict(simulator, part.parameters(controls), batch, shifts, times=times)
    # noise at its quantiles, not at random numbers, so that the band is smooth
    levels = (arange(21) + 0.5) / 21  # quantiles of the noise, with each draw
    noise = torch.special.ndtri(levels)
    laws = None if fit.sample is None else fit.sample.noise_laws(draws)
    if laws is None:
        sd = batch.noise.of_frames.sd(prediction, times)
    else:  # each draw with a noise law of its own
        sd = torch.stack(
            [
                law.of_frames.sd(curves, times)
                for law, curves in zip(laws, prediction, strict=True)
            ]
        )
    levels = torch.tensor(LEVELS, dtype=prediction.dtype)
    rows = [
        torch.nanquantile(
            (own + of_own * noise[:, None, None]).flatten(0, 1), levels, dim=0
        )
        for own, of_own in zip(prediction.unbind(1), sd.unbind(1), strict=True)
    ]
    return torch.stack(rows, 1)


def band_document(model: str, times: Tensor, band: Tensor, e: int) -> Document:
    """The predictive band of one experiment, JSON-ready.

    Args:
        model: whose prediction.
        times: ``E x T`` tensor, dimensionless.
        band: ``3 x E x T`` tensor, from :func:`predictive_band`.
        e: which experiment.
    """
    rows = zip(("t_star", "low", "median", "high"), (times, *band), strict=True)
    return {"model": model, "levels": LEVELS} | {
        name: drawn_numbers(values[e]) for name, values in rows
    }
