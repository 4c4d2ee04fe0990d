"""The compiled engine against the tensor engine: every law of the registries, the same steps, the
same answer.
"""

import functools
import importlib.util
import os
import signal
import textwrap
import time
import warnings
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from imr_torch.errors import EngineWarning, PrecisionWarning
from imr_torch.float64 import arange
from imr_torch.material import LIBRARY, MATERIALS, PARAMETERS, PARTS, TERMS, StressTerm
from imr_torch.material.viscous import newtonian
from imr_torch.observe import predict  # noqa: F401 - the whole library of effects
from imr_torch.simulate import (
    RADIAL_EQUATIONS,
    Accuracy,
    Conditions,
    PolytropicGas,
    PolytropicSimulator,
    Resolution,
    Solution,
    Status,
    Stepping,
    TabulatedDriving,
    TransportSimulator,
    engines,
)
from imr_torch.simulate.compiled import build
from imr_torch.simulate.compiled.run import registry_of
from tests.processes import Processes
from tests.refusals import refused
from tests.simulate.bubble import (
    CLOSURES,
    EVERY_GEL,
    MOTIONS,
    gel,
    gel_of,
    grid,
    largest_difference,
    sine,
    tensor,
)
from tests.tables import for_each

SAME = 1e-9  # in R*, where both take the same steps; rounding grows at each collapse
TIMES = grid(1.5, 31)  # a collapse and what follows
COARSE = Accuracy(1e-3, Resolution(9, 12))
DESIGNS = tensor([300.0, 0.3], [700.0, 0.18])
EFFECTS = [
    effect
    for effect in LIBRARY.values()
    if effect.physical or {t.switch for t in TERMS} & set(effect.names)
]
LAWS = [
    term
    for term in TERMS
    if not any(term in kind.terms for kind in (*MATERIALS.values(), *PARTS.values()))
]
EVERY_CLOSURE = {
    **CLOSURES,
    "gas at rest, no vapour": Conditions(gas=PolytropicGas(1.4, "rest", vapour=False)),
    "table": Conditions(
        driving=TabulatedDriving((0.0, 1e-5, 3e-5, 5e-5), (0.0, 1e4, -5e3, 0.0))
    ),
    "moving start": Conditions(initial_velocity=-0.5),
}
EACH_ONCE = [
    x
    for x in MOTIONS
    if x in RADIAL_EQUATIONS.values() or x.key == "keller_miksis_enthalpy"
]
assert {x.key for x in EACH_ONCE} == {x.key for x in MOTIONS}
assert {x.liquid.key for x in EACH_ONCE} == {x.liquid.key for x in MOTIONS}
SIMULATORS = pytest.mark.parametrize(
    "kind", [TransportSimulator, PolytropicSimulator], ids=["transport", "polytropic"]
)


def coarse(kind) -> dict[str, Accuracy]:
    """Options of a grid on which the tensor engine takes a third of the time, which the steps of both
    engines share like any other.
    """
    return {"accuracy": COARSE} if kind is TransportSimulator else {}


def both(kind, gels: Tensor, designs: Tensor = DESIGNS, times: Tensor = TIMES, **options):
    """Solutions of the two engines."""
    options = coarse(kind) | options
    engines = (kind(engine=engine, **options) for engine in ("compiled", "torchdiffeq"))
    return tuple(simulator(gels, designs, times) for simulator in engines)


def assert_same(kind, gels: Tensor, designs: Tensor = DESIGNS, **options) -> None:
    """Everything the solutions of the two engines hold, and that something happened."""
    assert_equal(kind, *both(kind, gels, designs, **options))


def assert_equal(kind, ours: Solution, reference: Solution) -> None:
    assert torch.equal(ours.status, reference.status)
    assert ours.ok.all()
    if kind is TransportSimulator:
        assert torch.equal(ours.steps, reference.steps)
    assert largest_difference(ours.radius, reference.radius) < SAME
    scale = 1.0 + reference.velocity.abs()
    assert ((ours.velocity - reference.velocity).abs() / scale).max() < 1e2 * SAME
    assert (ours.bubble_pressure / reference.bubble_pressure - 1.0).abs().max() < 1e3 * SAME
    assert ours.radius.min() < 0.5


def gels_of_the_registries() -> dict[str, Tensor]:
    """A gel in which each law acts, by the name of the law."""
    plain = {"G": 4e3, "mu": 0.08}
    gels = {model: gel_of(model) for model in MATERIALS}
    gels |= {
        effect.name: gel(**plain | dict(zip(effect.names, effect.starts[0], strict=True)))
        for effect in EFFECTS
    }
    amplitudes = {
        term: {"Pa": 1e3}.get(PARAMETERS[term.switch].unit, 0.01) for term in LAWS
    }
    gels |= {
        term.name: gel(**plain, alpha=0.1, **{term.switch: size})
        for term, size in amplitudes.items()
    }
    assert len(gels) == len(MATERIALS) + len(EFFECTS) + len(LAWS), "two laws of one name"
    return gels


@functools.cache
def of_the_registries(kind) -> tuple[Solution, Solution]:
    """Solutions of the two engines for all those gels in one batch, since the tensor engine takes little longer for many."""
    return both(kind, torch.stack(list(gels_of_the_registries().values()))[:, None])


@SIMULATORS
@pytest.mark.parametrize(
    "row", range(len(gels_of_the_registries())), ids=gels_of_the_registries()
)
def test_that_every_law_is_the_same(kind, row):
    assert_equal(
        kind,
        *(
            Solution(*(x[row] for x in vars(found).values()))
            for found in of_the_registries(kind)
        ),
    )


@pytest.mark.parametrize(
    ("kind", "motion"),
    [
        *(
            pytest.param(PolytropicSimulator, x, id=f"polytropic-{x.key}-{x.liquid.key}")
            for x in MOTIONS
        ),
        *(
            pytest.param(TransportSimulator, x, id=f"transport-{x.key}-{x.liquid.key}")
            for x in EACH_ONCE
        ),
    ],
)
def test_that_every_radial_equation_is_the_same(kind, motion):
    """In every liquid; of the transport simulator, which calls the same two laws, every equation and
    every liquid. Where no sound is radiated the collapse is too hard for the coarse grid.
    """
    silent = motion.key == "rayleigh_plesset" and kind is TransportSimulator
    assert_same(
        kind,
        gel(G=4e3, mu=0.08, wall=0.1, compressibility=0.4),
        conditions=Conditions(motion=motion, driving=sine(1e4, 2e4)),
        **({"accuracy": Accuracy()} if silent else {}),
    )


@SIMULATORS
@for_each("conditions", EVERY_CLOSURE)
def test_that_all_conditions_are_the_same(kind, conditions):
    assert_same(kind, gel(G=4e3, mu=0.08), conditions=conditions)


@SIMULATORS
def test_that_a_batch_of_all_materials_is_the_same_as_each_alone_bit_for_bit(kind):
    together = kind(threads=1)(EVERY_GEL, DESIGNS[0], TIMES)
    for member, row in enumerate(EVERY_GEL):
        alone = kind(threads=1)(row, DESIGNS[0], TIMES)
        for name in ("radius", "velocity", "bubble_pressure", "status", "steps"):
            assert torch.equal(getattr(alone, name), getattr(together, name)[member])


@SIMULATORS
def test_that_threads_change_no_bit(kind):
    gels = EVERY_GEL.repeat(10, 1)
    one, three = (
        kind(threads=threads)(gels, DESIGNS[1], TIMES).radius for threads in (1, 3)
    )
    assert torch.equal(one, three)


@pytest.mark.parametrize(
    "accuracy",
    [COARSE, Accuracy(), Accuracy(1e-5, Resolution(24, 17))],
    ids=["9, 12", "default", "24, 17"],
)
def test_that_grids_of_any_size_are_the_same(accuracy):
    assert_same(TransportSimulator, gel(G=4e3, mu=0.08, tau=2e-6), accuracy=accuracy)


@SIMULATORS
@pytest.mark.parametrize("model", ["nhkv", "zener"])
def test_that_bundles_are_the_same_and_leaders_as_without_followers(kind, model):
    bundle = gel_of(model).repeat(2, 5, 1)
    bundle[:, 1:, PARAMETERS.index(["G"])] *= 1.0 + 1e-4 * arange(1, 5)[:, None]
    designs = DESIGNS[:, None]
    engines = [
        kind(engine=engine, **coarse(kind)) for engine in ("compiled", "torchdiffeq")
    ]
    ours, reference = (simulator.bundle(bundle, designs, TIMES) for simulator in engines)
    assert ours.ok.all()
    assert largest_difference(ours.radius, reference.radius) < SAME
    assert torch.equal(ours.radius[:, 0], engines[0](bundle[:, 0], DESIGNS, TIMES).radius)
    assert (ours.radius[:, 1:] - ours.radius[:, :1]).abs().amax() > 1e-6
    bundle[:, 2, PARAMETERS.index(["damage"])] = (
        1e-3  # a memory that the leader lacks changes the order of its sums
    )
    damaged, reference = (simulator.bundle(bundle, designs, TIMES) for simulator in engines)
    assert largest_difference(damaged.radius, reference.radius) < SAME
    assert largest_difference(damaged.radius[:, 0], ours.radius[:, 0]) < SAME
    assert largest_difference(damaged.radius[:, 2], ours.radius[:, 2]) > 1e-6


def followers(gels: Tensor, width: int) -> Tensor:
    """Gels and others that differ from them by some tenths of a percent in every parameter."""
    return gels[..., None, :] * (1.0 + 1e-3 * arange(width)[:, None])


@SIMULATORS
def test_that_a_follower_is_the_same_in_a_bundle_of_any_size_bit_for_bit(kind):
    """By every law; many followers are integrated eight at a time, few one by one."""
    bundles = followers(torch.stack(list(gels_of_the_registries().values())), 15)
    simulator = kind(**coarse(kind))
    whole = simulator.bundle(bundles, DESIGNS[0], TIMES)
    assert torch.isfinite(whole.radius).all()
    for members in ([0, 3], [0, 14, 1, 2, 3, 4], [0, *range(9, 0, -1)]):
        part = simulator.bundle(bundles[:, members], DESIGNS[0], TIMES)
        for name in ("radius", "velocity", "bubble_pressure"):
            assert torch.equal(getattr(part, name), getattr(whole, name)[:, members])
    # the bubble of the first, made once
    later = TIMES + 1e-3 * tensor(0.0, 0.0, 1.0)[:, None]
    twins = simulator.bundle(bundles[:, [0, 1, 0]], DESIGNS[0], later)
    alone = simulator.bundle(bundles[:, :2], DESIGNS[0], later[2])
    assert torch.equal(twins.radius[:, :2], whole.radius[:, :2])
    assert torch.equal(twins.radius[:, 2], alone.radius[:, 0])


@SIMULATORS
def test_that_a_follower_that_fails_disturbs_no_other(kind):
    bundle = followers(gel(G=4e3, mu=0.08), 8)
    good = kind().bundle(bundle, DESIGNS[0], TIMES).radius
    bundle[3, PARAMETERS.index(["G"])] = 1e200
    failed = kind().bundle(bundle, DESIGNS[0], TIMES).radius
    assert not torch.isfinite(failed[3]).all()
    others = [k for k in range(8) if k != 3]
    assert torch.equal(failed[others], good[others])


FAILURES = [
    (
        TransportSimulator,
        {"G": 4e3, "mu": 0.08},
        {"accuracy": Accuracy(max_steps=40)},
        Status.TOO_MANY_STEPS,
    ),
    (
        TransportSimulator,
        {"G": 1e5, "alpha": -1.0},
        {"accuracy": Accuracy()},
        Status.UNBOUNDED_ENERGY,
    ),
    (
        PolytropicSimulator,
        {"G": 4e3, "mu": 0.08},
        {"stepping": Stepping(max_steps=32)},
        Status.TOO_MANY_STEPS,
    ),
    (
        PolytropicSimulator,
        {"G": 4e3, "mu": 0.08},
        {"conditions": Conditions(initial_velocity=100.0)},
        Status.RUNAWAY,
    ),
    (PolytropicSimulator, {"G": 5e4, "alpha": -0.9}, {}, Status.UNBOUNDED_ENERGY),
]


@pytest.mark.parametrize(("kind", "values", "options", "status"), FAILURES)
def test_that_failures_have_the_same_status_and_the_same_good_beginning(
    kind, values, options, status
):
    designs = DESIGNS[:1] if kind is TransportSimulator else DESIGNS
    ours, reference = both(kind, gel(**values), designs, grid(2.2, 45), **options)
    assert torch.equal(ours.status, reference.status)
    assert (ours.status == status).all()
    shared = torch.isfinite(ours.radius) & torch.isfinite(reference.radius)
    # rounding grows without bound at a singularity, so its last frame is left out
    before = shared[:, :-1] & shared[:, 1:]
    assert (ours.radius - reference.radius)[:, :-1][before].abs().max() < SAME
    assert int(before.sum()) >= 2
    assert not torch.isfinite(ours.radius).all()


@SIMULATORS
def test_that_early_times_and_a_single_time_are_the_same(kind):
    for times in (tensor(-0.3, -0.1, 0.0, 1e-4, 0.4), tensor(0.0), tensor(-0.2)):
        ours, reference = both(kind, gel(G=4e3, mu=0.08), times=times)
        assert largest_difference(ours.radius, reference.radius) < SAME


def torch_only(
    radius: Tensor, velocity: Tensor, rest_radius: Tensor, mu: Tensor
) -> tuple[Tensor, ...]:
    value, rate, acceleration = newtonian(radius, velocity, rest_radius, mu)
    return value.clone(), rate, acceleration


@SIMULATORS
def test_that_a_law_without_a_compiled_form_runs_on_tensors_and_is_named_once(kind):
    engines._warn_once.cache_clear()
    simulator = kind(terms=(StressTerm(torch_only, switch="mu"),), **coarse(kind))
    designs = DESIGNS[:1]
    times = TIMES[:3]
    with pytest.warns(
        EngineWarning,
        match=r"torch_only has no compiled form; results are the same and take longer",
    ):
        ours = simulator(gel(mu=0.1), designs, times)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = simulator(gel(mu=0.1), designs, times[:2])
    assert torch.equal(ours.radius[:, :2], again.radius)
    known = kind(**coarse(kind))(gel(mu=0.1), designs, times)
    assert largest_difference(ours.radius, known.radius) < SAME


def test_that_a_law_without_a_compiled_form_is_no_obstacle_where_it_does_not_act(
    monkeypatch,
):
    monkeypatch.setattr(
        "imr_torch.simulate.bubbles.TERMS",
        [*TERMS, StressTerm(torch_only, switch="damage")],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert PolytropicSimulator()(gel(mu=0.1), DESIGNS, TIMES).ok.all()


def test_that_float32_runs_on_tensors_and_says_why_and_that_it_is_short():
    engines._warn_once.cache_clear()
    times = TIMES[:20]
    with (
        pytest.warns(EngineWarning, match="computes in float64, not in torch.float32"),
        pytest.warns(PrecisionWarning, match="float32 is too short for inference"),
    ):
        short = PolytropicSimulator()(gel(mu=0.1).float(), DESIGNS.float(), times.float())
    known = PolytropicSimulator()(gel(mu=0.1), DESIGNS, times)
    assert short.radius.dtype == torch.float32
    assert largest_difference(short.radius, known.radius) < 1e-4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"engine": "fortran"},
            "engine is 'fortran'; expected one of compiled, torchdiffeq",
        ),
        ({"threads": 0}, "threads is 0"),
    ],
)
@SIMULATORS
def test_that_unknown_engines_and_no_threads_are_named(kind, options, message):
    with refused(message):
        kind(**options)


def test_that_engine_and_threads_do_not_tell_simulators_apart():
    """A campaign may be resumed with another number of threads."""
    one = TransportSimulator(threads=1)
    other = TransportSimulator(threads=2, engine="torchdiffeq")
    assert one == other
    assert repr(one) == repr(other)
    assert replace(one, accuracy=Accuracy(1e-3)) != one


ONE_BUBBLE = """
    import torch
    from imr_torch.material import PARAMETERS
    from imr_torch.simulate import PolytropicSimulator
    design, times = torch.tensor([300.0, 0.3], dtype=torch.float64), torch.linspace(0.0, 1.0, 11, dtype=torch.float64)
    gel = PARAMETERS.pack({"G": torch.tensor(4e3, dtype=torch.float64), "mu": 0.1})
    print(float(PolytropicSimulator(threads=1)(gel, design, times).radius[-1]))
"""
ENGINE_OF_PYTHON = """
    from imr_torch.simulate.compiled import build
    build.source_of = lambda registry: (  # nothing of which is kept
        "def solve_polytropic(bundles, batch, *others):\\n"
        "    for result in (batch.curves, batch.status, batch.steps):\\n"
        "        result[...] = 1\\n"
        "solve_polytropic.overloads = ()"
    )
"""


def in_a_process(processes: Processes, script: str, env: dict[str, str]) -> tuple[str, str]:
    """Standard output and error of one bubble."""
    done = processes.run(textwrap.dedent(script), env=env)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def test_that_it_is_said_when_an_engine_is_compiled(tmp_path, processes):
    """That it is compiled once: see the next two tests."""
    cache = {"IMR_TORCH_CACHE": str(tmp_path)}
    end, said = in_a_process(processes, ENGINE_OF_PYTHON + ONE_BUBBLE, cache)
    assert float(end) == 1.0
    assert "compiling solve_polytropic" in said
    assert "compiled solve_polytropic in" in said


def test_that_the_engine_that_another_process_compiled_is_used(processes):
    ours = PolytropicSimulator(threads=1)(
        gel(G=4e3, mu=0.1), DESIGNS[0], grid(1.0, 11)
    ).radius[-1]
    theirs, said = in_a_process(processes, ONE_BUBBLE, {})
    assert float(theirs) == float(ours)
    assert "compil" not in said


def test_that_damaged_code_is_compiled_anew(tmp_path, capsys):
    path = tmp_path / "engine.py"
    path.write_text(
        "import numba\n\n\n@numba.njit(cache=True)\ndef solve(x):\n    return x + 1\n"
    )

    def called() -> tuple[int, bool]:
        """What the function of a module loaded anew returns, and whether it was compiled."""
        spec = importlib.util.spec_from_file_location("engine", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return build.call_announced(
            module, "solve", (1,)
        ), "compiled solve in" in capsys.readouterr().err

    assert [called(), called()] == [(2, True), (2, False)]
    for cached in (tmp_path / "__pycache__").glob("*.nb?"):  # as a full disk would leave it
        cached.write_bytes(cached.read_bytes()[: cached.stat().st_size // 2])
    assert [called(), called()] == [(2, True), (2, False)]


def test_that_a_folder_that_cannot_be_written_is_no_obstacle(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("IMR_TORCH_CACHE", str(tmp_path / "file" / "cache"))
    # not the one that other tests share; nothing is compiled
    module = build.load_engine.__wrapped__(registry_of(Conditions()))
    assert (
        "cannot be written, so compiled code is not kept; set IMR_TORCH_CACHE"
        in capsys.readouterr().err
    )
    assert hasattr(module, "solve_polytropic")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a system that forks")
def test_that_a_forked_process_has_threads_of_its_own():
    simulator = PolytropicSimulator(threads=2)
    many = gel(mu=0.1).expand(8, -1)
    before = simulator(many, DESIGNS[:1], TIMES).radius  # makes the threads
    child = os.fork()
    if child == 0:
        os._exit(
            0 if torch.equal(simulator(many, DESIGNS[:1], TIMES).radius, before) else 1
        )
    deadline = time.monotonic() + 60.0
    while (ended := os.waitpid(child, os.WNOHANG)) == (
        0,
        0,
    ) and time.monotonic() < deadline:
        time.sleep(0.05)
    if ended == (0, 0):
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    assert ended == (child, 0)
