"""Runs ``imr-torch campaign``.

Its help and options are in :mod:`imr_torch.cli.options.campaign`.
"""

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from imr_torch.campaign import Campaign, CampaignSettings, Finding, Journal, Proposal
from imr_torch.characterization import medium_of
from imr_torch.cli.campaign_settings import check_goal, hidden, one_model, scatter, settings_of
from imr_torch.cli.common import (
    check_counts,
    header_of,
    layout_of,
    prior_of,
    progress_of,
    rest_radius_of,
    simulator_of,
    statement_of,
    with_medium,
    write_result,
)
from imr_torch.cli.figures import save_figures
from imr_torch.errors import InputDataError
from imr_torch.files import remove_temporaries
from imr_torch.html import write
from imr_torch.material import PARAMETERS, Belief, ReferenceCase, reference_case
from imr_torch.observe import Experiment, SimulatedLaboratory, TraceSet, load_traces, prepare
from imr_torch.observe.medium import label
from imr_torch.random import child, generator
from imr_torch.results import campaign_document, campaign_page, draw_figures
from imr_torch.results.campaign_page import cause_sentence
from imr_torch.results.population import population_lines
from imr_torch.simulate import Simulator

_SHOWN, _LEAST = 6, 0.001  # causes that are listed, and the probability below which none is


def run(args: argparse.Namespace) -> None:
    """Run a simulated campaign, or one step of a real one.

    Raises:
        KeyboardInterrupt: if the user stops it, with what to do next.
    """
    if args.tell and args.case:
        raise InputDataError(
            "--tell gives real experiments and --case simulates them; give one of the two."
        )
    check_counts(args, "designs", "q", "evaluations", "repeats")
    check_goal(args)
    for option in ("layout", "rest_radius"):
        if getattr(args, option) is not None and not args.tell:
            raise InputDataError(
                f"--{option.replace('_', '-')} is about told files and has no effect without "
                "--tell."
            )
    settings = settings_of(args)
    simulator, prior, medium = with_medium(args, simulator_of(args), prior_of(args))
    if args.case and medium.sds:
        raise InputDataError(
            f"--medium gives {label(next(iter(medium.sds)))} a standard deviation, and --case "
            "simulates a gel whose medium is "
            "known; state values alone."
        )
    print(medium.report())
    started = time.process_time()
    case = reference_case(args.case) if args.case else None
    if args.goal != "gel":
        prior = one_model(prior, case, args.goal)
    campaign = _open(args, simulator, prior, settings)
    try:
        with campaign.journal.held():
            remove_temporaries(campaign.journal.folder, f"{args.command}.json", "*.png")
            proposals, stopped = _simulated(campaign, case, args) if case else _real(campaign, args)
            _report(campaign, case, args, time.process_time() - started, proposals, stopped)
    except KeyboardInterrupt:
        kept = (
            f"; what was finished is in {campaign.journal.path}, continue with --resume"
            if campaign.journal.events
            else ""
        )
        raise KeyboardInterrupt(f"interrupted{kept}") from None


def _open(
    args: argparse.Namespace, simulator: Simulator, prior: Belief, settings: CampaignSettings
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
    note = (
        {"case": args.case}
        | ({"hidden": hidden(args)} if args.hide is not None else {})
        | ({"scatter": scatter(args)} if args.scatter is not None else {})
        | ({"medium": args.gel_medium.to_dict()} if args.medium else {})
    )
    return Campaign(folder, prior, simulator, settings=settings, seed=args.seed, note=note)


def _simulated(
    campaign: Campaign, case: ReferenceCase, args: argparse.Namespace
) -> tuple[Sequence[Proposal], str | None]:
    """Shoot the secret gel of a reference case, or gels scattered about it.

    No proposals, and why it ended early.
    """
    progress = progress_of(args)
    spread = scatter(args)

    def gel(number: int) -> dict[str, float]:
        source = generator(child(args.seed, "gel", number))
        factors = {
            name: math.exp(sd * float(torch.randn(1, generator=source, dtype=torch.float64)))
            for name, sd in spread.items()
        }
        return {name: value * factors.get(name, 1.0) for name, value in case.truth.items()}

    def shoot(design: torch.Tensor, number: int) -> Experiment:
        if progress:
            progress(
                f"experiment {number}: "
                f"{campaign.settings.space.describe(design, campaign.simulator.conditions.surroundings)}"
            )
        plan = campaign.settings.plan
        gels = PARAMETERS.pack({**gel(number), **hidden(args)})
        laboratory = SimulatedLaboratory(
            campaign.simulator, gels, noise=plan.noise, repeats=plan.repeats
        )
        return laboratory.shoot(design, seed=child(args.seed, "shoot", number))

    if args.forget is not None:
        campaign.forget(args.forget, progress=progress)
    campaign.run(shoot, args.designs, q=args.q, progress=progress)
    ended = campaign.journal.find("stop", campaign.told)
    return (), ended["reason"] if ended else None


def _real(campaign: Campaign, args: argparse.Namespace) -> tuple[Sequence[Proposal], str | None]:
    """Learn from told files, then say what to shoot next: the proposals, or why it is enough."""
    progress = progress_of(args)
    experiments = ()
    if args.tell:
        traces = load_traces(*args.tell, layout=layout_of(args), sort=args.sort)
        print(traces.report())
        surroundings = campaign.simulator.conditions.surroundings
        _check_medium(traces, args)
        prepared = prepare(traces, surroundings, rest_radius=rest_radius_of(args))
        print(prepared.report())
        experiments = prepared.experiments
    if args.forget is not None:
        campaign.forget(args.forget, progress=progress)
    if experiments:
        campaign.tell(*experiments, progress=progress)
    elif campaign.outstanding:  # the last run was cut off while it learnt
        campaign.learn(progress=progress)
    if reason := campaign.reason_to_stop():
        print(f"Enough: {reason}")
        return (), reason
    proposals = campaign.ask_several(args.q, progress=progress)
    for proposal in proposals:
        where = campaign.settings.space.describe(
            proposal.design, campaign.simulator.conditions.surroundings
        )
        expected = (
            ""
            if proposal.gain is None
            else f"; expected gain {proposal.gain:.2f} +- {proposal.gain_sd:.2f} nats"
        )
        print(f"{'Shoot next' if proposal is proposals[0] else 'then'}: {where}{expected}")
        if proposal.reason:
            print(f"  {proposal.reason}")
        if reason := campaign.reason_to_stop(proposal):
            print(f"or leave it: {reason}")
    gains = [proposal.gain for proposal in proposals if proposal.gain is not None]
    if len(gains) > 1:
        print(
            f"expected gain of all together {sum(gains):.2f} nats; each is what a design adds to "
            "those before it"
        )
    return proposals, None


def _check_medium(traces: TraceSet, args: argparse.Namespace) -> None:
    """The medium of a campaign is stated when it begins: told files may say the same, or be
    overruled by --medium, said.
    """
    told = medium_of(traces, statement_of(args))
    own = args.gel_medium
    new = [name for name in told.sources if name not in own.sources]
    if new:
        raise InputDataError(
            f"A told file states the medium ({told.report().splitlines()[0]}), and this campaign "
            f"assumed its {label(new[0])}; "
            "tell the file to a campaign that begins with --medium and these values."
        )
    for note in told.notes:
        print(note)


def _report(
    campaign: Campaign,
    case: ReferenceCase | None,
    args: argparse.Namespace,
    seconds: float,
    proposals: Sequence[Proposal],
    stopped: str | None,
) -> None:
    """Print the belief; write JSON, figures and page."""
    belief = campaign.belief
    if campaign.steps and campaign.steps[-1].noise:
        print(f"noise {campaign.steps[-1].noise}")
    if campaign.steps and (found := campaign.steps[-1].finding):
        print(_found(found))
    if campaign.steps and (population := campaign.steps[-1].population):
        for line in population_lines(population):
            print(line)
    print(
        "model probabilities: " + ", ".join(f"{k} {v:.4f}" for k, v in belief.probabilities.items())
    )
    errors = {}
    truth = None
    if case:
        part = belief[case.truth_model]
        truth = {name: case.truth[name] for name in part.names}
        errors = {
            n: abs(float(m) / truth[n] - 1.0) for n, m in zip(part.names, part.means, strict=True)
        }
        for name, mean, sd in zip(part.names, part.means.tolist(), part.sds.tolist(), strict=True):
            entry = PARAMETERS[name]
            mean, sd, true = (x * entry.display_scale for x in (mean, sd, truth[name]))
            print(
                f"  {entry.label}: {mean:.4g} +- {sd:.2g}, truth {true:.4g}, error "
                f"{100 * errors[name]:.2f} %"
            )
    document = campaign_document(campaign, proposals=proposals, stopped=stopped, truth=truth)
    document |= {"relative_error": errors, "cpu_seconds": seconds}
    write_result(args, document)  # before any figure, so that nothing computed is lost if one fails
    _figures(campaign, document)
    if args.html:
        print(f"wrote {write(campaign_page(header_of(args) | document), args.html)}")


def _found(found: Finding) -> str:
    """What the last diagnosis says, in two lines."""
    ranked = sorted(found.probabilities.items(), key=lambda item: -item[1])[:_SHOWN]
    listed = (
        ", ".join(f"{name} {p:.3f}" for name, p in ranked if p >= _LEAST)
        or "none fitted, since no test finds a gap"
    )
    return f"Cause of the gap: {cause_sentence(asdict(found))}\n  probabilities: {listed}"


def _figures(campaign: Campaign, document: dict[str, Any]) -> None:
    """Figures of the campaign so far.

    Those that need a fit are drawn for the steps made in this run.
    """
    save_figures(draw_figures(document), campaign.journal.folder)
    print(f"figures and journal in {campaign.journal.folder}")
