"""Runs ``imr-torch simulate``.

Its help and options are in :mod:`imr_torch.cli.options.simulate`.
"""

import argparse

import torch

from imr_torch.characterization import medium_of
from imr_torch.cli.common import (
    AnySimulator,
    parse_values,
    show_result,
    statement_of,
    with_engine,
    write_result,
)
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.material import PARAMETERS, material
from imr_torch.observe import TraceSet
from imr_torch.simulate import ACCURACIES, STEPPINGS, PolytropicSimulator, TransportSimulator

SIMULATORS: dict[tuple[str, str], AnySimulator] = {
    **{
        ("polytropic", name): PolytropicSimulator(stepping=stepping)
        for name, stepping in STEPPINGS.items()
    },
    **{
        ("transport", name): TransportSimulator(accuracy=accuracy)
        for name, accuracy in ACCURACIES.items()
    },
}
_LARGEST_WEBER = 1e5  # a bubble of 11 cm
_MOST_FRAMES = 1_000_000
_LATEST = 1000.0


def run(args: argparse.Namespace) -> None:
    """Simulate and write."""
    kind = material(args.model)
    values = parse_values(args.set, "--set")
    if set(values) != set(kind.names):
        raise InputDataError(
            f"--set: model {kind.key!r} has the parameters {', '.join(kind.names)}; got "
            f"{', '.join(values)}."
        )
    if not 2 <= args.frames <= _MOST_FRAMES:
        raise InputDataError(f"--frames is {args.frames}; expected 2 to {_MOST_FRAMES}.")
    if not 0.0 < args.until < _LATEST:
        raise InputDataError(
            f"--until is {args.until}; expected a time in Rmax/U_c above 0 and below {_LATEST:g}."
        )
    if not 0.0 < args.we <= _LARGEST_WEBER:
        raise InputDataError(
            f"--we is {args.we}; expected We = p_inf Rmax/(2 gamma) above 0, at most "
            f"{_LARGEST_WEBER:g}."
        )
    bubbles = with_engine(SIMULATORS[args.physics, args.accuracy], args)
    statement = statement_of(args)
    uncertain = (
        [name for name, (_, sd) in statement.values.items() if sd is not None] if statement else []
    )
    if uncertain:
        raise InputDataError(
            f"--medium gives {uncertain[0]} a standard deviation, and simulate makes one bubble; "
            "leave it out."
        )
    args.gel_medium = medium_of(TraceSet(()), statement)
    simulator = args.gel_medium.applied(bubbles)
    surroundings = simulator.conditions.surroundings
    times = torch.linspace(0.0, args.until, args.frames, dtype=torch.float64)
    design = torch.tensor([[args.we, args.rinf]], dtype=torch.float64)
    solution = simulator(PARAMETERS.pack(values)[None], design, times)
    if not bool(solution.ok.all()):
        raise ConvergenceError(solution.summary())
    print(args.gel_medium.report())
    max_radius = float(surroundings.max_radius(args.we))
    radius = solution.radius[0]
    pressure = solution.bubble_pressure[0]
    print(
        f"{kind.title}, Rmax {1e6 * max_radius:.1f} um: smallest sampled R* "
        f"{float(radius.min()):.4f}, largest sampled bubble "
        f"pressure {float(pressure.max()):.1f} p_inf, R* at the end {float(radius[-1]):.4f}"
    )
    time_s = times * float(surroundings.time_scale(max_radius))
    document = {
        "model": kind.key,
        "parameters": values,
        "design": {"We": args.we, "R_inf*": args.rinf, "Rmax_m": max_radius},
        "time_s": time_s.tolist(),
        "radius_m": (radius * max_radius).tolist(),
        "t_star": times.tolist(),
        "R_star": radius.tolist(),
        "U_star": solution.velocity[0].tolist(),
        "bubble_pressure_over_p_inf": pressure.tolist(),
    }
    show_result(args, write_result(args, document))
