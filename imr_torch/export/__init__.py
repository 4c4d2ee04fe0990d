"""Exchange with other tools: ArviZ trees, MATLAB files, an sbi simulator."""

from imr_torch.export.arviz import to_arviz
from imr_torch.export.matlab import write_mat
from imr_torch.export.sbi import ModelPrior, SbiSimulator, sbi_simulator

__all__ = [
    "ModelPrior",
    "SbiSimulator",
    "sbi_simulator",
    "to_arviz",
    "write_mat",
]
