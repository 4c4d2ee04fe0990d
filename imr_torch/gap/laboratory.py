"""Several gels of one laboratory: is what they miss common (bubble, gas, camera, set-up), or each
gel's own?

The base model is fitted to each gel by itself; what is left of all is compared at once
(:mod:`imr_torch.unknown.common`).
"""

from collections.abc import Mapping

from imr_torch.assimilate import SearchOptions
from imr_torch.errors import InputDataError
from imr_torch.gap.diagnose import fit_base
from imr_torch.gap.fits import fit_hypotheses
from imr_torch.gap.hypotheses import Hypothesis, Inquiry
from imr_torch.gap.verdict import NONE
from imr_torch.random import child
from imr_torch.threads import one_torch_thread
from imr_torch.unknown import CommonUnknown, FollowedGel, compare_unknowns

# effects of each gel that are fitted to all, so that trajectories follow the curves: at first those
# that the gap test puts first, then those that explain it best about them
_LEADS = 3
_ROUNDS = 3  # of these, at most
_GAIN = 10.0  # nats that an effect must gain to lead


@one_torch_thread()
def compare_gels(
    gels: Mapping[str, Inquiry],
    *,
    estimate_noise: bool = False,
    seed: int = 0,
) -> CommonUnknown:
    """Ask whether what several gels miss is common to them.

    Args:
        gels: name -> base model, data, simulator and effects of a gel, of all the same effects.
        estimate_noise: whether the noise of each gel is inferred.
        seed: of the searches.

    Raises:
        InputDataError: for fewer than two gels, and for one whose bubbles cannot be simulated.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.gap import compare_gels
    >>> from imr_torch.gap.hypotheses import Inquiry
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> simulator, base = PolytropicSimulator(), wide_prior(["nhkv"])["nhkv"]
    >>> effects = library(["size_drag", "refraction"])
    >>> gels = {}
    >>> for number, modulus in enumerate((6e3, 1e4)):
    ...     truth = PARAMETERS.pack({"G": modulus, "mu": 0.1, "size_drag": 5e6})  # one drag
    ...     laboratory = SimulatedLaboratory(simulator, truth, repeats=10)
    ...     design = torch.tensor([300.0, 0.2], dtype=torch.float64)
    ...     batch = ExperimentBatch((laboratory.shoot(design, seed=number),))
    ...     gels[str(number)] = Inquiry(base, batch, simulator, effects)
    >>> found = compare_gels(gels)
    >>> found.causes[0].name
    'size_drag'
    """
    if len(gels) < 2:
        raise InputDataError(
            f"What is common is asked of {len(gels)} gel; give two or more."
        )
    fitted = []
    ahead: list[str] = []
    for name, gel in gels.items():
        own = child(seed, name)
        null, inquiry = fit_base(gel, estimate_noise=estimate_noise, seed=own)
        left = inquiry.test(null, Hypothesis(inquiry.base), seed=own)
        names = [block.name for block in left.test.blocks if block.name in left.starts]
        ahead += names[: _LEADS * left.test.found]
        fitted.append((inquiry, left.starts, {NONE: null}))
    rounds = 0
    while True:
        followed = []
        for inquiry, starts, fits in fitted:
            longer = inquiry.longer(Hypothesis(inquiry.base))
            asked = [longer[name] for name in dict.fromkeys(ahead) if name not in fits]
            fits |= fit_hypotheses(
                inquiry,
                asked,
                fits[NONE],
                seed=seed,
                starts=starts,
                options=SearchOptions(starts=2, iterations=30, basin_rounds=0),
                twice=0,
            )
            # with an effect, a search may lead to collapses that none reaches without
            fit = min(
                fits.values(), key=lambda fit: fit.cost + _GAIN * (fit is not fits[NONE])
            )
            followed.append(
                FollowedGel.follow(inquiry.base, fit, inquiry.batch, inquiry.simulator)
            )
        found = compare_unknowns(followed, fitted[0][0].effects)
        known = [cause for cause in found.causes if cause.intervals]
        ahead = [
            cause.name
            for gel in range(len(gels))
            for cause in sorted(known, key=lambda cause: -cause.nats["own"][gel])[:_LEADS]
        ]
        rounds += 1
        if rounds == _ROUNDS or set(ahead) <= set(fitted[0][2]):
            return found
