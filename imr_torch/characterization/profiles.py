"""Profile likelihoods of the parameters of the models that matter, and what a result document says
of them.
"""

from collections.abc import Mapping

from imr_torch.assimilate import Assimilation, Profile, profile
from imr_torch.files import Document
from imr_torch.material import Belief
from imr_torch.random import child
from imr_torch.simulate import Simulator
from imr_torch.types import Progress


def make_profiles(
    result: Assimilation,
    posterior: Belief,
    simulator: Simulator,
    *,
    least: float = 0.05,
    seed: int,
    progress: Progress = None,
) -> dict[str, tuple[Profile, ...]]:
    """The profiles of each model that holds .05 of the probability or more, at the estimated noise;
    the most probable first.

    Args:
        result: the fits of all models.
        posterior: belief after the data, for the probabilities.
        simulator: makes the bubbles.
        least: probability from which on a model has profiles; the most probable one always.
        seed: of the second starts of the fits.
        progress: called with one line per fit.

    Returns:
        Model key -> a profile per free parameter; none for a model with one parameter.
    """
    found: dict[str, tuple[Profile, ...]] = {}
    for key, probability in sorted(posterior.probabilities.items(), key=lambda item: -item[1]):
        if found and probability < least:
            break
        fit = result[key]
        found[key] = ()
        if len(fit.prior.names) > 1:  # with one the posterior is the profile
            found[key] = profile(
                fit, result.batch, simulator, seed=child(seed, key), progress=progress
            )
    return found


def document_profiles(found: Mapping[str, tuple[Profile, ...]] | None) -> Document | None:
    """Model -> parameter -> its profile, JSON-ready; None where none was asked for."""
    return (
        None
        if found is None
        else {
            key: {
                own.name: {
                    "values": list(own.values),
                    "nats_lost": list(own.fall),
                    "converged": list(own.converged),
                    "limits_95": list(own.limits),
                    "bounded": own.bounded,
                }
                for own in profiles
            }
            for key, profiles in found.items()
        }
    )
