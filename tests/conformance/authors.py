"""The published code's cases through this toolkit: ``radius(case, t_star)``."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from imr_torch import float64
from imr_torch.errors import UnsupportedError
from imr_torch.material import MATERIALS, PARAMETERS
from imr_torch.simulate import ACCURACIES, PRESETS, Accuracy, TransportSimulator
from tests.simulate.difference_grids import AuthorsResolution

GRIDS: dict[str, Accuracy] = {
    "converged": ACCURACIES["reference"],
    # NT = NTM = 240 points and L = 2; the tolerance resolves that grid's own solution
    "authors_240": replace(
        ACCURACIES["reference"],
        tolerance=1e-5,
        resolution=AuthorsResolution(240, 240, 2.0, 2.0),
    ),
}
MODELS: dict[str, tuple[str, dict[str, str]]] = {
    "qkv": ("qkv", {"G": "G_Pa", "mu": "mu_Pa_s", "alpha": "alpha"}),
    "nhkv": ("nhkv", {"G": "G_Pa", "mu": "mu_Pa_s"}),
    "fung2": ("fung2", {"G": "G_Pa", "mu": "mu_Pa_s", "alpha_fung2": "alpha"}),
    "fungexp": ("fungexp", {"G": "G_Pa", "mu": "mu_Pa_s", "alpha_fung": "alpha"}),
    "linkv": ("linkv", {"G_lin": "G_Pa", "mu": "mu_Pa_s"}),
    "sls": ("sls", {"G_lin": "G_Pa", "mu": "mu_Pa_s", "tau_sls": "lambda_s"}),
    "nhzen": ("sns", {"G": "G_Pa", "mu": "mu_Pa_s", "tau_sns": "lambda_s"}),
}
"""The set's models: key in the registry, and which entry of a case is which parameter."""


def parameter_vector(case: Mapping[str, Any]) -> Tensor:
    """The parameter vector of a case with the keys of the published set.

    Raises:
        UnsupportedError: for a constitutive model that is not in the registry.
    """
    model = case["equivalent_model"]
    key, columns = MODELS.get(
        model, (model, {"G": "G_Pa", "mu": "mu_Pa_s", "alpha": "alpha"})
    )
    if key not in MATERIALS or not set(MATERIALS[key].names) <= set(columns):
        raise UnsupportedError(
            f"Model {model!r} is not in the registry; known are {', '.join(MODELS)}."
        )
    return PARAMETERS.pack(
        {name: float(case[columns[name]]) for name in MATERIALS[key].names}
    )


def radius(case: Mapping[str, Any], t_star: np.ndarray) -> np.ndarray:
    """``R*`` at ``t_star``, same shape, of a case with the keys of the published set plus ``preset`` and ``grid``."""
    designs = float64.tensor([case["We"], case["Rinf_star"]])
    simulator = TransportSimulator(
        PRESETS[case.get("preset", "published")], GRIDS[case.get("grid", "converged")]
    )
    times = torch.as_tensor(np.asarray(t_star, dtype=np.float64))
    return simulator(parameter_vector(case), designs, times).radius.numpy()
