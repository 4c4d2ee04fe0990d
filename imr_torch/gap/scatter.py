"""The hypothesis that the gel differs between the curves, compared with the effects of the library
on the same data.

No effect of one gel explains two. Every curve is fitted by itself, and the evidence of curves whose
gels are from one population is that of the Gaussians about these fits, integrated over the
population's median and scatters by quadrature (:mod:`imr_torch.population.quadrature`): as
first-order as that of the effects that it is compared with. It is taken at the base model and
beside the best effect, whose parameters are then the same in all curves, as what is inferred of the
medium always is. The hypothesis is adequate where the gap test rejects no curve at its own fit. It
is not computed for sets with repeats, whose repeats may be of different gels too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch

from imr_torch.assimilate import ModelFit
from imr_torch.assimilate.importance import weighted_quantiles
from imr_torch.gap.adequacy import adequacy_test
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.hypotheses import EXPLAINS, GEL_SCATTER, laplace_evidence
from imr_torch.gap.own_gels import fit_alone
from imr_torch.goodness.score import ADEQUATE
from imr_torch.labels import p_value
from imr_torch.material import LIBRARY, Effect
from imr_torch.observe import ExperimentBatch
from imr_torch.population import SCALE, GaussianShots, coordinate_units
from imr_torch.population.quadrature import MOST, any_scatter, cells
from imr_torch.random import child
from imr_torch.simulate import Simulator


@dataclass(frozen=True)
class GelScatter:
    """Evidence that the gel differs between the curves.

    Args:
        explained: hypothesis -> log evidence over that of the base model, nats: ``"gel_scatter"``,
            that beside the best effect, and the best effect alone.
        leading: the better of the two with scatter; the one without an effect unless that is 3 nats
            behind.
        rival: the best effect, or ``"none"`` where none was fitted.
        scatter: parameter -> 5, 50, 95 % quantile of its scatter: of its logarithm, or its control.
        adequacy_p: that no curve has a gap at its own fit, by the smallest p-value times the number
            of curves.
        converged: whether the fits of all curves have.
        alone: hypothesis with scatter -> fit of each curve by itself.
    """

    explained: Mapping[str, float]
    leading: str
    rival: str
    scatter: Mapping[str, tuple[float, float, float]]
    adequacy_p: float
    converged: bool
    alone: Mapping[str, tuple[ModelFit, ...]] = field(default_factory=dict)

    @property
    def adequate(self) -> bool:
        """Whether nothing is left to explain in any curve."""
        return self.adequacy_p >= ADEQUATE

    @property
    def is_cause(self) -> bool:
        """Whether scatter is the cause: converged, adequate, and better than every effect that was
        fitted, by 3 nats.
        """
        behind = max(
            (value for name, value in self.explained.items() if not name.endswith(GEL_SCATTER)),
            default=0.0,
        )
        return (
            self.converged
            and self.adequate
            and self.explained[self.leading] >= max(behind, 0.0) + EXPLAINS
        )

    def sentences(self) -> tuple[str, ...]:
        """The finding in words."""
        gained = self.explained[self.leading]
        beside = (
            ""
            if self.rival == "none"
            else f" beside {self.explained[self.rival]:.0f} by {self.rival} in one gel"
        )
        lines = [
            f"A gel that differs between the curves explains {gained:.0f} nats "
            f"({self.leading}){beside}."
        ]
        if not self.converged:
            lines.append(
                "The fit of a curve by itself did not converge, so nothing is concluded from it."
            )
        elif self.is_cause:
            lines.append(
                f"It leaves no gap in any curve ({p_value(self.adequacy_p)}) and explains most: "
                "the gel differs."
            )
        elif self.adequate:
            lines.append(
                f"It leaves no gap in any curve ({p_value(self.adequacy_p)}), and so it is "
                "possible beside what is named."
            )
        else:
            lines.append(
                f"It leaves a gap in single curves ({p_value(self.adequacy_p)}), so differences "
                "of gels are not all."
            )
        found = ", ".join(
            f"{name} {x[1]:.2f} ({x[0]:.2f} to {x[2]:.2f})" for name, x in self.scatter.items()
        )
        lines.append(
            f"Scatter between the curves, standard deviation of logarithms or controls: {found}."
        )
        return tuple(lines)

    def to_dict(self) -> dict[str, object]:
        """JSON-ready values."""
        return {
            "explained": dict(self.explained),
            "leading": self.leading,
            "scatter": {name: list(x) for name, x in self.scatter.items()},
            "adequacy_p": self.adequacy_p,
            "converged": self.converged,
            "is_cause": self.is_cause,
        }


def gel_scatter(
    report: GapReport, simulator: Simulator, *, scale: float = SCALE, seed: int = 0
) -> GelScatter | None:
    """Compare scatter of the gel with the effects of the library.

    Args:
        report: a diagnosis.
        simulator: makes the bubbles, as in the diagnosis.
        scale: of the half-normal prior of the scatters.
        seed: of the fits and tests.

    Returns:
        None for one experiment, for repeats, where more than four parameters would vary, or where
        the base fit has not converged.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.gap import diagnose
    >>> from imr_torch.gap.scatter import gel_scatter
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> simulator, shots = PolytropicSimulator(), []
    >>> for number, G in enumerate((6e3, 12e3)):
    ...     laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack({"G": G, "mu": 0.09}), repeats=1)
    ...     shots.append(laboratory.shoot(torch.tensor([400.0, 0.22]).double(), seed=number, label=f"shot {number}"))
    >>> report = diagnose(shots, effects=library(["sound_speed"]), simulator=simulator)
    >>> gel_scatter(report, simulator).is_cause
    True
    """
    batch = report.batch
    names = report.null.prior.of_gel
    repeated = any(experiment.repeats > 1 for experiment in batch.experiments)
    if (
        len(batch.experiments) < 2
        or repeated
        or len(names) > MOST
        or not report.null.certificate.usable
    ):
        return None
    found = report.attribution
    base = laplace_evidence(report.null)
    tried = {GEL_SCATTER: report.null}
    explained = {}
    rival = "none"
    if found is not None and found.winner != rival:
        rival = found.winner
        tried[f"{rival}+{GEL_SCATTER}"] = found.fits[rival]
        explained[rival] = laplace_evidence(found.fits[rival]) - base
    alone = {}
    scatter = {}
    for name, fit in tried.items():
        alone[name] = fit_alone(fit, batch, simulator, seed=child(seed, name))
        shots = GaussianShots.of_fits(alone[name], [laplace_evidence(x) for x in alone[name]])
        units = coordinate_units(fit.prior)
        scales = torch.where(
            torch.tensor([n in names for n in fit.prior.names]), scale / units, 0.0
        )
        explained[name] = any_scatter(shots, fit.prior, scales) - base
        grid = cells(shots, fit.prior, scales)
        columns = [(n, fit.prior.names.index(n)) for n in names]
        scatter[name] = {
            n: _interval(grid.middle[:, i] * units[i], grid.weights) for n, i in columns
        }
    leading = max(
        tried, key=lambda name: explained[name] + (EXPLAINS if name == GEL_SCATTER else 0.0)
    )
    effects = tuple(LIBRARY[name] for name in report.directions if name in LIBRARY)
    p = _adequacy(alone[leading], effects, batch, simulator, seed=child(seed, "adequacy"))
    converged = all(fit.certificate.nearly_converged for fit in alone[leading])
    return GelScatter(explained, leading, rival, scatter[leading], p, converged, alone)


def _interval(values: torch.Tensor, weights: torch.Tensor) -> tuple[float, float, float]:
    """5, 50, 95 % quantile over the cells of a grid."""
    low, middle, high = weighted_quantiles(
        values, weights, torch.tensor((0.05, 0.5, 0.95), dtype=values.dtype)
    ).tolist()
    return low, middle, high


def _adequacy(
    fits: Sequence[ModelFit],
    effects: Sequence[Effect],
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
) -> float:
    """Smallest p-value of the gap tests of single curves, times their number."""
    values = []
    for e, (fit, experiment) in enumerate(zip(fits, batch.experiments, strict=True)):
        one = replace(batch, experiments=(experiment,), between={})
        values.append(adequacy_test(fit, effects, one, simulator, seed=child(seed, e)).test.p_value)
    return min(1.0, len(values) * min(values))
