"""The same bubbles by this package, by PyIMR 0.1.1, by torchdiffeq and by SciPy: what each costs,
and how far apart they are.

  python -m benchmarks.peers --python python3.12 [--parts same,cost] [--out benchmarks/records/peers.jsonl]

PyIMR gets an environment of its own (``--python`` makes it in ``--env``, a temporary folder by
default; pip fetches it), and is left out, with the reason, where that fails. Bubbles are NHKV gels
(G 1-20 kPa, mu .03-.3 Pa s, log-uniform; R_inf* .14-.30) at We 400, 81 samples of t* in [0, 4]. Times
are of process CPU, one thread, medians over rounds in which all take turns, each time with new
bubbles; what is compiled once is timed apart. torchdiffeq and SciPy get their own polytropic
right-hand side of Keller-Miksis, written here.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torchdiffeq import odeint

from benchmarks.pyimr_process import (
    FULL,
    KAPPA,
    OUTER,
    SIZE,
    TAIT,
    TIMES,
    Bubbles,
    Peer,
)
from benchmarks.records import start_parser
from imr_torch.elementary import Scalar
from imr_torch.float64 import tensor, zeros
from imr_torch.material import PARAMETERS
from imr_torch.simulate import (
    ACCURACIES,
    Conditions,
    Gilmore,
    KellerMiksis,
    KellerMiksisEnthalpy,
    MieGruneisen,
    PolytropicGas,
    PolytropicSimulator,
    RadialEquation,
    RayleighPlesset,
    Simulator,
    Stepping,
    Tait,
    TransportSimulator,
)
from imr_torch.simulate.liquids import mie_gruneisen
from tests.conformance.imrv2 import WholeRateGilmore

POLYTROPIC = Conditions(gas=PolytropicGas(KAPPA, "rest", vapour=False))
FIT = {"rtol": 1e-6, "atol": 1e-8}  # what PyIMR recommends for fits
FINE = {"rtol": 1e-11, "atol": 1e-13}
PARTS = ("same", "cost", "explain")
"""Are bubbles the same; what they cost; which terms differ in full physics."""


def draw_bubbles(count: int, seed: int) -> Bubbles:
    """R0 and Req in m, G in Pa, mu in Pa s of each."""
    random = np.random.default_rng(seed)
    rest = SIZE * random.uniform(0.14, 0.30, count)
    modulus = 1e3 * 20.0 ** random.uniform(0.0, 1.0, count)
    viscosity = 0.03 * 10.0 ** random.uniform(0.0, 1.0, count)
    return np.stack([np.full(count, SIZE), rest, modulus, viscosity], 1).tolist()


def solve_here(simulator: Simulator, bubbles: Bubbles) -> np.ndarray:
    """By this package."""
    _, rest, modulus, viscosity = tensor(bubbles).unbind(1)
    designs = torch.stack((torch.full_like(rest, 400.0), rest / SIZE), 1)
    gels = PARAMETERS.pack({"G": modulus, "mu": viscosity})
    return simulator(gels, designs, torch.from_numpy(TIMES)).radius.numpy()


def keller_miksis(y: Any, bubble: Any) -> tuple[Any, Any]:
    """``(U, U')`` of polytropic gas in a neo-Hookean Kelvin-Voigt gel, in units of p_inf, rho and
    Rmax; arrays or tensors.
    """
    radius, velocity = y
    scale = OUTER.far_field_pressure
    rest = bubble[1] / SIZE
    modulus = bubble[2] / scale
    viscosity = bubble[3] / (scale * float(OUTER.time_scale(SIZE)))
    slowness = OUTER.velocity_scale / OUTER.sound_speed
    tension = 2.0 * OUTER.surface_tension / (scale * SIZE)
    gas = (1.0 + tension / rest) * (rest / radius) ** (3.0 * KAPPA)
    strain = velocity / radius
    stretch = rest / radius
    elastic = -0.5 * modulus * (5.0 - 4.0 * stretch - stretch**4)
    wall = gas - tension / radius + elastic - 4.0 * viscosity * strain - 1.0
    rate = strain * (-3.0 * KAPPA * gas + tension / radius + 4.0 * viscosity * strain)
    rate = rate - 2.0 * modulus * strain * (stretch + stretch**4)
    mach = slowness * velocity
    force = (
        (1.0 + mach) * wall
        + slowness * radius * rate
        - 1.5 * (1.0 - mach / 3.0) * velocity**2
    )
    return velocity, force / ((1.0 - mach) * radius + 4.0 * slowness * viscosity)


def solve_scipy(bubbles: Bubbles, rtol: float) -> np.ndarray:
    """One by one."""
    return np.array(
        [
            solve_ivp(
                lambda _, y, b=bubble: keller_miksis(y, b),
                (0.0, TIMES[-1]),
                [1.0, 0.0],
                "LSODA" if rtol > 1e-10 else "DOP853",
                TIMES,
                rtol=rtol,
                atol=1e-2 * rtol,
            ).y[0]
            for bubble in bubbles
        ]
    )


def solve_torchdiffeq(bubbles: Bubbles) -> np.ndarray:
    """All together, with one adaptive step."""
    columns = tensor(bubbles).unbind(1)
    start = zeros(2, len(bubbles))
    start[0] = 1.0
    path = odeint(
        lambda _, y: torch.stack(keller_miksis(y, columns)),
        start,
        torch.from_numpy(TIMES),
        method="dopri5",
        rtol=1e-6,
        atol=1e-8,
    )
    assert isinstance(path, torch.Tensor)
    return path[:, 0].T.numpy()


def from_zero(
    pressure: Scalar, slowness: Scalar, slope: Scalar, bend: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """The density of the undisturbed liquid is that at no pressure."""
    return mie_gruneisen(pressure + 1.0, slowness, slope, bend)


@dataclass(frozen=True)
class FromZero(MieGruneisen):
    """PyIMR's Mie-Gruneisen liquid, with its constants."""

    slope: float = 2.65
    bend: float = 0.5 * (7.15 - 1.0)
    law = staticmethod(from_zero)


def timed(
    work: Callable[[Bubbles], np.ndarray],
) -> Callable[[Bubbles], tuple[np.ndarray, float]]:
    """The same with its CPU seconds."""

    def measured(bubbles: Bubbles) -> tuple[np.ndarray, float]:
        begun = time.process_time()
        return work(bubbles), time.process_time() - begun

    return measured


def solvers_of(peer: Peer | None) -> dict[str, tuple[Any, str, int, bool]]:
    """Name -> what solves a list of bubbles, its physics, bubbles a call, and whether it is slow."""
    here = timed(lambda x: solve_here(PolytropicSimulator(POLYTROPIC, threads=1), x))
    full = timed(lambda x: solve_here(TransportSimulator(threads=1), x))
    found: dict[str, tuple[Any, str, int, bool]] = {
        "imr_torch, 1": (here, "polytropic", 1, False),
        "imr_torch, 48": (here, "polytropic", 48, False),
        "SciPy LSODA, 1": (timed(lambda x: solve_scipy(x, 1e-6)), "polytropic", 1, False),
        "torchdiffeq dopri5, 48": (timed(solve_torchdiffeq), "polytropic", 48, True),
        "imr_torch full, 1": (full, "full", 1, False),
        "imr_torch full, 48": (full, "full", 48, False),
    }
    if peer is None:
        return found

    def theirs(batch: bool, **options: Any) -> Any:
        return lambda x: peer.solve(x, FIT | options, batch=batch)

    grid = {**FULL, "thermal": "fd"}
    found |= {
        "PyIMR, 1": (theirs(False, radial=2), "polytropic", 1, False),
        "PyIMR, 48": (theirs(True, radial=2), "polytropic", 48, False),
        "PyIMR full FD 25 x 25, 1": (theirs(False, **grid, Nt=25, Mt=25), "full", 1, False),
        "PyIMR full FD 25 x 25, 48": (theirs(True, **grid, Nt=25, Mt=25), "full", 48, True),
        "PyIMR full FD 100 x 100, 1": (
            theirs(False, **grid, Nt=100, Mt=100),
            "full",
            1,
            True,
        ),
    }
    return found


def measure_costs(peer: Peer | None, rounds: int) -> list[dict[str, Any]]:
    """First call, then all in turn; the error is the largest in R* against the finest solution."""
    solvers = solvers_of(peer)
    first = {}
    for name, (work, _, count, _) in solvers.items():
        first[name] = work(draw_bubbles(count, 1))[1]
        print(name, "first call", round(first[name], 2), "s", flush=True)
    taken: dict[str, list[float]] = {name: [] for name in solvers}
    errors: dict[str, list[float]] = {name: [] for name in solvers}
    sharp = TransportSimulator(accuracy=ACCURACIES["reference"], threads=1)
    for number in range(rounds):
        for name, (work, physics, count, slow) in solvers.items():
            if slow and number >= max(1, rounds // 3):
                continue
            bubbles = draw_bubbles(count, 100 + number)
            radius, seconds = work(bubbles)
            taken[name].append(1e3 * seconds / count)
            few = bubbles[:6]
            finest = (
                solve_scipy(few, 1e-11)
                if physics == "polytropic"
                else solve_here(sharp, few)
            )
            errors[name] += np.abs(radius[: len(few)] - finest).max(1).tolist()
    return [
        {
            "key": f"cost/{name}",
            "first_call_s": round(first[name], 3),
            "ms_a_bubble": round(float(np.median(taken[name])), 4),
            "calls": len(taken[name]),
            "median_error": float(f"{np.median(errors[name]):.2g}"),
            "worst_error": float(f"{np.max(errors[name]):.2g}"),
        }
        for name in solvers
    ]


def largest_difference(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Over bubbles and samples, relative."""
    return float(f"{np.abs(ours / theirs - 1.0).max():.2g}")


def compare_fluids(peer: Peer, bubbles: Bubbles) -> list[dict[str, Any]]:
    """Polymers in a solvent without elasticity, polytropic; the extensibility of PyIMR is ours times
    the relaxation time over ``Rmax/U_c``.
    """
    times = {"relaxation_time_s": 5e-6, "retardation_time_s": 1e-6}
    deborah = times["relaxation_time_s"] / float(OUTER.time_scale(SIZE))
    fluids: dict[str, tuple[str, dict[str, float], dict[str, float]]] = {
        "Oldroyd-B": ("OldroydB", {}, {"tau_ucm": 5e-6}),
        "Giesekus": (
            "Giesekus",
            {"mobility": 0.3},
            {"tau_giesekus": 5e-6, "mobility": 0.3},
        ),
        "linear Phan-Thien-Tanner": (
            "LinearPTT",
            {"extensibility": 0.2 * deborah},
            {"tau_ptt": 5e-6, "extensibility": 0.2},
        ),
    }
    rows = []
    for name, (law, theirs, ours) in fluids.items():
        gels = PARAMETERS.pack({"mu": tensor(bubbles)[:, 3], "retardation": 0.2, **ours})
        rest = tensor(bubbles)[:, 1] / SIZE
        designs = torch.stack((torch.full_like(rest, 400.0), rest), 1)
        fine = PolytropicSimulator(POLYTROPIC, Stepping(0.03, max_steps=10**5), threads=1)
        radius = fine(gels, designs, torch.from_numpy(TIMES)).radius.numpy()
        options = {"rtol": 1e-9, "atol": 1e-11, "radial": 2}
        beside, _ = peer.solve(bubbles, options, material=(law, times | theirs))
        rows.append({"key": f"same/{name}", "largest": largest_difference(radius, beside)})
    return rows


def compare_trajectories(peer: Peer) -> list[dict[str, Any]]:
    """Where both are converged: every equation that both have, polytropic; then full physics on
    grids that are refined.
    """
    bubbles = draw_bubbles(4, 7)
    own_speed = (7.15 * (OUTER.far_field_pressure + TAIT) / OUTER.density) ** 0.5
    tait = Tait()
    steep = MieGruneisen(slope=FromZero.slope, bend=FromZero.bend)
    outer = OUTER.sound_speed
    cases: dict[str, tuple[RadialEquation, int, float]] = {
        "Rayleigh-Plesset": (RayleighPlesset(), 1, outer),
        "Keller-Miksis": (KellerMiksis(), 2, outer),
        "Keller-Miksis, enthalpy, Tait": (KellerMiksisEnthalpy(tait), 3, outer),
        "Keller-Miksis, enthalpy, Mie-Gruneisen, from zero": (
            KellerMiksisEnthalpy(FromZero()),
            5,
            outer,
        ),
        "Keller-Miksis, enthalpy, Mie-Gruneisen": (KellerMiksisEnthalpy(steep), 5, outer),
        "Gilmore, Tait, whole rate": (WholeRateGilmore(tait), 4, own_speed),
        "Gilmore, Tait": (Gilmore(tait), 4, own_speed),
        "Gilmore, Mie-Gruneisen, whole rate, from zero": (
            WholeRateGilmore(FromZero()),
            6,
            outer,
        ),
        "Gilmore, Mie-Gruneisen": (Gilmore(steep), 6, outer),
    }
    # by tensors: the peer's forms need not be compiled
    fine = Stepping(0.03, max_steps=10**5)
    rows = []
    for name, (motion, radial, speed) in cases.items():
        beside = replace(OUTER, sound_speed=speed)
        conditions = replace(POLYTROPIC, surroundings=beside, motion=motion)
        ours = solve_here(
            PolytropicSimulator(conditions, fine, engine="torchdiffeq"), bubbles
        )
        theirs, _ = peer.solve(bubbles, FINE | {"radial": radial}, sound_speed_m_s=speed)
        rows.append({"key": f"same/{name}", "largest": largest_difference(ours, theirs)})
    rows += compare_fluids(peer, bubbles)
    few = bubbles[:2]
    options = {"warm gel": FULL, "cold gel": FULL | {"medtherm": 0}}
    for name, physics in options.items():
        conditions = Conditions()
        if name == "cold gel":
            conditions = replace(conditions, medium=replace(conditions.medium, warm=False))
        sharp = TransportSimulator(conditions, ACCURACIES["reference"], threads=1)
        ours = solve_here(sharp, few)
        row: dict[str, Any] = {"key": f"same/full, {name}"}
        grids = {}
        for count in (25, 50, 100):
            grid = {"thermal": "fd", "Nt": count, "Mt": count, "rtol": 1e-8, "atol": 1e-10}
            grids[count] = peer.solve(few, physics | grid)[0]
            row[f"FD {count}"] = float(f"{np.abs(ours - grids[count]).max():.2g}")
        limit = grids[100] + (grids[100] - grids[50]) / 3.0  # of second order
        row["FD extrapolated"] = float(f"{np.abs(ours - limit).max():.2g}")
        rows.append(row)
    return rows


def explain_full_physics(python: str, folder: Path) -> list[dict[str, Any]]:
    """By Chebyshev grids, that in the gel fine at the wall: PyIMR as it is, and without terms that
    differ, by name; and what this package takes for the same bubble by default, with its error.
    """
    few = draw_bubbles(4, 7)[:1]
    conditions = Conditions()
    cold = replace(conditions, medium=replace(conditions.medium, warm=False))
    named = ("elastic heating", "wall temperature")
    cases = [
        *(("cold gel", cold, (), nodes, 3) for nodes in (17, 25, 33)),
        *(("warm gel", conditions, named[:count], 25, 30) for count in (0, 1, 2)),
        ("warm gel", conditions, named, 33, 40),
    ]
    rows = []
    for name, physics, without, nodes, outer in cases:
        peer = Peer(python, folder, without)
        ours = solve_here(
            TransportSimulator(physics, ACCURACIES["reference"], threads=1), few
        )
        usual = timed(partial(solve_here, TransportSimulator(physics, threads=1)))
        usual(draw_bubbles(2, 8)[:1])
        here, here_seconds = usual(few)
        grid = {"thermal": "spectral", "Nt": nodes, "Mt": outer, "rtol": 1e-7, "atol": 1e-9}
        options = FULL | grid | {"medtherm": int(physics.medium.warm)}
        theirs, _ = peer.solve(few, options, medium_grid_length=0.3)
        _, seconds = peer.solve(draw_bubbles(2, 8)[:1], options, medium_grid_length=0.3)
        rest = "".join(f", without {term}" for term in without)
        row = {"key": f"explain/full, {name}, spectral {nodes} x {outer}{rest}"}
        difference = float(f"{np.abs(ours - theirs).max():.2g}")
        row |= {"largest in R*": difference, "ms_a_bubble": round(1e3 * seconds, 1)}
        own_error = float(f"{np.abs(ours - here).max():.2g}")
        rows.append(row | {"own_error": own_error, "own_ms": round(1e3 * here_seconds, 2)})
        peer.stop()
    return rows


def main() -> None:
    """Measure, print, write."""
    parser = start_parser(__doc__)
    parser.add_argument(
        "--python", default="python3.12", help="interpreter of PyIMR, 3.12 or later"
    )
    parser.add_argument("--env", help="folder of PyIMR's environment, kept if named")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument(
        "--parts",
        default="same,cost",
        help=f"of {', '.join(PARTS)} (half an hour: explain)",
    )
    parser.add_argument("--out", help="JSON lines; rows of other parts stay")
    args = parser.parse_args()
    parts = args.parts.split(",")
    if not set(parts) <= set(PARTS):
        parser.error(f"--parts is {args.parts}; expected some of {', '.join(PARTS)}")
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        try:
            peer = Peer(args.python, Path(args.env or temporary))
        except (OSError, subprocess.CalledProcessError) as error:
            print(f"PyIMR is left out: {error}", file=sys.stderr)
            peer = None
        rows = []
        if peer and "same" in parts:
            rows += compare_trajectories(peer)
        if peer and "explain" in parts:
            rows += explain_full_physics(args.python, Path(args.env or temporary))
        if "cost" in parts:
            rows += measure_costs(peer, args.rounds)
    text = "".join(json.dumps(row) + "\n" for row in rows)
    print(text, end="")
    if args.out:
        out = Path(args.out)
        lines = out.read_text().splitlines(keepends=True) if out.exists() else []
        kept = [
            line for line in lines if json.loads(line)["key"].split("/")[0] not in parts
        ]
        out.write_text("".join(kept) + text)


if __name__ == "__main__":
    main()
