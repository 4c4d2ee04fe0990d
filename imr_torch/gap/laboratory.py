"""Several gels of one laboratory: is what they miss common (bubble, gas, camera, set-up), or each
gel's own?

The base model is fitted to each gel by itself; what is left of all is compared at once
(:mod:`imr_torch.unknown.common`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from imr_torch.assimilate import ModelFit, SearchOptions
from imr_torch.gap.adequacy import Adequacy
from imr_torch.gap.diagnose import fit_base
from imr_torch.gap.fits import fit_hypotheses
from imr_torch.gap.hypotheses import Hypothesis, Inquiry
from imr_torch.gap.verdict import NONE
from imr_torch.material import Effect, ModelBelief
from imr_torch.observe import Experiment
from imr_torch.random import child
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress, ProgressLine
from imr_torch.unknown import CommonUnknown, FollowedGel, compare_unknowns


@one_torch_thread()
def compare_gels(
    gels: Mapping[str, Sequence[Experiment]],
    *,
    base: ModelBelief | None = None,
    effects: Sequence[Effect] | None = None,
    estimate_noise: bool = False,
    simulator: Simulator | None = None,
    leads: int = 6,
    seed: int = 0,
    progress: Progress = None,
) -> CommonUnknown:
    """Ask whether what several gels miss is common to them.

    Args:
        gels: name -> its experiments; of independent data.
        base: prior of the base model of each gel; other arguments too as of
            :func:`imr_torch.gap.diagnose`.
        effects: that may be common, or a gel's own.
        estimate_noise: whether the noise of each gel is inferred.
        simulator: makes the bubbles.
        leads: effects that are fitted to each gel, and those that are best of any gel to all, so
            that trajectories follow the curves.
        seed: of the searches.
        progress: called with one line per step.

    Raises:
        InputDataError: for fewer than two gels, and for one whose bubbles cannot be simulated.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.gap import compare_gels
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> simulator = PolytropicSimulator()
    >>> gels = {}
    >>> for number, modulus in enumerate((6e3, 1e4)):
    ...     truth = PARAMETERS.pack({"G": modulus, "mu": 0.1, "size_drag": 5e6})  # one drag
    ...     laboratory = SimulatedLaboratory(simulator, truth, repeats=10)
    ...     design = torch.tensor([300.0, 0.2], dtype=torch.float64)
    ...     gels[str(number)] = [laboratory.shoot(design, seed=number)]
    >>> found = compare_gels(gels, effects=library(["size_drag", "refraction"]), simulator=simulator)
    >>> found.causes[0].name
    'size_drag'
    """
    searches = []
    for name, experiments in gels.items():
        if progress:
            progress(ProgressLine(f"fits of {name}", stage="gels", step=name))
        null, inquiry = fit_base(
            experiments,
            base=base,
            effects=effects,
            estimate_noise=estimate_noise,
            simulator=simulator,
            seed=child(seed, name),
        )
        left = inquiry.test(null, Hypothesis(inquiry.base), seed=child(seed, name, "gap"))
        searches.append(_GelSearch(inquiry, left, {NONE: null}))
        ahead = [block.name for block in left.test.blocks if block.name in left.starts]
        searches[-1].fit_effects(ahead[:leads] if left.test.found else [], seed=seed)
    best = [search.best for search in searches]
    followed = []
    for search in searches:
        search.fit_effects(best, seed=seed)
        inquiry = search.inquiry
        fit = search.fits[search.best]
        followed.append(FollowedGel.follow(fit, inquiry.batch, inquiry.simulator))
    return compare_unknowns(followed, searches[0].inquiry.effects)


@dataclass(frozen=True)
class _GelSearch:
    """A gel whose curves are to be followed: with an effect, a search may lead to collapses that none
    reaches without.
    """

    inquiry: Inquiry
    left: Adequacy
    fits: dict[str, ModelFit]

    @property
    def best(self) -> str:
        """Name of the fit of lowest cost."""
        return min(self.fits, key=lambda name: self.fits[name].cost)

    def fit_effects(self, names: Sequence[str], *, seed: int) -> None:
        """Fit effects of these names that were not fitted yet."""
        longer = self.inquiry.longer(Hypothesis(self.inquiry.base))
        asked = [longer[name] for name in dict.fromkeys(names) if name not in self.fits]
        options = SearchOptions(starts=2, iterations=30, basin_rounds=0)
        self.fits.update(
            fit_hypotheses(
                self.inquiry,
                asked,
                self.fits[NONE],
                seed=seed,
                starts=self.left.starts,
                options=options,
                twice=0,
            )
        )
