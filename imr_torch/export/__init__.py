"""Exchange with other tools: ArviZ trees, priors from ``torch.distributions``, an sbi simulator."""

from imr_torch.export.arviz import to_arviz, write_netcdf
from imr_torch.export.distributions import from_distributions, to_marginal
from imr_torch.export.matlab import write_mat
from imr_torch.export.sbi import ModelPrior, SbiSimulator, sbi_simulator

__all__ = [
    "ModelPrior",
    "SbiSimulator",
    "from_distributions",
    "sbi_simulator",
    "to_arviz",
    "to_marginal",
    "write_mat",
    "write_netcdf",
]
