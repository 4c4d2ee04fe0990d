"""Several gels of one laboratory: is what they miss common (bubble, gas, camera, set-up), or each
gel's own?

The base model is fitted to each gel by itself; what is left of all is compared at once
(:mod:`imr_torch.unknown.common`).
"""

from collections.abc import Mapping, Sequence
from operator import attrgetter

from imr_torch.assimilate import SearchOptions
from imr_torch.gap.diagnose import fit_base
from imr_torch.gap.fits import fit_hypotheses
from imr_torch.gap.hypotheses import Hypothesis
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
    leads: int = 4,
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
        leads: effects of each gel that are fitted to all, those that the gap test finds first, so
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
    fitted = []
    ahead: dict[str, None] = {}
    for name, experiments in gels.items():
        if progress:
            progress(ProgressLine(f"fit of {name}", stage="gels", step=name))
        own = child(seed, name)
        null, inquiry = fit_base(
            experiments,
            base=base,
            effects=effects,
            estimate_noise=estimate_noise,
            simulator=simulator,
            seed=own,
        )
        left = inquiry.test(null, Hypothesis(inquiry.base), seed=own)
        names = [block.name for block in left.test.blocks if block.name in left.starts]
        ahead |= dict.fromkeys(names[: leads * left.test.found])
        fitted.append((null, inquiry, left.starts))
    options = SearchOptions(starts=2, iterations=30, basin_rounds=0)
    followed = []
    for name, (null, inquiry, starts) in zip(gels, fitted, strict=True):
        if progress:
            progress(ProgressLine(f"effects in {name}", stage="gels", step=name))
        longer = inquiry.longer(Hypothesis(inquiry.base))
        asked = [longer[effect] for effect in ahead]
        fits = fit_hypotheses(
            inquiry, asked, null, seed=seed, starts=starts, options=options, twice=0
        )
        # with an effect, a search may lead to collapses that none reaches without
        best = min((null, *fits.values()), key=attrgetter("cost"))
        lead = next((x.effects[0] for x in asked if fits[x.name] is best), None)
        followed.append(
            FollowedGel.follow(best, inquiry.batch, inquiry.simulator, lead=lead)
        )
    return compare_unknowns(followed, fitted[0][1].effects)
