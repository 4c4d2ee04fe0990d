"""Priors from ``torch.distributions``: each distribution becomes the marginal that maps a standard
normal to it.

The map is exact: the library's own where there is one, else SciPy's quantile function of the same
distribution, so that a belief made here can be saved, assimilated and designed with like any other.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import distributions as dist

from imr_torch.errors import InputDataError, UnsupportedError
from imr_torch.material import PARAMETERS, Belief, LogNormal, Marginal, Quantile, TruncatedNormal

_OUTSIDE = 1e-6  # probability that a prior may leave outside its parameter's physical bounds


@dataclass(frozen=True)
class _Map:
    """How to make a marginal of one kind of distribution.

    Args:
        arguments: attributes of the distribution, in the order in which ``make`` takes them.
        make: the marginal of these numbers.
    """

    arguments: tuple[str, ...]
    make: Callable[..., Marginal]


def _scipy(family: str, **names: str) -> _Map:
    """Map to a :class:`Quantile` whose arguments have the values of torch's, as
    ``scipy_name="torch_name"``.
    """
    return _Map(
        tuple(names.values()),
        lambda *values: Quantile(family, dict(zip(names, values, strict=True))),
    )


_MAPS: dict[type[dist.Distribution], _Map] = {
    dist.Normal: _Map(("loc", "scale"), TruncatedNormal),
    dist.HalfNormal: _Map(("scale",), lambda scale: TruncatedNormal(0.0, scale, lower=0.0)),
    dist.LogNormal: _Map(
        ("loc", "scale"), lambda loc, scale: LogNormal(math.exp(loc), math.exp(scale))
    ),
    dist.Uniform: _Map(
        ("low", "high"), lambda low, high: Quantile("uniform", {"loc": low, "scale": high - low})
    ),
    dist.Exponential: _Map(("rate",), lambda rate: Quantile("expon", {"scale": 1.0 / rate})),
    dist.Gamma: _Map(
        ("concentration", "rate"), lambda a, rate: Quantile("gamma", {"a": a, "scale": 1.0 / rate})
    ),
    dist.InverseGamma: _scipy("invgamma", a="concentration", scale="rate"),
    dist.Weibull: _scipy("weibull_min", c="concentration", scale="scale"),
    dist.Pareto: _scipy("pareto", b="alpha", scale="scale"),
    dist.Beta: _scipy("beta", a="concentration1", b="concentration0"),
    dist.Chi2: _scipy("chi2", df="df"),
    dist.FisherSnedecor: _scipy("f", dfn="df1", dfd="df2"),
    dist.StudentT: _scipy("t", df="df", loc="loc", scale="scale"),
    dist.Laplace: _scipy("laplace", loc="loc", scale="scale"),
    dist.Gumbel: _scipy("gumbel_r", loc="loc", scale="scale"),
    dist.Cauchy: _scipy("cauchy", loc="loc", scale="scale"),
    dist.HalfCauchy: _scipy("halfcauchy", scale="scale"),
}


def to_marginal(distribution: dist.Distribution) -> Marginal:
    """The marginal with exactly the law of a one-dimensional distribution.

    Args:
        distribution: over one number, in SI units.

    Raises:
        InputDataError: if it is over more numbers than one.
        UnsupportedError: if there is no map for its kind.

    >>> import torch
    >>> from torch.distributions import Gamma
    >>> from imr_torch.export import to_marginal
    >>> round(float(to_marginal(Gamma(2.0, 1e-3)).to_physical(torch.tensor(0.0).double())))  # its median
    1678
    """
    shape = (*distribution.batch_shape, *distribution.event_shape)
    if math.prod(shape) != 1:
        raise InputDataError(
            f"A prior of one parameter is over one number; got a {type(distribution).__name__} of "
            f"shape {shape}."
        )
    if isinstance(distribution, dist.Independent):
        return to_marginal(distribution.base_dist)
    way = _MAPS.get(type(distribution))
    if way is None:
        known = ", ".join(kind.__name__ for kind in _MAPS)
        raise UnsupportedError(
            f"No map from a standard normal to {type(distribution).__name__} is known; known are "
            f"{known}. "
            "Give a marginal in its place: TruncatedNormal, or Quantile with any continuous "
            "distribution of scipy.stats."
        )
    return way.make(*(float(getattr(distribution, name)) for name in way.arguments))


def from_distributions(
    models: Mapping[str, Mapping[str, dist.Distribution | Marginal]],
    *,
    probabilities: Mapping[str, float] | None = None,
    known: Mapping[str, float] | None = None,
) -> Belief:
    """A prior belief with independent parameters.

    Args:
        models: model key -> parameter name -> distribution in SI units (or a marginal), one for
            each free parameter.
        probabilities: model key -> prior probability; equal when not given.
        known: values of parameters that a model takes as measured, SI.

    Raises:
        InputDataError: as :meth:`imr_torch.material.Belief.prior` does, and for a prior that gives
            impossible values of its parameter a probability above one in a million.
        UnsupportedError: for a distribution to which no map is known.

    >>> from torch.distributions import LogNormal, Uniform
    >>> from imr_torch.export import from_distributions
    >>> belief = from_distributions({"nhkv": {"G": LogNormal(8.5, 0.7), "mu": Uniform(0.01, 0.5)}})
    >>> round(float(belief["nhkv"].quantile([0.5])[0, 1]), 3)  # median of mu, Pa s
    0.255
    """
    made = {
        model: {name: _checked(name, prior) for name, prior in priors.items()}
        for model, priors in models.items()
    }
    return Belief.prior(made, probabilities=probabilities, known=known)


def _checked(name: str, prior: dist.Distribution | Marginal) -> Marginal:
    """The prior as a marginal, if all but a millionth of its mass lies in the physical bounds of
    its parameter.
    """
    marginal = to_marginal(prior) if isinstance(prior, dist.Distribution) else prior
    entry = PARAMETERS[name]
    below = above = 0.0
    if marginal.lower < entry.lower:
        below = float(
            torch.special.ndtr(marginal.to_control(torch.tensor(entry.lower, dtype=torch.float64)))
        )
    if marginal.upper > entry.upper:
        above = float(
            torch.special.ndtr(-marginal.to_control(torch.tensor(entry.upper, dtype=torch.float64)))
        )
    if below + above > _OUTSIDE:
        raise InputDataError(
            f"The prior of {name!r} gives a probability of {below + above:.2g} to values outside "
            f"[{entry.lower:g}, "
            f"{entry.upper:g}] {entry.unit}, which are impossible; use one with that support, "
            "such as "
            f"TruncatedNormal(mean, sd, lower={entry.lower:g})."
        )
    return marginal
