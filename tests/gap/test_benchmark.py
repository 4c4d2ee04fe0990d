"""The benchmark of the diagnosis:

sets are what they say, a reduced run leaves lines, and the scorer counts by hand.
"""

import json
import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from scipy.stats import binomtest

from benchmarks.gap import causes
from benchmarks.gap.__main__ import append, main, tasks
from benchmarks.gap.rivals import ambiguous, described, rivals
from benchmarks.gap.run import Extras, frozen, run_task, thresholds
from benchmarks.gap.sets import Task, choose, draw_designs, draw_effect, make_plan, make_set
from benchmarks.gap.signals import beside_rival, signal_by_phase, signals
from benchmarks.gap.table import (
    SHOTS,
    Row,
    amounts,
    both_right,
    clopper_pearson,
    controls,
    credible,
    first_right,
    guess_from_designs,
    named_right,
    posterior,
    quantile_row,
    read_lines,
    shares,
    table,
)
from imr_torch.design import DesignSpace
from imr_torch.errors import InputDataError
from imr_torch.gap import LIBRARY
from imr_torch.gap.hypotheses import fit_null
from imr_torch.goodness.linear import linearise
from imr_torch.material import PARAMETERS, wide_prior
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.observe.sets import NUISANCE
from imr_torch.random import generator

SMALL = ("wall", "rinf_bias")
ALIKE = ("missed_maximum", "refraction", "clock")
OPTIONS = ["--sizes", "2x10", "--sets", "1", "--effects", ",".join(SMALL)]


def line(kind: str = "effect", **changes) -> dict:
    """A line as a run would leave it: a wall, found and named."""
    made = {
        "key": "key",
        "kind": kind,
        "size": "3x10",
        "physics": "polytropic",
        "nuisances": False,
        "frozen": "hash",
        "truth": [] if kind == "none" else ["wall"],
        "phase": "first collapse",
        "designs": [[200.0, 0.2], [500.0, 0.25], [800.0, 0.15]],
        "gap": kind != "none",
        "verdict": "none" if kind == "none" else "effect",
        "cause": [] if kind == "none" else ["wall"],
        "selected": [],
        "posterior": None if kind == "none" else {"wall": 0.85, "damage": 0.05, "other": 0.1},
        "converged": True,
    }
    return made | changes


def value_of(rows: list[Row], figure: str, size: str = "3x10") -> Row:
    return next(row for row in rows if (row.figure, row.size) == (figure, size))


@pytest.mark.parametrize("kind", ["withheld", "pair"])
def test_that_a_set_holds_what_its_kind_says(kind: str) -> None:
    made = make_set(Task(kind, 3, 4, "polytropic", 5))
    assert len(made.truth) == {"withheld": 1, "pair": 2}[kind]
    assert set(made.values) == {"G", "mu"} | {
        name for effect in made.truth for name in LIBRARY[effect].names
    }
    hidden = {LIBRARY[name].family for name in made.truth} if kind == "withheld" else set()
    assert {effect.family for effect in made.offered} == {
        effect.family for effect in LIBRARY.values()
    } - hidden
    assert [e.radius.shape for e in made.experiments] == [(4, 81)] * 3
    assert all(size > 0.1 for size in made.signal.values())


def test_that_a_set_is_its_truth_plus_noise_of_the_law_and_depends_on_its_key_alone() -> None:
    task = Task("effect", 2, 200, "polytropic", 1, nuisances=True, effects=SMALL)
    made = make_set(task)
    assert torch.equal(made.experiments[0].radius, make_set(task).experiments[0].radius)
    clean = made.noiseless()
    noisy = ExperimentBatch(made.experiments)
    whitened = noisy.whiten(noisy.mean - clean.mean, noisy.sd(clean.mean))
    assert 0.8 < float(whitened.square().mean()) < 1.2
    assert made.experiments[0].nuisance.rest_radius == 0.01
    assert torch.allclose(made.noiseless(unseen=True).mean, made.curves[2:])


def test_that_designs_keep_apart_and_amplitudes_within_what_is_typical() -> None:
    source = generator(0)
    points = draw_designs(10, source)
    unit = torch.stack((points[:, 0].log10() - 2.0, (points[:, 1] - 0.14) / 0.16), 1)
    assert float((torch.cdist(unit, unit) + torch.eye(10)).min()) >= 0.1
    assert float(unit.min()) >= 0.0
    assert float(unit.max()) <= 1.0
    for effect in LIBRARY.values():
        prior = effect.priors[effect.names[0]]
        amplitudes = [draw_effect(effect, source)[1][effect.names[0]] for _ in range(20)]
        assert all(
            0.2 <= abs(a) / prior.sd <= 2.0 and prior.lower <= a <= prior.upper for a in amplitudes
        )
        assert (min(amplitudes) < 0.0) == (prior.lower < 0.0)


def test_that_detectable_effects_become_the_truth_first_and_one_of_each_family() -> None:
    names = ("wall", "residual_velocity", "trigger_offset", "damage")
    drawn = [(LIBRARY[name], {}) for name in names]
    assert choose(drawn, [1.0, 8.0, 90.0, 5.0], 1) == [1]
    assert choose(drawn, [1.0, 8.0, 90.0, 5.0], 2) == [
        1,
        3,
    ]  # the trigger is of the same class as the velocity
    assert choose(drawn, [1.0, 2.0, 3.0, math.nan], 1) == [2]
    assert choose(drawn, [0.0, math.nan, 0.0, 0.0], 1) is None


def test_that_what_nuisances_take_back_does_not_show() -> None:
    """Rmax of all experiments off by 1 % is an effect, and is what errors of .3 % of each take back at 1/.3 sd each."""
    designs = draw_designs(3, generator(0))
    gel = {"G": 5e3, "mu": 0.1}
    effect = {"missed_maximum": 0.01}
    task, uncertain = (
        Task("effect", 3, 100, "polytropic", 0, nuisances=known) for known in (False, True)
    )
    shown = [
        signals(gel, [effect], make_plan(designs, t), t.simulator())[0] for t in (task, uncertain)
    ]
    assert shown[0] > 20.0
    assert 0.5 < shown[1] <= 3.0**0.5 * 0.01 / NUISANCE.max_radius
    by_phase = signal_by_phase(gel, effect, make_plan(designs, uncertain), uncertain.simulator())
    assert all(late >= early - 0.05 for early, late in pairwise(by_phase))


def test_that_what_shows_of_an_effect_is_what_the_null_fit_leaves_of_its_curve() -> None:
    """The benchmark's own refit against the diagnosis':

    a far-field pressure is all but taken back by another G.
    """
    task = Task("effect", 3, 100, "polytropic", 0)
    gel = {"G": 5e3, "mu": 0.1}
    effect = {"far_field_pressure": 0.02}
    plan = make_plan(draw_designs(3, generator(1)), task)
    simulator = task.simulator()
    shown = signals(gel, [effect], plan, simulator)[0]
    curves = predict(simulator, PARAMETERS.pack(gel | effect)[None], plan)[0]
    clean = ExperimentBatch(
        tuple(
            replace(e, radius=r.expand(100, -1))
            for e, r in zip(plan.experiments, curves, strict=True)
        )
    )
    fit = fit_null(wide_prior(("nhkv",)).models[0], clean, simulator, seed=0)
    assert fit.certificate.converged
    left = float(
        linearise(fit, clean, simulator).residual.norm()
    )  # weighted by the noise at the fit, not at the truth
    assert shown == pytest.approx(left, rel=0.15)
    by_phase = signal_by_phase(gel, effect, plan, simulator)
    assert all(early <= late + 0.01 for early, late in pairwise(by_phase))
    assert by_phase[-1] == pytest.approx(shown, rel=1e-3)


def test_that_an_effect_of_the_same_form_leaves_nothing_of_the_true_one_and_another_does() -> None:
    """Polytropic gas that begins at another pressure: hot, or more of it."""
    task = Task("effect", 3, 10, "polytropic", 0, nuisances=True)
    gel = {"G": 5e3, "mu": 0.1}
    truth = {"excess_gas": 0.15}
    plan = make_plan(draw_designs(3, generator(0)), task)
    simulator = task.simulator()
    left = {
        name: beside_rival(gel, truth, LIBRARY[name], plan, simulator)
        for name in ("hot_contents", "sound_speed")
    }
    assert (
        left["hot_contents"]
        < 2.0
        < 4.0
        < left["sound_speed"]
        <= signals(gel, [truth], plan, simulator)[0] + 0.01
    )


def test_that_rivals_are_found_of_sets_that_were_left_ambiguous() -> None:
    task = Task("effect", 2, 4, "polytropic", 0, effects=("refraction", "missed_maximum"))
    line = {
        "key": task.key,
        "kind": "effect",
        "size": task.size,
        "physics": task.physics,
        "seed": 0,
        "nuisances": False,
    }
    line |= {"truths": "reference", "truth": list(make_set(task).truth), "gap": True}
    verdicts = [
        ("other", []),
        ("class", ["wall", "clock"]),
        ("effect", ["wall"]),
        ("class", ["hot_contents", "excess_gas"]),
    ]
    assert [ambiguous({**line, "verdict": v, "cause": c}) for v, c in verdicts] == [
        True,
        True,
        False,
        True,
    ]
    assert not ambiguous({**line, "verdict": "none", "cause": [], "gap": False})
    assert ambiguous({**line, "kind": "next", "ambiguous": True})
    found = rivals(line, "polytropic", task.effects)
    ((few, many),) = found.values()
    assert {*found, *line["truth"]} == {"refraction", "missed_maximum"}
    assert 0.0 < few < many
    assert described(line, found).endswith(f"beside {next(iter(found))} {few:.1f} to {many:.1f} sd")


def test_that_a_wrong_name_comes_with_what_the_truth_would_gain() -> None:
    """Refraction, withheld, is named after its neighbour;

    offered, it explains these data no better.
    """
    task = Task("withheld", 2, 4, "polytropic", 0, effects=("refraction", "missed_maximum"))
    found = run_task(task, Extras(baselines=False))
    assert (found["truth"], found["cause"]) == (["refraction"], ["missed_maximum"])
    assert abs(found["truth_ahead"]) < 1.0
    apart = run_task(replace(task, seed=2), Extras(baselines=False))
    assert (apart["verdict"], "truth_ahead" in apart) == ("other", False)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> list[dict]:
    """Lines of a set with an effect, one without and one with a withheld effect, from the command in two runs."""
    path = tmp_path_factory.mktemp("run") / "lines.jsonl"
    main(["run", str(path), *OPTIONS, "--kinds", "effect", "--onset", "--shrinkage"])
    before = path.read_text()
    path.write_text(before + '{"key": "torn')
    main(["run", str(path), *OPTIONS, "--kinds", "effect,none,withheld", "--no-baselines"])
    assert path.read_text().startswith(before)  # a set that has a line is not run again
    return read_lines(path)


def test_that_a_run_leaves_one_line_a_set_and_tells_the_three_kinds_apart(made) -> None:
    effect, none, withheld = made
    assert [x["key"] for x in made] == [
        f"{kind}/2x10/polytropic/exact/0" for kind in ("effect", "none", "withheld")
    ]
    assert all(x["frozen"] == frozen() and x["converged"] and "error" not in x for x in made)
    assert (none["gap"], none["verdict"]) == (False, "none")
    assert (effect["gap"], named_right(effect)) == (True, True)
    assert set(withheld["truth"]).isdisjoint(withheld["posterior"] or {})


def test_that_parts_and_baselines_are_measured_against_the_truth(made) -> None:
    effect, none, withheld = made
    assert set(effect["baselines"]) == {
        "chi_square_p",
        "closed_set",
        "gp_closed",
        "closure_p",
        "windows_p",
        "mmd_p",
    }
    assert effect["baselines"]["closure_p"] < 0.001
    assert effect["shrinkage_true"] > 0.8
    assert effect["onset_phase"] != "none"
    assert effect["rival"] != effect["truth"][0]
    assert "shrinkage" not in withheld
    assert "baselines" not in none


def test_that_a_table_of_the_run_has_every_figure(made, tmp_path, capsys) -> None:
    for x in made:
        append(tmp_path / "lines.jsonl", x | {"seconds": math.nan, "signal": {"wall": math.inf}})
    main(["table", str(tmp_path / "lines.jsonl"), "--json", str(tmp_path / "rows.json")])
    text = capsys.readouterr().out
    assert "3 sets, 0 failed" in text
    assert (
        "| false alarm, no gap | all | 0.000 | 1 | 0.000 to 0.950 | <= 0.05 | <= 0.05 | met |"
        in text
    )
    assert {
        row["figure"] for row in json.loads((tmp_path / "rows.json").read_text())["polytropic"]
    } > {"pairs: both named right"}


def test_that_both_arms_shoot_until_one_cause_is_named_alone() -> None:
    found = run_task(Task("next", 1, 10, "polytropic", 4, True, effects=ALIKE))
    assert "error" not in found
    assert found["ambiguous"]
    for arm in ("chosen", "random"):
        assert 1 <= len(found["shots"][arm]) <= SHOTS
        assert found["named"][arm] in (len(found["shots"][arm]), None)
        assert found["named"][arm] is not None or not found["right"][arm]
        assert 0.0 <= found["p_true"][arm] <= 1.0
        DesignSpace().check(torch.tensor(found["shots"][arm], dtype=torch.float64))
    assert found["shots"]["chosen"][0] != found["shots"]["random"][0]


def test_that_sets_with_one_cause_alone_are_counted_and_shot_no_further() -> None:
    found = run_task(Task("next", 1, 1, "polytropic", 3, effects=SMALL))
    assert not found["ambiguous"]
    assert "shots" not in found


def test_the_figures_of_further_shots() -> None:
    def line(named: int | None, right: bool, p: float) -> dict:
        arms = {"named": {"chosen": named, "random": 3}, "right": {"chosen": right, "random": True}}
        return {
            "kind": "next",
            "size": "3x10",
            "ambiguous": True,
            "p_true": {"chosen": p, "random": 0.5},
        } | arms

    rows = amounts([line(1, True, 0.9), line(2, False, 0.1), line(None, False, 0.8)])
    share = value_of(
        rows, "still ambiguous: truth named alone after at most 3 further shots, chosen", "all"
    )
    assert (share.value, share.count) == (pytest.approx(1.0 / 3.0), 3)
    assert value_of(rows, "the same, another named alone, chosen", "all").value == pytest.approx(
        1.0 / 3.0
    )
    ratio = value_of(
        rows, "shots until a cause is named alone, at most 3, chosen over random", "all"
    )
    assert ratio.value == pytest.approx((1 + 2 + 3) / 9)
    assert value_of(
        rows, "the same, of sets in which both name the truth", "all"
    ).value == pytest.approx(1.0 / 3.0)
    two = amounts([line(2, True, 0.9), line(1, True, 0.9)])
    assert value_of(
        two, "the same, of sets in which both name the truth", "all"
    ).value == pytest.approx(3.0 / 6.0)
    assert value_of(
        two, "the same, if every chosen one needed one shot", "all"
    ).value == pytest.approx(2.0 / 6.0)


def test_that_a_record_of_further_shots_alone_makes_a_table() -> None:
    """Its lines hold no fit of their own, so nothing about one."""
    about = {
        "physics": "transport",
        "frozen": "0",
        "gap": False,
        "verdict": "next",
        "cause": [],
        "truth": ["pulse"],
    }
    assert "Without a certificate: 0." in table(
        [about | {"kind": "next", "size": "3x10", "ambiguous": False}]
    )


@pytest.mark.parametrize("truths", ["reference", "modes"])
def test_that_truths_of_full_physics_are_cut_otherwise_than_the_diagnosis_cuts(truths: str) -> None:
    """In time and in space: the same error in both would cancel in every fit."""
    task = Task("effect", 3, 10, "transport", 0, truths=truths)
    truth, own = (task.simulator(fine=fine).accuracy for fine in (True, False))
    assert truth.tolerance < own.tolerance / 10.0
    assert truth.resolution.inside > own.resolution.inside
    assert truth.resolution.outside > own.resolution.outside
    assert (task.key == replace(task, truths="reference").key) == (truths == "reference")


def honest(kind: str, other: float, number: int) -> dict:
    """A line whose stated probability of an unknown effect is ``other``."""
    posterior = {"wall": 0.99 - other, "none": 0.01, "other": other}
    said = {
        "posterior_at_odds": {"1:1": posterior},
        "members": posterior,
        "first": {"chance": 0.3, "adequate": number % 2 == 0},
    }
    verdict = "other" if other > 0.5 else "effect"
    cause = [] if verdict == "other" else ["wall"]
    own = said | {"key": f"{kind} {number}", "verdict": verdict, "cause": cause, "seconds": 3.0}
    return line(kind) | own | {"truth": ["damage" if kind == "withheld" else "wall"], "gap": True}


def test_that_stated_probabilities_are_held_against_frequencies() -> None:
    """Unknown in one of five where .2 is stated, in four of five where .8 is;

    and the reverse, which is not calibrated.
    """
    good = [honest("withheld" if i % 5 == 0 else "effect", 0.2, i) for i in range(50)]
    good += [honest("effect" if i % 5 == 0 else "withheld", 0.8, i) for i in range(50, 100)]
    bad = [{**x, "kind": {"effect": "withheld", "withheld": "effect"}[x["kind"]]} for x in good]
    for lines, calibrated in ((good, True), (bad, False)):
        rows = [
            row for row in causes.causes(lines) if row.figure.startswith("withheld, where P(other)")
        ]
        within = [row.must.low <= row.value <= row.must.high for row in rows]
        assert [within[i] for i in (0, 1, 3, 4)] == [calibrated] * 4  # the bin between holds both
    chances = [
        row for row in causes.causes(good) if row.figure.startswith("best known effect adequate")
    ]
    assert len(chances) == 5
    (wrong,) = [row for row in causes.causes(good) if row.figure.startswith("names with a stated")]
    assert wrong.count == 0  # none is above .9
    (unknown,) = [
        row for row in causes.causes(good) if row.figure.startswith('withheld and found: "other"')
    ]
    assert (unknown.value, unknown.count) == (1.0, 50)


def test_that_the_hash_of_a_line_is_of_values_and_not_of_where_they_lie_in_memory(
    monkeypatch,
) -> None:
    before = frozen()
    effect = LIBRARY["heat_exchange"]
    monkeypatch.setitem(LIBRARY, effect.name, replace(effect, setting=lambda setting, _: setting))
    assert frozen() == before
    monkeypatch.setitem(LIBRARY, effect.name, replace(effect, starts=((0.25,),)))
    assert frozen() != before


def test_that_thresholds_are_those_of_the_library_and_a_change_shows() -> None:
    assert thresholds()["score.LEVEL"] == "0.04"
    assert thresholds()["score.ADEQUATE"] == "0.05"
    assert "THRESHOLDS OR LIBRARY CHANGED" in table([line(), line(frozen="another")])
    assert "CHANGED" not in table([line(), line()])


def test_that_a_set_that_cannot_be_made_leaves_its_reason_and_is_scored_as_undecided(
    monkeypatch,
) -> None:
    monkeypatch.setattr("benchmarks.gap.sets._ATTEMPTS", 1)
    monkeypatch.setattr("benchmarks.gap.sets._ACTS", math.inf)  # as if no effect did anything
    failed = run_task(Task("effect", 3, 10, "polytropic", 0, effects=SMALL))
    assert "could be simulated" in failed["error"]
    rows = shares([failed, line()])
    assert value_of(rows, "named right, effect in the library").value == pytest.approx(0.5)
    assert "2 sets, 1 failed" in table([failed, line(frozen=frozen())])


@pytest.mark.parametrize(("hits", "count"), [(0, 20), (3, 20), (20, 20), (7, 200)])
def test_that_intervals_are_those_of_clopper_and_pearson(hits: int, count: int) -> None:
    exact = binomtest(hits, count).proportion_ci(0.9, "exact")
    assert clopper_pearson(hits, count) == pytest.approx((exact.low, exact.high))
    if hits == 0:
        assert clopper_pearson(hits, count)[1] == pytest.approx(1.0 - 0.05 ** (1.0 / count))


@pytest.mark.parametrize(
    ("changes", "right"),
    [
        ({}, True),
        ({"verdict": "class", "cause": ["damage", "wall"]}, True),
        ({"cause": ["damage"]}, False),
        ({"cause": ["wall", "damage"], "selected": ["wall"]}, False),  # an effect too many
        ({"verdict": "undecided"}, False),
        ({"verdict": "other", "cause": []}, False),
        (
            {"truth": ["trigger_offset"], "cause": ["residual_velocity"]},
            True,
        ),  # the same to first order
    ],
)
def test_that_a_cause_is_right_if_it_is_the_truth_or_a_class_with_it(
    changes: dict, right: bool
) -> None:
    assert named_right(line(**changes)) == right


@pytest.mark.parametrize(
    ("cause", "selected", "first", "both"),
    [
        (["wall", "damage"], ["wall"], True, True),
        (["wall", "damage", "clock"], ["wall"], True, True),
        (["wall", "clock"], ["wall"], True, False),
        (["clock", "wall"], ["clock"], False, False),
        (["damage"], [], True, False),
    ],
)
def test_that_pairs_are_scored_by_the_first_and_by_both(
    cause, selected, first: bool, both: bool
) -> None:
    pair = line("pair", truth=["damage", "wall"], cause=cause, selected=selected)
    assert (first_right(pair), both_right(pair)) == (first, both)


def test_that_figures_are_the_shares_counted_by_hand() -> None:
    lines = [
        *(line("none") for _ in range(19)),
        line("none", gap=True, verdict="other"),
        *(line() for _ in range(3)),
        line(verdict="other", cause=[]),
        line(gap=False, verdict="none", cause=[], posterior=None),
        line(nuisances=True, cause=["damage"]),
        line("withheld", verdict="other", cause=[]),
        line("withheld", cause=["damage"]),
        line("withheld", gap=False, verdict="none", cause=[], posterior=None),
    ]
    rows = shares(lines)
    assert value_of(rows, "false alarm, no gap", "all").value == pytest.approx(0.05)
    assert value_of(rows, "named right, effect in the library").value == pytest.approx(3 / 5)
    assert value_of(rows, "named right, given detected").value == pytest.approx(3 / 4)
    assert value_of(rows, "named right, with nuisances").value == 0.0
    assert value_of(rows, "withheld called other, given detected").count == 2
    assert value_of(rows, "withheld given a wrong name, given detected").value == pytest.approx(0.5)
    assert value_of(rows, "false other, effect in the library", "all").value == pytest.approx(1 / 6)
    assert value_of(rows, "named right, effect in the library", "10x10").count == 0
    assert "met" in str(value_of(rows, "false alarm, no gap", "all"))
    assert "missed" in str(value_of(rows, "named right, effect in the library"))


def test_that_the_posterior_is_summed_over_classes_and_other_may_be_left_out() -> None:
    one = line(
        posterior={"residual_velocity": 0.5, "trigger_offset": 0.35, "wall": 0.05, "other": 0.1}
    )
    classes, probability = posterior(one, given_library=False)[0]
    assert (set(classes), probability) == ({"start"}, pytest.approx(0.85))
    assert posterior(one, given_library=True)[0][1] == pytest.approx(0.85 / 0.9)
    assert [set(c) for c in credible(one, given_library=False)] == [{"start"}, {"other"}]
    assert [set(c) for c in credible(one, given_library=True)] == [{"start"}, {"wall"}]


def test_that_the_interval_of_a_median_lies_between_order_statistics() -> None:
    row = quantile_row("median", "3x10", [float(i) for i in range(101)], 0.5)
    assert (row.value, row.count) == (50.0, 101)
    assert (row.low, row.high) == (42.0, 59.0)  # binomial(101, 1/2) at 5 and 95 per cent


def test_that_shuffled_truths_and_designs_alone_are_at_chance_and_told_truths_are_not() -> None:
    names = ("wall", "damage", "clock", "gas_loss")
    source = generator(1)
    lines = []
    for i in range(80):
        name = names[i % 4]
        designs = draw_designs(3, source).tolist()
        lines.append(line(truth=[name], cause=[name], designs=designs))
    assert value_of(shares(lines), "named right, effect in the library").value == 1.0
    for row in controls(lines):
        assert row.low < 0.25 < row.high, row
    for x in lines:  # now the designs give the truth away
        x["designs"] = [[100.0 * (1 + names.index(x["truth"][0])), 0.2]] * 3
    assert all(guess_from_designs(lines))


def test_that_a_run_stopped_early_has_as_many_of_each_kind_and_pairs_are_of_one_size() -> None:
    wanted = list(tasks(("none", "pair"), ("3x10", "3x100"), "polytropic", 2, seed=7))
    assert [t.key for t in wanted[:3]] == [
        f"{name}/polytropic/exact/7" for name in ("none/3x10", "none/3x100", "pair/5x100")
    ]
    assert len({t.key for t in wanted}) == 6


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Task("some", 3, 10, "polytropic", 0), "expected a kind"),
        (lambda: Task("none", 0, 10, "polytropic", 0), "at least 1"),
        (lambda: list(tasks(("none",), ("3by10",), "polytropic", 1)), "write designs x repeats"),
        (
            lambda: list(tasks(("none",), ("3x10",), "polytropic", 1, effects=("ghosts",))),
            "Unknown effect 'ghosts'",
        ),
    ],
)
def test_that_a_bad_request_says_what_was_expected(call, message: str) -> None:
    with pytest.raises(InputDataError, match=message):
        call()
