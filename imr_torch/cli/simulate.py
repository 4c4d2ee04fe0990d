"""Runs ``imr-torch simulate``."""

from argparse import Namespace

from imr_torch.characterization import medium_of
from imr_torch.cli.common import show_result, with_engine, write_result
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.float64 import linspace, tensor
from imr_torch.material import PARAMETERS, material
from imr_torch.observe import TraceSet
from imr_torch.simulate import (
    ACCURACIES,
    DESIGN,
    STEPPINGS,
    PolytropicSimulator,
    TransportSimulator,
    explain_growth,
)


def run_command(args: Namespace) -> None:
    """Simulate and write."""
    kind = material(args.model)
    values = args.set
    if set(values) != set(kind.names):
        raise InputDataError(
            f"--set: model {kind.key!r} has the parameters {', '.join(kind.names)}; got "
            f"{', '.join(values)}."
        )
    if args.physics == "polytropic":
        bubbles = PolytropicSimulator(stepping=STEPPINGS[args.accuracy])
    else:
        bubbles = TransportSimulator(accuracy=ACCURACIES[args.accuracy])
    bubbles = with_engine(bubbles, args)
    stated = args.medium.values if args.medium else {}
    uncertain = [name for name, (_, sd) in stated.items() if sd is not None]
    if uncertain:
        raise InputDataError(
            f"--medium gives {uncertain[0]} a standard deviation, and simulate makes one bubble; "
            "leave it out."
        )
    args.gel_medium = medium_of(TraceSet(()), args.medium)
    simulator = args.gel_medium.applied(bubbles)
    surroundings = simulator.conditions.surroundings
    times = linspace(0.0, args.until, args.frames)
    design = tensor([args.we, args.rinf])
    gel = PARAMETERS.pack(values)
    solution = simulator(gel[None], design, times)
    if not solution.ok.all():
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
    fragile = explain_growth(simulator, gel, design, times, (*kind.names, *DESIGN))
    if fragile:
        print(fragile)
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
        "fragile": fragile,
    }
    show_result(args, write_result(args, document))
