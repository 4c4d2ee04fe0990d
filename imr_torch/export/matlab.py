"""A characterisation as a MATLAB file.

Two lines plot a curve with its fit:

    load result.mat
    plot(curves(1).time_us, curves(1).radius_um, '.', curves(1).model_time_us, curves(1).model_radius_um)
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.io import savemat

from imr_torch.files import Document, write_atomically
from imr_torch.material import PARAMETERS


def write_mat(document: Document, path: str | Path) -> None:
    """Write a result of ``characterize`` as a MATLAB file, atomically.

    It holds ``model`` (the most probable), ``fit`` (whether that explains the curves),
    ``probabilities``, ``parameters`` (one struct a model and parameter: ``model``, ``name``,
    ``unit``, ``low``, ``median``, ``high``, SI) and ``curves`` (one struct a curve: frames in us
    and um, which of them were ``fitted``, their ``asphericity`` a/b - 1 where half axes were
    measured, the model's curve, its 90 % predictive band, and ``residual`` and
    ``residual_over_sd`` at the fitted frames, R/Rmax).

    Args:
        document: of :meth:`imr_torch.Characterization.to_document` or ``imr-torch characterize``.
        path: the file; replaced if it exists.

    >>> import tempfile
    >>> from scipy.io import loadmat
    >>> from imr_torch.export import write_mat
    >>> models = {"nhkv": {"intervals": {"G": [4e3, 5e3, 6e3]}}}
    >>> document = {"model_probabilities": {"nhkv": 1.0}, "models": models, "curves": []}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_mat(document, f"{folder}/gel.mat")
    ...     float(loadmat(f"{folder}/gel.mat", squeeze_me=True)["parameters"]["median"])
    5000.0
    """
    chances = document["model_probabilities"]
    names: tuple[str, ...] = ("model", "name", "unit", "low", "median", "high")
    parameters: list[Document] = [
        dict(
            zip(
                names,
                (key, PARAMETERS[name].export_name, PARAMETERS[name].unit, *interval),
                strict=True,
            )
        )
        for key, entry in document["models"].items()
        for name, interval in entry["intervals"].items()
    ]
    content = {
        "model": max(chances, key=chances.__getitem__),
        "fit": (document.get("fit_test") or {}).get("sentence", "not tested"),
        "probabilities": dict(chances),
        "parameters": _struct_array(parameters),
        "curves": _struct_array([_convert_curve(curve) for curve in document["curves"]]),
    }
    write_atomically(Path(path), lambda stream: savemat(stream, content, oned_as="column"))


def _convert_curve(curve: Document) -> Document:
    """One curve in us and um, with the most probable model."""
    measured = curve["measured"]
    band = curve["band"]
    model = curve["models"][band["model"]]
    to_us = 1e6 * curve["time_scale_s"]
    to_um = 1e6 * curve["Rmax_m"]
    columns = {
        "time_us": (to_us, measured["t_star"]),
        "radius_um": (to_um, measured["R_star"]),
        "fitted": (1.0, measured["fitted"]),
        "asphericity": (1.0, measured.get("asphericity", [])),
        "model_time_us": (to_us, model["t_star"]),
        "model_radius_um": (to_um, model["R_star"]),
        "band_time_us": (to_us, band["t_star"]),
        "band_low_um": (to_um, band["low"]),
        "band_high_um": (to_um, band["high"]),
        "residual": (1.0, model["residual"]),
        "residual_over_sd": (1.0, model["residual_over_sd"]),
    }
    arrays = {
        name: scale * np.array(x, dtype=float) for name, (scale, x) in columns.items()
    }
    return {"id": curve["id"], "We": curve["We"], "rinf_star": curve["R_inf*"]} | arrays


def _struct_array(rows: Sequence[Document]) -> np.ndarray:
    """Rows as a struct array, which a list of dictionaries is not."""
    names = list(rows[0]) if rows else ["id"]
    return np.array(
        [tuple(row.values()) for row in rows], dtype=[(name, object) for name in names]
    )
