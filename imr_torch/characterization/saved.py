"""Results of :func:`imr_torch.characterize`, read from their JSON files: posterior, weighted draws,
a table.

A result file holds all that is needed to compare gels and to go on from a posterior, not the fits
themselves.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import torch

from imr_torch.assimilate import Assimilation
from imr_torch.document import header, is_explained
from imr_torch.errors import InputDataError, UnsupportedError
from imr_torch.files import Document, read_json, write_atomically
from imr_torch.float64 import tensor
from imr_torch.material import PARAMETERS, Belief, Intervals
from imr_torch.types import DrawnControls, DrawnValues

if TYPE_CHECKING:
    import pandas

_EXPECTED = "expected a result of imr-torch characterize (--json or --out)"


class ReportedResult:
    """A result that becomes a document, and by it a text."""

    command: ClassVar[str]
    """Whose document it is."""

    def to_dict(self) -> Document:
        """JSON-ready values, from which page and report are made."""
        raise NotImplementedError

    def report(self) -> str:
        """The result as text."""
        from imr_torch.results import document_report  # which draws, and needs matplotlib

        return document_report(header(self.command) | self.to_dict())


@dataclass(frozen=True)
class WeightedDraws:
    """Draws of one model's parameters with their posterior weights.

    Args:
        names: the free parameters.
        values: ``n x d`` tensor, SI.
        weights: ``n`` tensor, sums to 1.
        weighted: whether the weights are those of the exact posterior; if not, the draws are of its
            Gaussian approximation.
    """

    names: tuple[str, ...]
    values: DrawnControls
    weights: DrawnValues
    weighted: bool


def draws_to_dict(assimilation: Assimilation) -> Document:
    """The weighted draws of each model that has some, JSON-ready: ``weights`` and one list of SI
    values per parameter.
    """
    found = {}
    for fit in assimilation.fits:
        if fit.sample is None:
            continue
        values = fit.prior.physical(fit.prior.unwhitened(fit.sample.controls))
        columns = {name: values[:, i].tolist() for i, name in enumerate(fit.prior.names)}
        found[fit.model] = {"weights": fit.sample.weights.tolist(), "values": columns}
    return found


@dataclass(frozen=True, eq=False)
class SavedCharacterization:
    """A result that was written as JSON.

    Args:
        document: what the file holds.
        posterior: parameters and model probabilities after the data.
        prior: the same before the data; None in files that do not hold it.
        source: where it comes from, for messages.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.characterization.saved import SavedCharacterization
    >>> belief = wide_prior(["nhkv"])
    >>> intervals = {"G": [1.0, 2.0, 3.0], "mu": [0.1, 0.2, 0.3]}
    >>> saved = SavedCharacterization.from_dict({"belief": belief.to_dict(), "models": {"nhkv": {"intervals": intervals}}})
    >>> [(row["parameter"], row["median"]) for row in saved.rows()]
    [('G', 2.0), ('mu', 0.2)]
    """

    document: Document
    posterior: Belief
    prior: Belief | None = None
    source: str = "result"

    @classmethod
    def load(cls, path: str | Path) -> "SavedCharacterization":
        """Read a result that :meth:`imr_torch.Characterization.save` or the command line wrote.

        Raises:
            InputDataError: if the file cannot be read, or holds no such result.
        """
        return cls.from_dict(read_json(path, expected=_EXPECTED), source=str(path))

    @classmethod
    def from_dict(cls, document: Any, *, source: str = "result") -> "SavedCharacterization":
        """The result of a JSON document.

        Raises:
            InputDataError: if the document is of another kind.
        """
        if (
            not isinstance(document, dict)
            or not isinstance(document.get("models"), dict)
            or "belief" not in document
        ):
            raise InputDataError(f"{source}: holds no 'models' and 'belief'; {_EXPECTED}.")
        for file in document.get("files", ()):
            if not isinstance(file, dict) or not {"name", "sha256"} <= file.keys():
                raise InputDataError(
                    f"{source}: 'files' lacks the name or the sha256 of a file; {_EXPECTED}."
                )
        try:
            is_explained(document)
            before = document.get("prior")
            posterior = Belief.from_dict(document["belief"])
            prior = None if before is None else Belief.from_dict(before)
        except InputDataError as error:
            raise InputDataError(f"{source}: {error}") from None
        for key in posterior.keys:
            if not isinstance(document["models"].get(key), dict):
                raise InputDataError(
                    f"{source}: 'models' lacks {key!r}, which 'belief' has; {_EXPECTED}."
                )
        return cls(document, posterior, prior, source)

    @property
    def probabilities(self) -> dict[str, float]:
        """Model key -> probability."""
        return self.posterior.probabilities

    @property
    def best(self) -> str:
        """Key of the most probable model."""
        return self.posterior.best.model

    @property
    def explained(self) -> bool | None:
        """Whether the most probable model explains the curves; None where that was not tested."""
        return is_explained(self.document)

    def intervals(self, model: str | None = None) -> Intervals:
        """Parameter -> [5 %, 50 %, 95 %] quantile of a model (the most probable when not given),
        SI.
        """
        return dict(self._model(model).get("intervals", {}))

    def verdict(self, model: str | None = None) -> str:
        """Whether the Gaussian of a model is to be used: ``"trusted"``, ``"repaired"``,
        ``"refused"`` or ``"unchecked"``.
        """
        return str(self._model(model).get("verdict", "unchecked"))

    def converged(self, model: str | None = None) -> bool:
        """Whether the fit of a model has converged."""
        return bool(self._model(model).get("certificate", {}).get("converged", False))

    def _model(self, model: str | None) -> Document:
        return self.document["models"][self.posterior[model or self.best].model]

    def draws(
        self, model: str | None = None, *, count: int = 400, seed: int = 0
    ) -> WeightedDraws:
        """Weighted draws of a model; ``count`` of its Gaussian approximation where the file holds
        none.

        Raises:
            InputDataError: if the model is not part of the result, or its draws are incomplete.
        """
        part = self.posterior[model or self.best]
        entry = self.document.get("weighted_draws", {}).get(part.model)
        if entry is None:
            values = part.physical(part.controls(count, seed=seed))
            equal = torch.full_like(values[:, 0], 1.0 / len(values))
            return WeightedDraws(part.names, values, equal, False)
        try:
            values = tensor([entry["values"][name] for name in part.names]).mT
            weights = tensor(entry["weights"])
            whole = weights.shape == values.shape[:1] and (weights >= 0.0).all()
            if not (whole and float(weights.sum()) > 0.0):
                raise ValueError("no weights that fit them")
        except (KeyError, TypeError, ValueError) as error:
            raise InputDataError(
                f"{self.source}: draws of {part.model!r} are not whole ({error}); {_EXPECTED}."
            ) from None
        return WeightedDraws(part.names, values, weights / weights.sum(), True)

    def rows(self) -> list[Document]:
        """One row per model and parameter: SI quantiles, probability and certificate of the model, and
        whether the most probable one explains the curves. A density that was inferred is
        ``ln_density_ratio``, the logarithm of it over that of the medium.
        """
        return [
            {
                "model": key,
                "probability": self.probabilities[key],
                "parameter": PARAMETERS[name].export_name,
                "unit": PARAMETERS[name].unit,
                "low": low,
                "median": middle,
                "high": high,
                "converged": self.converged(key),
                "verdict": self.verdict(key),
                "explained": self.explained if key == self.best else None,
                "rmse": self._model(key).get("rmse"),
                "log_evidence": self._model(key).get("log_evidence"),
            }
            for key in self.posterior.keys
            for name, (low, middle, high) in self.intervals(key).items()
        ]

    def to_dataframe(self) -> "pandas.DataFrame":
        """:meth:`rows` as a table; needs pandas."""
        return to_dataframe(self.rows())


def write_xlsx(rows: Sequence[Document], columns: Sequence[str], path: Path) -> bool:
    """Write rows as a workbook, atomically; whether openpyxl is there to do it.

    Args:
        rows: column -> value.
        columns: in order.
        path: the file; replaced if it exists.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.characterization.saved import write_xlsx
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_xlsx([{"shot": "a", "G": 5000.0}], ("shot", "G"), Path(folder) / "summary.xlsx")
    True
    """
    try:
        from openpyxl import Workbook
    except ImportError:
        return False
    book = Workbook(write_only=True)
    sheet = book.create_sheet()
    for cells in (columns, *([row.get(name) for name in columns] for row in rows)):
        sheet.append(list(cells))
    write_atomically(path, book.save)
    return True


def to_dataframe(rows: Sequence[Document]) -> "pandas.DataFrame":
    """Rows as a table.

    Raises:
        UnsupportedError: if pandas is not installed.

    >>> from imr_torch.characterization.saved import to_dataframe
    >>> to_dataframe([{"shot": "a", "G": 5000.0}]).shape
    (1, 2)
    """
    try:
        import pandas
    except ImportError:
        raise UnsupportedError(
            "to_dataframe needs pandas: pip install pandas; rows() gives the same as a list."
        ) from None
    return pandas.DataFrame([dict(row) for row in rows])
