"""Posteriors as an ArviZ tree, for its plots and diagnostics, and as a netCDF file that any
language reads.

One branch per model, each with the groups of the ArviZ schema, so that ``tree["nhkv"]`` is what its
functions take. Draws come from the weighted sample of a fit, resampled to equal weight; from its
Gaussian where it has none. The log likelihood is that of whole experiments, so that ArviZ's
leave-one-out leaves out an experiment. Needs the extra ``imr-torch[arviz]``.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from imr_torch.assimilate import Assimilation, ModelFit
from imr_torch.errors import InputDataError, UnsupportedError
from imr_torch.float64 import randn
from imr_torch.material import PARAMETERS, Belief, ModelBelief
from imr_torch.observe import NUISANCES, ExperimentBatch
from imr_torch.random import child, generator

if TYPE_CHECKING:
    from xarray import DataTree

Variable = tuple[list[str], np.ndarray, dict[str, str]]
"""Dimensions, values and attributes, as xarray takes them."""


def to_arviz(source: Assimilation | Belief, *, seed: int, draws: int = 1000) -> "DataTree":
    """The tree of an assimilation or a belief.

    Args:
        source: an assimilation gives, per model, ``posterior``, ``sample_stats``,
            ``log_likelihood``, ``observed_data`` and ``constant_data``; a belief gives
            ``posterior`` alone. Of a campaign they are ``campaign.steps[-1].assimilation`` and
            ``campaign.belief``.
        seed: of the draws.
        draws: draws per model.

    Returns:
        A tree whose variables carry their units as attributes and whose dimensions are named.

    Raises:
        UnsupportedError: if xarray and arviz-base are not installed.
        InputDataError: for something else to export, or no draw.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.export import to_arviz
    >>> tree = to_arviz(wide_prior(["nhkv"]), seed=0, draws=50)
    >>> tree["nhkv/posterior"].sizes["draw"]
    50
    """
    try:
        import arviz_base  # noqa: F401 (the tree is xarray's; without ArviZ it would be of no use)
        from xarray import Dataset, DataTree
    except ImportError:
        raise UnsupportedError(
            "to_arviz needs ArviZ; install it with: pip install 'imr-torch[arviz]'."
        ) from None
    if draws < 1:
        raise InputDataError(f"to_arviz: draws is {draws}; at least 1 is needed.")
    groups = _list_groups(source, seed, draws)
    labels: dict[Any, Sequence[str]] = {"nuisance": NUISANCES}
    if isinstance(source, Assimilation):
        labels["experiment"] = [e.label for e in source.batch.experiments]
    else:
        labels["model"] = source.keys
    datasets = {}
    for path, variables in groups.items():
        dataset = Dataset(variables)
        axes = {name: list(labels.get(name, range(n))) for name, n in dataset.sizes.items()}
        datasets[f"/{path}"] = dataset.assign_coords(axes)
    return DataTree.from_dict(datasets, name="imr_torch")


def _list_groups(
    source: Assimilation | Belief, seed: int, draws: int
) -> dict[str, dict[str, Variable]]:
    """Path of each group and its variables, but for the labels of its dimensions."""
    if isinstance(source, Belief):
        branches = {
            f"{part.model}/posterior": _list_parameters(
                part, part.controls(draws, seed=child(seed, "arviz", part.model))
            )
            for part in source.models
        }
        return branches | {
            "models": {"log_probability": _make_variable("model", source.log_probabilities, "nat")}
        }
    if not isinstance(source, Assimilation):
        raise InputDataError(
            f"to_arviz takes an Assimilation or a Belief; got {type(source).__name__}."
        )
    return {
        f"{fit.model}/{group}": variables
        for fit in source.fits
        for group, variables in _list_fit_groups(
            fit, source.batch, child(seed, "arviz", fit.model), draws
        ).items()
    }


def _make_variable(dims: str, values: Any, units: str = "", long_name: str = "") -> Variable:
    """A variable with its dimensions, separated by blanks, and its attributes."""
    attributes = {"units": units, "long_name": long_name}
    return dims.split(), np.asarray(values), {k: v for k, v in attributes.items() if v}


def _list_parameters(part: ModelBelief, controls: Tensor) -> dict[str, Variable]:
    """Free parameters in SI at ``n x d`` controls ``z``."""
    values = part.physical(controls)
    return {
        PARAMETERS[name].export_name: _make_variable(
            "chain draw",
            values[None, :, i],
            PARAMETERS[name].unit,
            long_name=PARAMETERS[name].meaning,
        )
        for i, name in enumerate(part.names)
    }


def _list_fit_groups(
    fit: ModelFit, batch: ExperimentBatch, seed: int, draws: int
) -> dict[str, dict[str, Variable]]:
    """All groups of one model's fit."""
    data = _list_data(batch)
    sample = fit.sample
    source = generator(seed)
    if sample is None:
        noise = randn(draws, len(fit.mean), generator=source)
        controls = fit.mean + noise @ fit.chol.mT
        return {"posterior": _list_parameters(fit.prior, fit.prior.unwhitened(controls))} | data
    chosen = sample.resample_draws(draws, source)
    posterior = _list_parameters(fit.prior, fit.prior.unwhitened(sample.controls[chosen]))
    likelihood = sample.by_experiment[chosen]
    tail = "shape of the tail of the importance weights"
    density = (likelihood.sum(1) + sample.log_prior[chosen])[None]
    return {
        "posterior": posterior
        | {
            "nuisances": _make_variable(
                "chain draw experiment nuisance", sample.nuisances[chosen][None], "prior sd"
            )
        },
        "sample_stats": {
            "lp": _make_variable("chain draw", density, "nat"),
            "pareto_k": _make_variable("", sample.pareto_k, long_name=tail),
            "effective_samples": _make_variable("", sample.effective_samples),
            "log_evidence": _make_variable("", sample.log_evidence, "nat"),
            "log_evidence_error": _make_variable("", sample.log_evidence_error, "nat"),
        },
        "log_likelihood": {
            "radius": _make_variable(
                "chain draw experiment",
                likelihood[None],
                "nat",
                long_name="of all repeats and frames",
            )
        },
    } | data


def _list_data(batch: ExperimentBatch) -> dict[str, dict[str, Variable]]:
    """Mean curves; designs, times, repeats and prior spreads of the nuisances. NaN where an
    experiment has fewer frames than the longest.
    """
    mean, times = (torch.where(batch.mask, x, torch.nan) for x in (batch.mean, batch.times))
    radius = _make_variable("experiment frame", mean, "R/Rmax", long_name="mean of the repeats")
    constant = {
        "time": _make_variable("experiment frame", times, "t U_c/Rmax"),
        "weber": _make_variable("experiment", batch.designs[:, 0], "1", long_name="Weber number"),
        "rest_radius": _make_variable("experiment", batch.designs[:, 1], "R_inf/Rmax"),
        "repeats": _make_variable("experiment", [e.repeats for e in batch.experiments]),
        "nuisance_sd": _make_variable(
            "experiment nuisance", batch.nuisance_sds, "relative, t*, relative"
        ),
    }
    return {"observed_data": {"radius": radius}, "constant_data": constant}
