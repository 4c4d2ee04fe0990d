"""Many seeds: the same journals on any number of workers, one thread each, and a failure costs the
others nothing.
"""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from imr_torch.assimilate import SearchOptions
from imr_torch.campaign import CampaignSettings, ExactLearner, Optimal, Random, Study, run_campaigns
from imr_torch.design import DesignSpace, Laplace, Plan
from imr_torch.errors import InputDataError, UnsupportedError
from imr_torch.material import PARAMETERS
from imr_torch.observe import SimulatedLaboratory
from imr_torch.simulate import process_pool
from tests.linear import NOISE, LinearSimulator, prior

PLAN = Plan(
    torch.linspace(0.1, 2.0, 9, dtype=torch.float64), repeats=4, noise=NOISE, collapses=None
)
TRUTH = PARAMETERS.pack({"G": 5600.0, "mu": 0.18})
OPTIMAL = Optimal(Laplace(draws=3, rivals=3), evaluations=4, initial=3)


def study(folder, *, policy=OPTIMAL, truth=None) -> Study:
    simulator = LinearSimulator()
    laboratory = SimulatedLaboratory(
        truth or simulator, TRUTH, noise=NOISE, repeats=4, times=PLAN.times
    )
    settings = CampaignSettings(
        DesignSpace(), PLAN, policy, ExactLearner(32, SearchOptions(raw_samples=24))
    )
    return Study(
        folder, prior(("newtonian", "nhkv")), simulator, laboratory, settings, {"gel": "test"}
    )


def journals(folder) -> dict[str, bytes]:
    return {path.parent.name: path.read_bytes() for path in sorted(folder.glob("*/journal.jsonl"))}


def test_any_number_of_workers_writes_the_same_journals_and_more_designs_continue_them(tmp_path):
    told: list[str] = []
    threads = torch.get_num_threads()
    alone = run_campaigns([4, 2], study(tmp_path / "alone"), 2, progress=told.append)
    assert torch.get_num_threads() == threads
    assert [(o.seed, o.designs, o.error) for o in alone] == [(4, 2, None), (2, 2, None)]
    assert told == ["seed 4: 2 designs", "seed 2: 2 designs"]
    with process_pool(2) as pool:
        run_campaigns([2], study(tmp_path / "two"), 1, executor=pool)
        both = run_campaigns([2, 4], study(tmp_path / "two"), 2, executor=pool)
    assert [(o.seed, o.designs, o.error) for o in both] == [(2, 2, None), (4, 2, None)]
    assert journals(tmp_path / "two") == journals(tmp_path / "alone")
    assert len(journals(tmp_path / "alone")) == 2


def test_a_seed_that_fails_says_why_and_costs_the_others_nothing(tmp_path):
    """A laboratory that cannot shoot gels at some designs: the outcome is told, and what was learnt
    is in the journal.
    """
    broken = study(tmp_path, policy=Random(), truth=Picky())
    outcomes = run_campaigns(range(8), broken, 2)
    failed = [o for o in outcomes if o.error]
    assert 0 < len(failed) < 8
    for outcome in outcomes:
        assert len(broken.open(outcome.seed).experiments) == outcome.designs
        assert (outcome.designs == 2) == (outcome.error is None)
        assert outcome.error is None or outcome.error.startswith(
            "ConvergenceError: The laboratory's own bubble"
        )


class Picky(LinearSimulator):
    """Fails at large Weber numbers."""

    def __call__(self, parameters, designs, times):
        failing = LinearSimulator(fails=bool((designs[..., 0] > 700.0).any()))
        return failing(parameters, designs, times)


def test_threads_are_refused(tmp_path):
    with (
        ThreadPoolExecutor(1) as pool,
        pytest.raises(UnsupportedError, match="given threads, which share BoTorch's generator"),
    ):
        run_campaigns([0], study(tmp_path), 1, executor=pool)


def test_the_journal_of_another_study_is_refused(tmp_path):
    run_campaigns([0], study(tmp_path, policy=Random()), 1)
    with pytest.raises(
        InputDataError, match=r"journal of another campaign: settings\.policy differ"
    ):
        run_campaigns([0], study(tmp_path), 1)
