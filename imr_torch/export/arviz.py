"""Posteriors as an ArviZ tree, for its plots and diagnostics, and as a netCDF file that any
language reads.

One branch per model, made by ArviZ's own ``from_dict``, so that ``tree["nhkv"]`` is what its
functions take. Draws come from the weighted sample of a fit, resampled to equal weight; from its
Gaussian where it has none. The log likelihood is that of whole experiments, so that ArviZ's
leave-one-out leaves out an experiment. Needs the extra ``imr-torch[arviz]``.
"""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from imr_torch.assimilate import Assimilation, ModelFit
from imr_torch.errors import InputDataError, UnsupportedError
from imr_torch.float64 import randn
from imr_torch.material import PARAMETERS
from imr_torch.observe import NUISANCES
from imr_torch.random import child, generator

if TYPE_CHECKING:
    from xarray import DataTree

DIMENSIONS = {
    "nuisances": ["experiment", "nuisance"],
    "radius": ["experiment", "frame"],
    "time": ["experiment", "frame"],
    "weber": ["experiment"],
    "rest_radius": ["experiment"],
}
"""Variable -> its dimensions, beside those of the draws."""


def to_arviz(assimilation: Assimilation, *, seed: int, draws: int = 1000) -> "DataTree":
    """The tree of an assimilation.

    Args:
        assimilation: of a campaign, ``campaign.steps[-1].assimilation``.
        seed: of the draws.
        draws: draws per model.

    Returns:
        A tree of one branch per model with ``posterior``, ``observed_data`` and ``constant_data``;
        of weighted fits also ``sample_stats`` (``lp``) and ``log_likelihood``. Parameters carry
        their units.

    Raises:
        UnsupportedError: if xarray and arviz-base are not installed.
        InputDataError: for no draw.

    >>> from imr_torch import PolytropicSimulator, example_gel, load_traces, wide_prior
    >>> from imr_torch.assimilate import SearchOptions, assimilate
    >>> from imr_torch.export import to_arviz
    >>> from imr_torch.observe import ExperimentBatch, prepare
    >>> shot = prepare(load_traces(example_gel())).experiments[0]
    >>> options = SearchOptions(raw_samples=8, starts=2)
    >>> batch, simulator = ExperimentBatch((shot,)), PolytropicSimulator()
    >>> fits = assimilate(wide_prior(["nhkv"]), batch, simulator, seed=0, options=options, warn=False)
    >>> to_arviz(fits, seed=0, draws=50)["nhkv/posterior"].sizes["draw"]
    50
    """
    try:
        from arviz_base import from_dict
        from xarray import DataTree
    except ImportError:
        raise UnsupportedError(
            "to_arviz needs ArviZ; install it with: pip install 'imr-torch[arviz]'."
        ) from None
    if draws < 1:
        raise InputDataError(f"to_arviz: draws is {draws}; at least 1 is needed.")
    batch = assimilation.batch
    radius, time = (
        torch.where(batch.mask, x, torch.nan) for x in (batch.mean, batch.times)
    )
    weber, rest_radius = batch.designs.T
    data = {
        "observed_data": {"radius": radius},
        "constant_data": {"time": time, "weber": weber, "rest_radius": rest_radius},
    }
    labels = {
        "experiment": [e.label for e in batch.experiments],
        "nuisance": list(NUISANCES),
    }
    branches = {}
    for fit in assimilation.fits:
        groups = _draw_groups(fit, draws, child(seed, "arviz", fit.model)) | data
        values = {
            name: {k: x.numpy() for k, x in group.items()} for name, group in groups.items()
        }
        branch = from_dict(values, coords=labels, dims=DIMENSIONS)
        for entry in map(PARAMETERS.__getitem__, fit.prior.names):
            branch["posterior"][entry.export_name].attrs["units"] = entry.unit
        branches[fit.model] = branch
    return DataTree(children=branches, name="imr_torch")


def _draw_groups(fit: ModelFit, draws: int, seed: int) -> dict[str, dict[str, Tensor]]:
    """Draws of one model with what belongs to each; a first dimension of one chain."""
    sample = fit.sample
    source = generator(seed)
    if sample is None:
        controls = fit.mean + randn(draws, len(fit.mean), generator=source) @ fit.chol.mT
        return {"posterior": _name_parameters(fit, controls)}
    chosen = sample.resample_draws(draws, source)
    likelihood = sample.by_experiment[chosen][None]
    posterior = _name_parameters(fit, sample.controls[chosen])
    return {
        "posterior": posterior | {"nuisances": sample.nuisances[chosen][None]},
        "sample_stats": {"lp": likelihood.sum(2) + sample.log_prior[chosen]},
        "log_likelihood": {"radius": likelihood},
    }


def _name_parameters(fit: ModelFit, controls: Tensor) -> dict[str, Tensor]:
    """Free parameters in SI at ``n x d`` whitened controls, ``1 x n`` each."""
    values = fit.prior.physical(fit.prior.unwhitened(controls))[None]
    names = (PARAMETERS[name].export_name for name in fit.prior.names)
    return dict(zip(names, values.unbind(2), strict=True))
