# %% [markdown]
# # Add a model
# Your gel obeys none of the laws that ship with the toolkit? Write yours in one file, as here: parameters, a stress term,
# a model. Nothing else changes; both simulators, the fit, the evidence and the design of experiments take it by its name.

# %%
import os
from collections.abc import Mapping
from typing import ClassVar

import torch
from scipy.integrate import quad
from torch import Tensor

from imr_torch.assimilate import EnsembleOptions, assimilate, weigh
from imr_torch.material import (
    PARAMETERS,
    Belief,
    LogNormal,
    Material,
    Parameter,
    Stress,
    automatic_slopes,
    register,
    register_term,
)
from imr_torch.material.elastic import NeoHookeanElasticity
from imr_torch.material.viscous import NewtonianViscosity
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
# Its name, its unit, how it is made dimensionless, its bounds, and the value at which it does nothing.

# %%
PARAMETERS.register(Parameter("G_mooney", "second Mooney-Rivlin modulus", "Pa", "pressure", 0.0, 1e6, 0.0, 1e-3, "kPa"))


# %% [markdown]
# ## A stress term
# It gets radius, velocity, rest radius and all parameters, dimensionless, for a whole batch at once. It returns $S$, the part
# of $dS/dt$ that is known from the state, and the factor of $dU/dt$ (none in an elastic gel). `switch` names the parameter
# that turns it off: where that is zero in a whole batch, the term is not even looked at. The solver needs derivatives too;
# they are found automatically, fast if the term says that it is analytic (no `abs`, no comparisons).


# %%
class MooneyElasticity:
    """``S = -G_2 (2 l - 1 - 1/l^2)`` with ``l = R/R_inf``."""

    names: ClassVar[tuple[str, ...]] = ("G_mooney",)
    switch: ClassVar[str] = "G_mooney"
    analytic: ClassVar[bool] = True

    def __call__(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
        stretch = radius / rest_radius
        value = -theta["G_mooney"] * (2.0 * stretch - 1.0 - stretch**-2)
        slope = -2.0 * theta["G_mooney"] * (stretch + stretch**-2)  # dS/d ln l
        return Stress(value, slope * velocity / radius, torch.zeros_like(value))


register_term(MooneyElasticity())


# %% [markdown]
# ## A model
# A set of terms with a name; take those that exist and add yours.


# %%
class MooneyRivlin(Material):
    """Mooney and Rivlin's solid beside a Newtonian dashpot."""

    key, title = "mooney", "Mooney-Rivlin KV"
    reference = "Mooney, J. Appl. Phys. 11 (1940)"
    terms = (NewtonianViscosity(), NeoHookeanElasticity(), MooneyElasticity())


mooney = register(MooneyRivlin())
print(mooney, "| free:", mooney.free)

# %% [markdown]
# ## Check it
# Against the integral that it stands for, and its rate against its own derivative. Your own tests should do the same.

# %%
one = torch.tensor([0.7, 0.3, 0.1], dtype=torch.float64)
theta = {"G_mooney": torch.tensor(1.0, dtype=torch.float64)}
rest, velocity = torch.full_like(one, 0.25), torch.tensor([-1.0, 2.0, -5.0], dtype=torch.float64)
stress = MooneyElasticity()(one, velocity, rest, theta)
for stretch, value in zip((one / rest).tolist(), stress.value.tolist(), strict=True):
    expected = -quad(lambda b: 0.5 * (4.0 * b**3 - 4.0 * b**-3) / (b**3 - 1.0), 1.0, stretch)[0]
    print(f"l = {stretch:.2f}: S = {value:+.6f}, by quadrature {expected:+.6f}")
    assert abs(value - expected) < 1e-9
slopes = automatic_slopes(MooneyElasticity(), one, velocity, rest, theta)
assert torch.allclose(stress.rate, slopes.radius.value * velocity)

# %% [markdown]
# ## A gel that remembers
# A term with memory carries states with a rate of their own. Here a stiff spring in series with a dashpot: the stress $Z$ of
# the spring grows as fast as that of a neo-Hookean one would and fades with the time $\tau_f$,
# $\dot Z = \dot S_\mathrm{spring} - Z/\tau_f$. The time has no value at which it does nothing; the modulus is the switch.

# %%
PARAMETERS.register(Parameter("G_fast", "modulus that fades", "Pa", "pressure", 0.0, 1e7, 0.0, 1e-3, "kPa"))
PARAMETERS.register(Parameter("tau_fast", "time in which it fades", "s", "time", 1e-9, 1.0, 1e-5, 1e6, "us"))


class FadingSpring:
    """``Z' = dS_e/dt - Z/De`` with the neo-Hookean ``S_e`` of the modulus ``G_fast``; ``S = Z``."""

    names: ClassVar[tuple[str, ...]] = ("G_fast", "tau_fast")
    switch: ClassVar[str] = "G_fast"
    states: ClassVar[int] = 1
    analytic: ClassVar[bool] = True

    def __call__(
        self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor], memory: Tensor
    ) -> Stress:
        rate = self.memory_rate(radius, velocity, rest_radius, theta, memory)
        return Stress(memory[0], rate[0], torch.zeros_like(memory[0]))

    def start(self, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Tensor:
        """Faded: the bubble lingers at its maximum."""
        return torch.zeros_like(rest_radius)[None]

    def memory_rate(
        self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor], memory: Tensor
    ) -> Tensor:
        spring = NeoHookeanElasticity()(radius, velocity, rest_radius, {"G": theta["G_fast"]})
        return spring.rate - memory / theta["tau_fast"]

    def fastest(self, theta: Mapping[str, Tensor]) -> Tensor:
        return 1.0 / theta["tau_fast"]


register_term(FadingSpring())


class FadingSolid(Material):
    """NHKV with a second spring that fades."""

    key, title = "fading", "Fading NHKV"
    reference = "this tutorial (2025)"
    terms = (NewtonianViscosity(), NeoHookeanElasticity(), FadingSpring())


register(FadingSolid())

# %% [markdown]
# ## Simulate
# Both models, and NHKV beside them, in one batch of either simulator.

# %%
base = {"G": 3000.0, "mu": 0.1}
gels = torch.stack([PARAMETERS.pack(base | extra) for extra in ({}, {"G_mooney": 1500.0}, {"G_fast": 2e4, "tau_fast": 1e-5})])
design = torch.tensor([550.0, 0.22], dtype=torch.float64)
times = torch.linspace(0.0, 2.5, 251, dtype=torch.float64)
for simulator in (PolytropicSimulator(), TransportSimulator(accuracy=ACCURACIES["fast"])):
    solution = simulator(gels, design, times)
    assert bool(solution.ok.all())
    smallest, rebound = solution.radius.amin(1), solution.radius[:, len(times) // 2 :].amax(1)
    print(type(simulator).__name__)
    for key, low, high in zip(("nhkv", "mooney", "fading"), smallest.tolist(), rebound.tolist(), strict=True):
        print(f"  {key:8s} smallest R* {low:.3f}, rebound {high:.3f}")

# %% [markdown]
# ## Fit
# The model is a candidate like any other. We make data of a Mooney-Rivlin gel and ask which model it was.

# %%
quick = PolytropicSimulator()
laboratory = SimulatedLaboratory(quick, gels[1], repeats=100)
batch = ExperimentBatch((laboratory.shoot(design, seed=1),), laboratory.noise)
common = {"G": LogNormal(3e3, 3.0), "mu": LogNormal(0.1, 3.0)}
prior = Belief.prior({"nhkv": common, "mooney": common | {"G_mooney": LogNormal(1e3, 3.0)}})
options = EnsembleOptions(members=8, scouts=32, starts=2) if SMOKE else None
result = weigh(assimilate(prior, batch, quick, seed=2, options=options), quick, seed=3)
posterior = update(result, evidences(result))
print({key: round(value, 4) for key, value in posterior.probabilities.items()})
part = posterior["mooney"]
for name, mean, sd in zip(part.names, part.means.tolist(), part.sds.tolist(), strict=True):
    entry = PARAMETERS[name]
    unit, scale = entry.display_unit or entry.unit, entry.display_scale
    print(f"  {name:9s} {scale * mean:8.4g} +- {scale * sd:.2g} {unit}")
assert posterior.probabilities["mooney"] > 0.9
