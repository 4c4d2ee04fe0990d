# %% [markdown]
# # Add a model
# You will be able to use a constitutive law of your own everywhere: simulation, fit, evidence, design. Takes some two
# minutes, most of them for compiling the new laws on one core.
#
# Your gel obeys none of the laws that ship with the toolkit? Write yours in one file, as here: parameters, a law, a model.
# Nothing else changes; both simulators and both engines, the fit, the evidence and the design of experiments take it by its
# name. Inside the project it is the same file, put into `imr_torch/material/`, and its test: whatever lies there is imported.

# %%
import os

import torch
from scipy.integrate import quad

from imr_torch.assimilate import SearchOptions, assimilate, weigh
from imr_torch.elementary import Scalar
from imr_torch.material import (
    PARAMETERS,
    LogNormal,
    Material,
    Parameter,
    StressTerm,
    derivatives,
    gel_response,
    register,
    register_term,
    wide_prior,
)
from imr_torch.material.elastic import NEO_HOOKEAN, neo_hookean
from imr_torch.material.viscous import NEWTONIAN
from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
from imr_torch.select import evidences, update
from imr_torch.simulate import ACCURACIES, PolytropicSimulator, TransportSimulator

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"

# %% [markdown]
# ## What a bubble asks of a gel
# One number: the stress integral $S = 2\int_R^\infty (\tau_{rr} - \tau_{\theta\theta})/r\,dr$, which adds to the pressure
# at the wall, and its time derivative. For an elastic gel with the strain energy $\hat W(b)$ at the hoop stretch $b$,
# $S = -\int_1^{R/R_\infty} \hat W'(b)/(b^3 - 1)\,db$.
#
# Take the second half of Mooney and Rivlin's energy, $W = \tfrac{G_2}{2}(I_2 - 3)$ with $I_2 = 2b^{-2} + b^4$. Then
# $S = -G_2\,(2l - 1 - l^{-2})$ with $l = R/R_\infty$.
#
# ## A parameter
# Its name, its unit, how it is made dimensionless, its bounds, the value at which it does nothing, and what is believed of it
# when nothing is known.

# %%
PARAMETERS.register(
    Parameter(
        "G_mooney",
        "second Mooney-Rivlin modulus",
        "Pa",
        "pressure",
        0.0,
        1e6,
        0.0,
        1e-3,
        "kPa",
        prior=LogNormal(1e3, 3.0),
    )
)


# %% [markdown]
# ## A law
# A plain function of scalars: radius, velocity, rest radius, and by their names the parameters that it reads, all
# dimensionless. It returns $S$, the part of $dS/dt$ that is known from the state, and the factor of $dU/dt$ (none in an elastic
# gel). The same source is called with tensors and compiled for numbers, and the derivatives that the solver needs are taken
# through it; so it is written with arithmetic and the functions of `imr_torch.elementary` (`exp`, `sqrt`, `where` ...). A law
# that needs other functions of torch may use them: it then runs on tensors only, and the toolkit says so once.
#
# `switch` names the parameter that turns the term off: where that is zero, the law is not called.


# %%
def mooney(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, G_mooney: Scalar
) -> tuple[Scalar, ...]:
    """``S = -G_2 (2 l - 1 - 1/l^2)`` with ``l = R/R_inf``."""
    stretch, inverse = radius / rest_radius, rest_radius / radius
    value = -G_mooney * (2.0 * stretch - 1.0 - inverse * inverse)
    slope = -2.0 * G_mooney * (stretch + inverse * inverse)  # dS/d ln l
    return value, slope * velocity / radius, 0.0


MOONEY = register_term(StressTerm(mooney, switch="G_mooney"))


# %% [markdown]
# ## A model
# A set of terms with a name; take those that exist and add yours.


# %%
reference = "Mooney, J. Appl. Phys. 11 (1940)"
springs = (NEWTONIAN, NEO_HOOKEAN, MOONEY)
print(register(Material("mooney", "Mooney-Rivlin KV", reference, springs)))

# %% [markdown]
# ## Check it
# Against the integral that it stands for, and its rate against its own derivative. Your own tests should do the same.

# %%
one = torch.tensor([0.7, 0.3, 0.1], dtype=torch.float64)
theta = {"G_mooney": torch.tensor(1.0, dtype=torch.float64)}
rest, velocity = (
    torch.full_like(one, 0.25),
    torch.tensor([-1.0, 2.0, -5.0], dtype=torch.float64),
)
stress, _ = gel_response([MOONEY], one, velocity, rest, theta)
for stretch, value in zip((one / rest).tolist(), stress.value.tolist(), strict=True):
    expected = -quad(
        lambda b: 0.5 * (4.0 * b**3 - 4.0 * b**-3) / (b**3 - 1.0), 1.0, stretch
    )[0]
    print(f"l = {stretch:.2f}: S = {value:+.6f}, by quadrature {expected:+.6f}")
    assert abs(value - expected) < 1e-9
(by_radius,) = derivatives(
    lambda radius: gel_response([MOONEY], radius, velocity, rest, theta)[0].value,
    (one,),
    analytic=MOONEY.compilable,
)
assert torch.allclose(stress.rate, by_radius * velocity)

# %% [markdown]
# ## A gel that remembers
# A law with memory takes its states after the rest radius and returns their rates after the three numbers. Here a stiff spring
# in series with a dashpot: the stress $Z$ of the spring grows as fast as that of a neo-Hookean one would and fades with the
# time $\tau_f$, $\dot Z = \dot S_\mathrm{spring} - Z/\tau_f$. The time has no value at which it does nothing; the modulus is
# the switch. `fastest` is the rate that explicit solvers must resolve.

# %%
PARAMETERS.register(
    Parameter(
        "G_fast",
        "modulus that fades",
        "Pa",
        "pressure",
        0.0,
        1e7,
        0.0,
        1e-3,
        "kPa",
        prior=LogNormal(1e4, 5.0),
    )
)
PARAMETERS.register(
    Parameter(
        "tau_fast",
        "time in which it fades",
        "s",
        "time",
        1e-9,
        1.0,
        1e-5,
        1e6,
        "us",
        prior=LogNormal(1e-5, 5.0),
    )
)


def fading_spring(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    held: Scalar,
    G_fast: Scalar,
    tau_fast: Scalar,
) -> tuple[Scalar, ...]:
    """``Z' = dS_e/dt - Z/De`` with the neo-Hookean ``S_e`` of the modulus ``G_fast``; ``S = Z``."""
    change = neo_hookean(radius, velocity, rest_radius, G_fast)[1] - held / tau_fast
    return held, change, 0.0, change


def fastest(G_fast: Scalar, tau_fast: Scalar) -> Scalar:
    return 1.0 / tau_fast


FADING_SPRING = register_term(
    StressTerm(fading_spring, switch="G_fast", states=1, fastest=fastest)
)

fading = (NEWTONIAN, NEO_HOOKEAN, FADING_SPRING)
register(Material("fading", "Fading NHKV", "this tutorial (2025)", fading))

# %% [markdown]
# ## Simulate
# Both models, and NHKV beside them, in one batch of either simulator. The engine is compiled anew with the new laws, which
# takes a minute the first time.

# %%
base = {"G": 3000.0, "mu": 0.1}
gels = torch.stack(
    [
        PARAMETERS.pack(base | extra)
        for extra in ({}, {"G_mooney": 1500.0}, {"G_fast": 2e4, "tau_fast": 1e-5})
    ]
)
design = torch.tensor([550.0, 0.22], dtype=torch.float64)
times = torch.linspace(0.0, 2.5, 251, dtype=torch.float64)
engine = (
    "torchdiffeq" if SMOKE else "compiled"
)  # the same numbers; tensors need no compilation
for simulator in (
    PolytropicSimulator(),
    TransportSimulator(accuracy=ACCURACIES["fast"], engine=engine),
):
    solution = simulator(gels, design, times)
    assert bool(solution.ok.all())
    smallest, rebound = (
        solution.radius.amin(1),
        solution.radius[:, len(times) // 2 :].amax(1),
    )
    print(type(simulator).__name__)
    for key, low, high in zip(
        ("nhkv", "mooney", "fading"), smallest.tolist(), rebound.tolist(), strict=True
    ):
        print(f"  {key:8s} smallest R* {low:.3f}, rebound {high:.3f}")

# %% [markdown]
# ## Fit
# The model is a candidate like any other. We make data of a Mooney-Rivlin gel and ask which model it was.

# %%
quick = PolytropicSimulator()
laboratory = SimulatedLaboratory(quick, gels[1], repeats=100)
batch = ExperimentBatch((laboratory.shoot(design, seed=1),), laboratory.noise)
prior = wide_prior(["nhkv", "mooney"])
options = SearchOptions(raw_samples=32, starts=2) if SMOKE else None
result = weigh(assimilate(prior, batch, quick, seed=2, options=options), quick, seed=3)
posterior = update(result, evidences(result))
print({key: round(value, 4) for key, value in posterior.probabilities.items()})
part = posterior["mooney"]
for name, mean, sd in zip(part.names, part.means.tolist(), part.sds.tolist(), strict=True):
    entry = PARAMETERS[name]
    unit, scale = entry.display_unit or entry.unit, entry.display_scale
    print(f"  {name:9s} {scale * mean:8.4g} +- {scale * sd:.2g} {unit}")
assert posterior.probabilities["mooney"] > 0.9
