"""What a user adds from outside the package: a file format, a constitutive model, an effect, an estimator of the information
gain. Run by ``test_extension.py``.

It prints one line for each, from the file to the answer, with polytropic bubbles.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import torch

from imr_torch import characterize, load_traces
from imr_torch.assimilate import SearchOptions
from imr_torch.campaign import Campaign, CampaignSettings, Optimal
from imr_torch.design import (
    ExpectedInformationGain,
    InformationEstimator,
    InformationGain,
    Plan,
    Shot,
    search_design,
)
from imr_torch.design.response import radii
from imr_torch.elementary import Scalar, exp
from imr_torch.gap import diagnose
from imr_torch.material import (
    PARAMETERS,
    Effect,
    LogNormal,
    Material,
    Parameter,
    StressTerm,
    TruncatedNormal,
    library,
    register,
    register_effect,
    register_term,
    wide_prior,
)
from imr_torch.material.elastic import NEO_HOOKEAN
from imr_torch.material.viscous import NEWTONIAN
from imr_torch.observe import (
    Given,
    RadiusTrace,
    Reader,
    SimulatedLaboratory,
    TraceSet,
    register_reader,
)
from imr_torch.simulate import PolytropicSimulator

# ---------------------------------------------------------------- a file format: "IMR", Rmax and
# R_inf in um, then us; um


def read(path: Path) -> TraceSet:
    _, top, rest, *rows = path.read_text().splitlines()
    time, radius = (
        1e-6
        * torch.tensor([[float(x) for x in row.split(";")] for row in rows], dtype=torch.float64).T
    )
    given = Given(
        max_radius_m=1e-6 * float(top), time_of_max_s=0.0, rest_radius_m=1e-6 * float(rest)
    )
    return TraceSet((RadiusTrace(path.stem, time, radius, str(path), given),))


register_reader(Reader("semicolons", lambda path, head: head.startswith(b"IMR\n"), read))

# ---------------------------------------------------------------- a constitutive model: a second
# spring, of Mooney and Rivlin

PARAMETERS.register(
    Parameter(
        "G_second",
        "second modulus",
        "Pa",
        "pressure",
        0.0,
        1e7,
        0.0,
        1e-3,
        "kPa",
        prior=LogNormal(5e3, 5.0),
    )
)


def mooney(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, G_second: Scalar
) -> tuple[Scalar, ...]:
    """``S = -G_2 (2 l - 1 - 1/l^2)`` with ``l = R/R_inf``."""
    stretch = radius / rest_radius
    inverse = rest_radius / radius
    value = -G_second * (2.0 * stretch - 1.0 - inverse * inverse)
    return value, -2.0 * G_second * (stretch + inverse * inverse) * velocity / radius, 0.0


SECOND = register_term(StressTerm(mooney, switch="G_second"))


register(  # two springs beside a dashpot
    Material(
        "two_springs",
        "Mooney-Rivlin KV",
        "Mooney, J. Appl. Phys. 11 (1940)",
        (NEWTONIAN, NEO_HOOKEAN, SECOND),
    )
)

# ---------------------------------------------------------------- an effect: a far-field pressure
# that fades, with its own shape

PARAMETERS.register(
    Parameter("surge", "far-field pressure that fades, over p_inf", "1", "none", -0.5, 0.5, 0.0)
)


def surge(time: Scalar, surge: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """``p = A exp(-2 t)`` and its derivatives."""
    value = surge * exp(-2.0 * time)
    return value, -2.0 * value, 4.0 * value


register_effect(
    Effect(
        "surge",
        "the far-field pressure fades",
        "driving",
        {"surge": TruncatedNormal(0.0, 0.1)},
        far_field=surge,
    )
)


# ---------------------------------------------------------------- an estimator of the information
# gain: a Gaussian channel a frame


@dataclass(frozen=True)
class GaussianChannel(InformationEstimator):
    """``1/2 log(1 + variance of the prediction/variance of the noise)``, summed over frames as if these were independent."""

    draws: int = 16

    def __call__(self, shot: Shot, generator: torch.Generator) -> InformationGain:
        """See :class:`InformationEstimator`."""
        nats = torch.zeros((), dtype=torch.float64)
        for part, weight in zip(
            shot.belief.models, shot.belief.log_probabilities.exp(), strict=True
        ):
            v = torch.randn(self.draws, len(part.names), generator=generator, dtype=torch.float64)
            seen = radii(shot, part, v)
            noise = shot.plan.noise.sd(seen, shot.plan.times).square().mean(0) / shot.plan.repeats
            nats = nats + 0.5 * weight * torch.log1p(seen.var(0) / noise).sum()
        count = self.draws * len(shot.belief.models)
        return InformationGain(float(nats), 0.0, variance=0.01, counted=count, drawn=count)


def main(folder: Path) -> None:
    """File, model, effect, estimator."""
    simulator = PolytropicSimulator()
    times = torch.linspace(0.0, 2.4, 73, dtype=torch.float64)
    gel = PARAMETERS.pack({"G": 2000.0, "mu": 0.1, "G_second": 8000.0})
    design = torch.tensor([400.0, 0.2], dtype=torch.float64)
    outer = simulator.conditions.surroundings
    top = float(outer.max_radius(design[0]))
    shot = SimulatedLaboratory(simulator, gel, repeats=1, times=times).shoot(design, seed=0)
    seconds = shot.times * outer.time_scale(top)
    lines = [
        f"{1e6 * t!r};{1e6 * top * r!r}"
        for t, r in zip(seconds.tolist(), shot.radius[0].tolist(), strict=True)
    ]
    file = folder / "gel.imr"
    file.write_text("\n".join(["IMR", repr(1e6 * top), repr(0.2e6 * top), *lines]))
    traces = load_traces(file)
    print("file", len(traces[0]), round(1e6 * float(traces[0].radius_m.max())))

    options = SearchOptions(raw_samples=48, starts=2)
    found = characterize(
        traces,
        prior=wide_prior(("nhkv", "two_springs")),
        simulator=simulator,
        options=options,
        medium="density=1060",
    )
    print("model", found.posterior.best.model, ",".join(found.posterior.best.names))

    laboratory = SimulatedLaboratory(
        simulator, PARAMETERS.pack({"G": 5000.0, "mu": 0.1, "surge": 0.08}), repeats=20, times=times
    )
    designs = torch.tensor([[300.0, 0.2], [700.0, 0.16], [500.0, 0.25]], dtype=torch.float64)
    shots = [laboratory.shoot(each, seed=i) for i, each in enumerate(designs)]
    rivals = library(("surge", "far_field_pressure", "sound_speed", "gas_loss"))
    report = diagnose(shots, effects=rivals, noise=laboratory.noise, simulator=simulator)
    print("effect", report.verdict, "+".join(report.cause))

    prior = wide_prior(("nhkv", "two_springs"))
    plan = Plan()
    own = GaussianChannel()
    acquisition = ExpectedInformationGain(prior, simulator, own, plan=plan)
    search = search_design(acquisition, seed=0, q=2, evaluations=4, initial=3)
    settings = CampaignSettings(plan=plan, policy=Optimal(own, evaluations=3, initial=2))
    campaign = Campaign(folder / "campaign", prior, simulator, settings=settings, seed=0)
    asked = campaign.ask()
    again = Campaign(folder / "campaign", prior, simulator, settings=settings, seed=0).ask()
    print(
        "estimator",
        len(search.chosen),
        asked.gain is not None,
        torch.equal(asked.design, again.design),
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
