"""From measured R(t) curves of one gel to its parameters and the probability of each constitutive
model.

All curves are fitted together, each with its own Rmax, time zero and R_inf as nuisances
(:func:`characterize`); the result (:class:`Characterization`) becomes a report, a JSON document or
a table.
"""

from imr_torch.characterization.bands import predictive_band
from imr_torch.characterization.infer import characterize
from imr_torch.characterization.request import EFFORTS, Effort, medium_document, medium_of
from imr_torch.characterization.result import Characterization
from imr_torch.material import intervals

__all__ = [
    "EFFORTS",
    "Characterization",
    "Effort",
    "characterize",
    "intervals",
    "medium_document",
    "medium_of",
    "predictive_band",
]
