"""What an unknown may be a function of: five kinds, each a Gaussian process.

- *material*: a stress ``S(R/R_inf, U/R)`` with the strain so far as memory, one function for all
  shots of the gel;
- *contents*: a pressure ``p(R/Rmax, U)`` with the same memory, one function for all shots;
- *drive*: a pressure ``p(t)``, each shot its own;
- *sample*: a causal kernel on the bubble's own flux, ``int K(s) d(R^2 U)/dt (t - s) ds`` and ``K R^2
  U``, one for all shots;
- *camera*: an error of the radius and of the time as functions of R and t, one for all shots.

The first four act inside the equation of motion. A kind gives columns: changes of the curves by
functions whose weights are standard normal at unit size. Covariances of functions of a state are
squared exponentials, by a Nystroem basis on states that the bubbles went through.
"""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.float64 import arange, eye
from imr_torch.unknown.shot import Path, Response, Shot

Columns = Callable[[int, Shot, Response], Float[Tensor, "values weights"]]
"""Number of a shot, the shot, its response -> what each weight makes there: a pressure over p_inf in each pulse, or errors
of radius and time in each frame, as of :meth:`Shot.reread`."""

BACKGROUND = 0.3
"""Size of what may be missing where the gel or the contents have no pressure of their own, p_inf."""

CAMERA_ERRORS = 0.1
"""Size of errors of the camera, in R* of a bubble of 200 um and in t*; at most three times as much is
tried, as of all sizes."""


def nystroem_basis(
    states: Float[Tensor, "points state"], *, most: int = 45, apart: float = 0.4
) -> Callable[[Float[Tensor, "points state"]], Float[Tensor, "points weights"]]:
    """Functions of a state whose squares sum to a squared-exponential covariance of unit size, on
    states that occurred (Nystroem); a call of the result has their values.

    Args:
        states: that occurred, in correlation lengths; nodes are chosen among them, each the farthest
            from those before it.
        most: nodes.
        apart: correlation lengths from which on a further node tells anything.
    """
    chosen = [0]
    distance = (states - states[0]).square().sum(1)
    while len(chosen) < most and float(distance.max()) > apart**2:
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (states - states[chosen[-1]]).square().sum(1))
    nodes = states[chosen]
    root = torch.linalg.cholesky(_covariance(nodes, nodes) + 1e-6 * eye(len(nodes)))

    def values(points: Tensor) -> Tensor:
        return torch.linalg.solve_triangular(
            root, _covariance(points, nodes).mT, upper=False
        ).mT

    return values


def _covariance(a: Tensor, b: Tensor) -> Tensor:
    return (-0.5 * torch.cdist(a, b).square()).exp()


def material_state(path: Path) -> Float[Tensor, "fine 3"]:
    """Stretch, strain rate and strain so far, in correlation lengths."""
    stretch = (path.radius / path.rest_radius).log()
    return torch.stack((stretch / 0.7, torch.asinh(path.rate), path.strain / 8.0), -1)


def contents_state(path: Path) -> Float[Tensor, "fine 3"]:
    """Radius, velocity and strain so far, in correlation lengths."""
    return torch.stack(
        (path.radius.log() / 0.7, torch.asinh(path.velocity), path.strain / 8.0), -1
    )


def function_of_state(
    state: Callable[[Path], Tensor], own: Callable[[Path], Tensor], paths: Sequence[Path]
) -> Columns:
    """One function of a state for all shots, in proportion to what the model has of its own there."""
    basis = nystroem_basis(torch.cat([state(path) for path in paths]))

    def columns(number: int, shot: Shot, response: Response) -> Tensor:
        path = response.path
        scale = (BACKGROUND**2 + own(path).square()).sqrt()
        return shot.average_pressure(path.times) @ (basis(state(path)) * scale[:, None])

    return columns


def function_of_time(paths: Sequence[Path], *, length: float = 0.25) -> Columns:
    """A function of time for each shot; ``length`` is its correlation length in t*."""
    longest = max((path.times for path in paths), key=len)
    basis = nystroem_basis(longest[:, None] / length)

    def columns(number: int, shot: Shot, response: Response) -> Tensor:
        times = response.path.times
        own = BACKGROUND * shot.average_pressure(times) @ basis(times[:, None] / length)
        width = own.shape[1]
        return torch.nn.functional.pad(
            own, (width * number, width * (len(paths) - 1 - number))
        )

    return columns


def flux_kernel(*, width: float = 0.1) -> Columns:
    """A causal kernel on the flux of the bubble beside a resistance; over 1.4 t* of a bubble of 200 um
    in steps of twice a width.
    """

    def columns(number: int, shot: Shot, response: Response) -> Tensor:
        path = response.path
        times = path.size * path.times
        flux = (path.size * path.radius).square() * path.velocity
        change = torch.gradient(flux, spacing=(times,))[0]
        size = 2 * len(flux)
        step = float(times[1] - times[0])
        delays = arange(0.0, 1.5, 2.0 * width)
        kernels = (-0.5 * ((times - delays[:, None]) / width).square()).exp()
        echoes = torch.fft.irfft(
            torch.fft.rfft(change, size) * torch.fft.rfft(kernels, size), size
        )
        terms = torch.cat((flux[None], step * echoes[:, : len(flux)])).mT
        return BACKGROUND * shot.average_pressure(path.times) @ terms

    return columns


def camera_errors(number: int, shot: Shot, response: Response) -> Tensor:
    """Smooth errors of the radius, in lengths of the film, above those of the time, t*, each over R
    and t.
    """
    radii = nystroem_basis(torch.linspace(0.0, 1.1, 40).double()[:, None] / 0.3)
    moments = nystroem_basis(torch.linspace(0.0, 4.0, 60).double()[:, None] / 0.8)
    by_radius = radii(response.prediction[:, None] / 0.3)
    by_time = moments(shot.batch.times[0][:, None] / 0.8)
    errors = torch.cat((by_radius, by_time), 1)
    return CAMERA_ERRORS * torch.block_diag(errors / response.path.size, errors)
