"""Inference of the parameters of one gel and of the probability of each constitutive model from
measured R(t) curves.

The noise is first the published law; then that of single frames is inferred beside any smooth
misfit of the best model, enlarged for what its residuals have in common, and the fit repeated.
Posterior and evidence integrate over the noise.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from imr_torch.assimilate import (
    NOISE_ROUNDS,
    FitOptions,
    SearchOptions,
    WeighingOptions,
    assimilate_estimating_noise,
    noise_nodes,
    weigh,
)
from imr_torch.assimilate.spikes import frames_left_out
from imr_torch.characterization.request import EFFORTS, check_request, medium_of
from imr_torch.characterization.result import Characterization
from imr_torch.errors import about_experiment
from imr_torch.gap import medium_sensitivities
from imr_torch.goodness import check_fit, compare_parts, follow_gel
from imr_torch.material import Belief, wide_prior
from imr_torch.observe import (
    CollapseShot,
    ExperimentBatch,
    GelMedium,
    Noise,
    Prepared,
    Statement,
    TraceSet,
    prepare,
)
from imr_torch.observe.convert import find_frame_use
from imr_torch.population import fit_shots, infer_population
from imr_torch.random import child
from imr_torch.record import ALL_ALIKE, RecordOptions, describe_record
from imr_torch.select import evidences, update
from imr_torch.simulate import ACCURACIES, Simulator, TransportSimulator
from imr_torch.simulate.growth import check_reversible
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress, report_progress


@one_torch_thread()
def characterize(
    traces: TraceSet,
    *,
    prior: Belief | None = None,
    simulator: Simulator | None = None,
    estimate_noise: bool = True,
    collapses: int = 2,
    rest_radius: tuple[float, float] | None = None,
    growth: float | None = None,
    options: FitOptions | None = None,
    check: bool = True,
    effort: str = "normal",
    medium: GelMedium | Statement | str | None = None,
    shots: Sequence[CollapseShot] = (),
    weigh_odd_shots: bool = True,
    population: bool = False,
    over_time: bool = False,
    seed: int = 0,
    on_prepared: Callable[[Prepared], object] | None = None,
    progress: Progress = None,
) -> Characterization:
    """Infer properties and model probabilities from measured curves of one gel.

    Args:
        traces: the curves.
        prior: what is believed before; the wide prior when not given.
        simulator: makes the bubbles; with heat and vapour transport by default.
        estimate_noise: whether the law of the observation noise is inferred
            (:func:`imr_torch.assimilate.infer_frame_noise`) and integrated over; not where fewer
            than ten degrees of freedom are left. Else it is the published one.
        collapses: collapses that the fitted window holds.
        rest_radius: assumed R_inf/Rmax and its standard deviation, for records that do not hold it.
        growth: R/Rmax above which frames before the maximum are fitted too
            (:mod:`imr_torch.simulate.growth`); none when not given.
        options: how gels are fitted, and by which method:
            :class:`imr_torch.assimilate.SearchOptions` or
            :class:`imr_torch.assimilate.En4DVarOptions`.
        check: whether to test if the most probable model explains the curves
            (:func:`imr_torch.goodness.check_fit`), and if the parts of the records agree
            (:func:`imr_torch.goodness.compare_parts`).
        effort: how far draws are weighted where they do not settle the intervals: ``"normal"`` or
            ``"thorough"``, see ``EFFORTS``.
        medium: density, sound speed, surface tension, temperature and ambient pressure of the gel,
            for example ``"water,temperature=310,density=1125:11"``
            (:mod:`imr_torch.observe.medium`); it counts before what the files state, and that
            before the simulator's surroundings. What has a standard deviation is inferred with the
            gel.
        shots: shots of which the collapse time alone is known
            (:func:`imr_torch.observe.load_collapse_times`), beside curves or alone. With
            ``estimate_noise`` a further error of their times is estimated from their scatter about
            the fit; that and, beside such shots, the noise of the curves are plugged in and not
            integrated over.
        weigh_odd_shots: whether a shot that stands out from its set by its record alone counts
            little in the fits (:meth:`imr_torch.record.Record.weighted`), or as much as the others.
        population: whether each curve is also fitted by itself, under the most probable model, and
            how much the gel differs between them is inferred (:mod:`imr_torch.population`).
        over_time: whether the gel of one stretch of the event after another is fitted too
            (:func:`imr_torch.goodness.follow_gel`), under the most probable model.
        seed: of everything random.
        on_prepared: called with the curves as they will be fitted, before the first fit.
        progress: called with one line per step.

    Raises:
        UnsupportedError: for growth of a gel that remembers, or under a driving pressure.
        InputDataError: as in :func:`imr_torch.observe.prepare`, without a trace, or for a
            population of only one.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, characterize, wide_prior
    >>> from imr_torch.assimilate import SearchOptions
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import RadiusTrace, TraceSet
    >>> from imr_torch.units import Surroundings
    >>> simulator, size, times = PolytropicSimulator(), 221e-6, torch.linspace(0.0, 2.2, 23, dtype=torch.float64)
    >>> bubble = simulator(PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), torch.tensor([200.0, 0.2]).double(), times)
    >>> trace = RadiusTrace("shot 1", times * Surroundings().time_scale(size), size * bubble.radius, "example")
    >>> result = characterize(
    ...     TraceSet((trace,)),
    ...     prior=wide_prior(["nhkv"]),
    ...     simulator=simulator,
    ...     estimate_noise=False,
    ...     rest_radius=(0.2, 0.002),
    ...     medium="density=1060",
    ...     options=SearchOptions(raw_samples=16, starts=2),
    ... )
    >>> [round(x, 1) for x in (result.posterior["nhkv"].means / torch.tensor([8310.0, 0.093])).tolist()]  # over the truth
    [1.0, 1.0]
    """
    started = time.process_time()
    prior = prior or wide_prior()
    check_request(
        traces,
        shots,
        prior,
        population=population,
        effort=effort,
    )
    simulator = simulator or TransportSimulator(accuracy=ACCURACIES["search"])
    medium = medium_of(traces, medium, simulator.conditions.surroundings, shots)
    simulator = medium.applied(simulator)
    prior = medium.believed(prior)
    surroundings = simulator.conditions.surroundings
    if growth is not None:
        for part in prior.models:
            check_reversible(part.model, part.material.names, simulator)
    prepared = prepare(
        traces, surroundings, collapses=collapses, rest_radius=rest_radius, growth=growth
    )
    if on_prepared:
        on_prepared(prepared)
    record = describe_record(
        traces, surroundings, options=RecordOptions() if weigh_odd_shots else ALL_ALIKE
    )
    prepared = replace(prepared, experiments=record.weighted(prepared.experiments))
    traces = prepared.traces
    collapse_times = []
    for shot in shots:
        with about_experiment(shot.experiment_id):
            collapse_times.append(shot.to_experiment(surroundings))
    data = (*prepared.experiments, *collapse_times)
    rounds = NOISE_ROUNDS if estimate_noise else 0
    spent = EFFORTS[effort]
    if isinstance(options, SearchOptions) and options.drop_behind is not None:
        spent = replace(spent, behind=options.drop_behind)
    batch = ExperimentBatch(data, Noise())
    fits = assimilate_estimating_noise(
        prior,
        batch,
        simulator,
        rounds=rounds,
        seed=child(seed, "fit"),
        options=options,
        progress=progress,
    )
    weighted = weigh(
        fits,
        simulator,
        seed=child(seed, "weigh"),
        rounds=spent.rounds_for(fits.batch),
        drop_behind=spent.behind,
        options=WeighingOptions(hopeless=spent.hopeless),
        noise=noise_nodes(fits, simulator),
        progress=progress,
    )
    evidence = evidences(weighted)
    posterior = update(weighted, evidence)
    best = posterior.best.model
    fitted = prepared.experiments
    prepared = replace(prepared, experiments=weighted.batch.curves)
    tested = parts = stretches = gels = None
    if len(traces):
        curves = weighted[best].of_curves(weighted.batch)
        if check:
            text = "fit test: does the model explain the curves?"
            report_progress(progress, text, stage="fit test")
            tested = check_fit(*curves, simulator, seed=child(seed, "check"))
            parts = compare_parts(*curves, simulator)
        if over_time:
            stretches = follow_gel(*curves, simulator)
    if population:
        own = child(seed, "population")
        alone = fit_shots(
            prior[best],
            prepared.experiments,
            simulator,
            noise=Noise(),
            rounds=rounds,
            seed=own,
            progress=progress,
        )
        text = "population: scatter of the gel"
        report_progress(progress, text, stage="population")
        gels = infer_population(alone, seed=own)
    used = tuple(
        find_frame_use(
            trace,
            prepared.landmarks[trace.experiment_id],
            experiment,
            surroundings,
            collapses=collapses,
        )
        for trace, experiment in zip(traces, prepared.experiments, strict=True)
    )
    moved = medium_sensitivities(weighted[best], weighted.batch, simulator, medium)
    return Characterization(
        prepared,
        weighted,
        evidence,
        posterior,
        time.process_time() - started,
        used,
        tested,
        parts,
        stretches,
        medium,
        moved,
        frames_left_out(fitted, prepared.experiments),
        gels,
        traces,
        simulator,
        record,
    )
