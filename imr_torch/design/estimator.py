"""What an estimator of the information gain is: a callable object, so that one of your own needs no
change of the package.

Four estimators of the information about one gel come with the package (and one about a population of
gels: :class:`~imr_torch.design.population.PopulationInformation`). They agree for many samples;
what differs is how many that takes.

| estimator | evidence of each datum | expected value |
|---|---|---|
| `Laplace` | Gaussian, linearised | exact for linear-Gaussian models |
| `NestedMonteCarlo` | fresh draws of the prior, shared by all data | above the gain |
| `PriorContrastive` | the same, the datum's own gel among them | below the gain, at most ``log(inner)`` per model |
| `PublishedEstimator` | the data's own gels, used again | below ``log`` of the number of draws |
"""

from abc import ABC, abstractmethod

import torch

from imr_torch.design.gain import InformationGain
from imr_torch.design.response import Shot
from imr_torch.errors import InputDataError


class InformationEstimator(ABC):
    """Estimates the information gain of designs shot with one belief; best a frozen dataclass,
    which a journal can record.

    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Constant(InformationEstimator):
    ...     nats: float = 1.0
    ...
    ...     def __call__(self, shot, generator):
    ...         return InformationGain(self.nats, 0.0, variance=0.0, counted=1, drawn=1)
    >>> Constant(2.0)(None, torch.Generator()).value
    2.0
    """

    @abstractmethod
    def __call__(self, shot: Shot, generator: torch.Generator) -> InformationGain:
        """The gain.

        Args:
            shot: belief, designs, simulator and how the designs are observed.
            generator: of all random numbers; the same state must give the same estimate.
        """


def check_at_least(estimator: object, least: int, *names: str) -> None:
    """Raise unless the named integer fields of an estimator are large enough.

    Raises:
        InputDataError: naming the field, its value and what is needed.
    """
    for name in names:
        value = getattr(estimator, name)
        if value < least:
            why = (
                "at least 2 are needed for an error estimate"
                if least == 2
                else f"expected {least} or more"
            )
            raise InputDataError(f"{type(estimator).__name__}.{name} is {value}; {why}.")
