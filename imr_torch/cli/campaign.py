"""Runs ``imr-torch campaign``."""

import time
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

import torch

from imr_torch.campaign import (
    Campaign,
    CampaignSettings,
    Journal,
    Proposal,
)
from imr_torch.campaign.admission import check_whole
from imr_torch.characterization import medium_of
from imr_torch.cli.campaign_settings import check_goal, one_model, read_hidden, settings_of
from imr_torch.cli.common import (
    exact_medium,
    prior_of,
    refuse_options,
    report_result,
    with_medium,
)
from imr_torch.errors import InputDataError
from imr_torch.files import remove_temporaries
from imr_torch.material import PARAMETERS, Belief, ReferenceCase, reference_case
from imr_torch.observe import (
    Experiment,
    SimulatedLaboratory,
    find_files,
    load_traces,
    prepare,
)
from imr_torch.observe.medium import label
from imr_torch.random import child
from imr_torch.results import campaign_document
from imr_torch.simulate import Simulator


def run_command(args: Namespace) -> None:
    """Run a simulated campaign, or one step of a real one.

    Raises:
        KeyboardInterrupt: if the user stops it, with what to do next.
    """
    begun = _begun_with(args)
    if args.tell and args.case:
        raise InputDataError(
            "--tell gives real experiments and --case simulates them; give one of the two."
        )
    check_goal(args)
    if not args.tell:
        why = "is about told files and has no effect without --tell."
        refuse_options(args, ("layout", "rest_radius"), why)
    settings = settings_of(args)
    prior = prior_of(args) if begun is None else begun
    simulator, prior, medium = with_medium(args, prior)
    if args.case and medium.sds:
        raise InputDataError(
            f"--medium gives {label(next(iter(medium.sds)))} a standard deviation, and --case "
            "simulates a gel whose medium is known; state values alone."
        )
    print(medium.report())
    started = time.process_time()
    case = reference_case(args.case) if args.case else None
    if args.goal == "cause":
        prior = one_model(prior, case)
    campaign = _open_campaign(args, simulator, prior, settings)
    try:
        with campaign.journal.hold_lock():
            remove_temporaries(campaign.journal.folder, f"{args.command}.json", "*.png")
            proposals: Sequence[Proposal] = ()
            truth = None
            errors = {}
            if case:
                stopped = _run_simulated(campaign, case, args)
                part = campaign.belief[case.truth_model]
                means = dict(zip(part.names, part.means.tolist(), strict=True))
                truth = {name: case.truth[name] for name in means}
                errors = {name: abs(x / truth[name] - 1.0) for name, x in means.items()}
            else:
                proposals, stopped = _run_real(campaign, args)
            document = campaign_document(
                campaign, proposals=proposals, stopped=stopped, truth=truth
            ) | {
                "relative_error": errors,
                "cpu_seconds": time.process_time() - started,
                "medium_unstated": exact_medium(args, campaign.belief),
            }
            report_result(args, document)
            print(f"figures and journal in {campaign.journal.folder}")
    except KeyboardInterrupt:
        kept = (
            f"; what was finished is in {campaign.journal.path}, continue with --resume"
            if campaign.journal.events
            else ""
        )
        raise KeyboardInterrupt(f"interrupted{kept}") from None


def _begun_with(args: Namespace) -> Belief | None:
    """The prior of the campaign that is resumed, where no option names one; its case and its goal
    are as if they were given.
    """
    if not args.resume or any((args.models, args.known, args.belief, args.case)):
        return None
    start = Journal(args.out).find_event("start")
    if start is None:
        return None
    learner = start["settings"]["learner"]
    if learner["kind"] == "CauseLearner":
        args.goal = "cause"
        args.effects = args.effects or list(learner["effects"])
    args.case = start["note"].get("case")
    return None if args.case else Belief.from_dict(start["prior"])


def _open_campaign(
    args: Namespace, simulator: Simulator, prior: Belief, settings: CampaignSettings
) -> Campaign:
    """The campaign in ``--out``, if that is the one which the options mean to begin or to continue."""
    folder = Path(args.out)
    existing = Journal(folder).events
    if existing and not args.resume:
        raise InputDataError(
            f"{folder} holds a journal of {len(existing)} events; give --resume to continue it, "
            "or another --out."
        )
    if (args.resume or args.forget is not None) and not existing:
        option = "--resume" if args.resume else "--forget"
        raise InputDataError(
            f"{folder} holds no journal to resume; leave {option} away to start one."
        )
    stated = {
        "hidden": read_hidden(args),
        "medium": args.medium and args.gel_medium.to_dict(),
    }
    note = {"case": args.case} | {name: value for name, value in stated.items() if value}
    return Campaign(folder, prior, simulator, settings=settings, seed=args.seed, note=note)


def _run_simulated(campaign: Campaign, case: ReferenceCase, args: Namespace) -> str | None:
    """Shoot the secret gel of a reference case; why it ended early, if it did."""
    progress = args.terminal.plan_stages()
    plan = campaign.settings.plan
    gels = PARAMETERS.pack({**case.truth, **read_hidden(args)})
    laboratory = SimulatedLaboratory(
        campaign.simulator, gels, noise=plan.noise, repeats=plan.repeats
    )

    def shoot_gel(design: torch.Tensor, number: int) -> Experiment:
        surroundings = campaign.simulator.conditions.surroundings
        progress(
            f"experiment {number}: {campaign.settings.space.describe(design, surroundings)}"
        )
        return laboratory.shoot(design, seed=child(args.seed, "shoot", number))

    if args.forget is not None:
        campaign.forget(args.forget, progress=progress)
    campaign.run(shoot_gel, args.designs, q=args.q, progress=progress)
    ended = campaign.journal.find_event("stop", campaign.told)
    return ended["reason"] if ended else None


def _run_real(campaign: Campaign, args: Namespace) -> tuple[Sequence[Proposal], str | None]:
    """Learn from told files, then say what to shoot next: the proposals, or why it is enough."""
    progress = args.terminal.plan_stages()
    experiments: list[Experiment] = []
    failed: list[tuple[str, InputDataError]] = []
    for path in find_files(*args.tell) if args.tell else ():
        try:
            traces = load_traces(path, layout=args.layout, sort=args.sort)
            print(traces.report())
            medium = medium_of(traces, args.medium)
            surroundings = campaign.simulator.conditions.surroundings
            prepared = prepare(traces, surroundings, rest_radius=args.rest_radius)
            print(prepared.report())
            for experiment in prepared.experiments:
                marks = prepared.landmarks[experiment.label]
                check_whole(experiment, marks.max_method)
        except InputDataError as error:
            if (
                not campaign.journal.events or not path.is_file()
            ):  # nobody asked for this shot
                raise
            failed.append((path.name, error))
            continue
        for name in medium.sources:
            assumed = args.gel_medium.value(name)
            if name not in args.gel_medium.sources and medium.value(name) != assumed:
                raise InputDataError(
                    f"A told file states a {label(name)} of {medium.value(name)}, where this "
                    f"campaign assumed {assumed}; begin a campaign with --medium and this value."
                )
        for note in medium.notes:
            print(note)
        experiments += prepared.experiments
    if args.forget is not None:
        campaign.forget(args.forget, progress=progress)
    if experiments:
        campaign.tell(*experiments, progress=progress)
    elif campaign.outstanding:  # the last run was cut off while it learnt
        campaign.learn_outstanding(progress=progress)
    for name, error in failed:
        campaign.fail(name, str(error))
    if reason := campaign.reason_to_stop():
        return (), reason
    return campaign.ask_several(args.q, progress=progress), None
