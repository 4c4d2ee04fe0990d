"""The effects of the package: what each is called, where it acts, and how large it may be, as
``data/effects.toml`` states it.

Effects of the gel are terms of its stress that a model may lack
(:mod:`~imr_torch.material.elastic`, :mod:`~imr_torch.material.memory`,
:mod:`~imr_torch.material.viscous`, :mod:`~imr_torch.material.departures`); a term acts wherever its
parameter is not neutral. The physics of the bubble and of the liquid around it is in
:mod:`imr_torch.simulate.effects` and
:mod:`imr_torch.simulate.setting`; errors of the measurement act in
:mod:`imr_torch.observe.nuisance`. At zero each does nothing, exactly.
"""

from imr_torch.files import read_table
from imr_torch.material.effect import Effect, register_effect
from imr_torch.material.marginals import make_marginal

for _name, _row in read_table("effects").items():
    _priors = {name: make_marginal(*prior) for name, prior in _row.pop("priors").items()}
    _starts = tuple(map(tuple, _row.pop("starts", ())))
    register_effect(Effect(_name, priors=_priors, starts=_starts, **_row))
