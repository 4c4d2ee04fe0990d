"""Many campaigns on one gel, a seed each, over any ``concurrent.futures.Executor`` of processes.

What a seed draws (designs, noise, ensembles) depends on the seed alone and every campaign runs on
one thread, so results are the same at any number of workers. Each has a folder and journal of its
own: a study that was cut off, or is to have more designs or seeds, is run again and continues.
"""

import os
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from imr_torch.campaign.loop import Campaign
from imr_torch.campaign.settings import CampaignSettings
from imr_torch.errors import UnsupportedError
from imr_torch.material import Belief
from imr_torch.observe import Experiment, SimulatedLaboratory
from imr_torch.random import child
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress


@dataclass(frozen=True)
class Study:
    """What all seeds have in common; it must survive pickling.

    Args:
        folder: holds a folder for each seed.
        prior: belief before the first experiment.
        simulator: makes the bubbles of search and inference.
        laboratory: makes the data.
        settings: how campaigns choose, learn and end.
        note: what else identifies a campaign, JSON-ready.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.campaign import Study
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     study = Study(Path(folder), case.prior, simulator, laboratory)
    ...     study.open(seed=3).journal.folder.name
    'seed_0003'
    """

    folder: Path
    prior: Belief
    simulator: Simulator
    laboratory: SimulatedLaboratory
    settings: CampaignSettings = field(default_factory=CampaignSettings)
    note: dict[str, Any] = field(default_factory=dict)

    def open(self, seed: int) -> Campaign:
        """The campaign of a seed, as far as it has come."""
        folder = Path(self.folder) / f"seed_{seed:04d}"
        return Campaign(
            folder, self.prior, self.simulator, settings=self.settings, seed=seed, note=self.note
        )

    def run(self, seed: int, designs: int) -> Campaign:
        """Continue the campaign of a seed until it has ``designs`` experiments or its rule ends it.

        Args:
            seed: which.
            designs: experiments in all.
        """
        campaign = self.open(seed)

        def shoot(design: Tensor, number: int) -> Experiment:
            return self.laboratory.shoot(design, seed=child(seed, "shoot", number))

        campaign.run(shoot, designs)
        return campaign


@dataclass(frozen=True)
class Outcome:
    """The result of running one seed.

    Args:
        seed: which.
        designs: experiments told so far.
        made: of which in this run.
        cpu_seconds: CPU time that this run took; 0 when not known.
        error: why it went no further, if it was not meant to stop there; run the study again to
            continue.

    >>> from imr_torch.campaign import Outcome
    >>> Outcome(seed=3, designs=2, made=1).error is None
    True
    """

    seed: int
    designs: int
    made: int = 0
    cpu_seconds: float = 0.0
    error: str | None = None


def run_campaigns(
    seeds: Sequence[int],
    study: Study,
    designs: int,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> tuple[Outcome, ...]:
    """Run the campaigns of many seeds.

    A seed that fails, or whose worker dies, costs the others nothing.

    Args:
        seeds: all different.
        study: what they have in common.
        designs: experiments each is to have in all.
        executor: processes (:func:`imr_torch.simulate.process_pool`, Dask, MPI); this process when
            None. Threads are refused: BoTorch seeds a generator that all of them share.
        progress: called with a line per seed.

    Returns:
        An outcome per seed, in their order. The campaigns are in their folders:
        ``study.open(seed)``.

    Raises:
        InputDataError: if a folder holds the journal of another campaign.
        UnsupportedError: if the executor works with threads.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import SearchOptions
    >>> from imr_torch.campaign import CampaignSettings, ExactLearner, Random, Study, run_campaigns
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> settings = CampaignSettings(policy=Random(), learner=ExactLearner(64, SearchOptions(raw_samples=16, starts=2)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     study = Study(Path(folder), case.prior, simulator, laboratory, settings)
    ...     [(outcome.seed, outcome.designs) for outcome in run_campaigns([0, 1], study, designs=1)]
    [(0, 1), (1, 1)]
    """
    found: dict[int, Outcome] = {}
    for outcome in _outcomes(seeds, study, designs, executor):
        found[outcome.seed] = outcome
        if progress:
            error = f", then {outcome.error}" if outcome.error else ""
            progress(f"seed {outcome.seed}: {outcome.designs} designs{error}")
    return tuple(found[seed] for seed in seeds)


def _outcomes(
    seeds: Sequence[int], study: Study, designs: int, executor: Executor | None
) -> Iterator[Outcome]:
    """Run each seed in a task of its own; outcomes as they come."""
    home = os.getpid()
    if executor is None:
        yield from (_attempt(study, seed, designs, home) for seed in seeds)
        return
    futures = {executor.submit(_attempt, study, seed, designs, home): seed for seed in seeds}
    for future in as_completed(futures):
        try:
            yield future.result()
        except UnsupportedError:
            raise
        except Exception as error:  # the worker died, or could not read its task
            seed = futures[future]
            yield Outcome(
                seed, len(study.open(seed).experiments), error=f"{type(error).__name__}: {error}"
            )


def _attempt(study: Study, seed: int, designs: int, home: int) -> Outcome:
    """One seed in a worker."""
    if os.getpid() == home and threading.current_thread() is not threading.main_thread():
        raise UnsupportedError(
            "run_campaigns was given threads, which share BoTorch's generator; give it processes."
        )
    before = len(study.open(seed).experiments)
    started = time.process_time()
    error = None
    with one_torch_thread():
        try:
            study.run(seed, designs)
        except Exception as problem:
            error = f"{type(problem).__name__}: {problem}"
    after = len(study.open(seed).experiments)
    return Outcome(seed, after, after - before, time.process_time() - started, error)
