"""The answers on hand-made tables: who wins, whether it is significant, and when nobody does."""

import math

import numpy as np
import pytest
from scipy import stats

from econgs_bench.reports.comparability import compared, judged
from econgs_bench.reports.effects import effect
from econgs_bench.reports.family import Family
from econgs_bench.reports.report import Report
from econgs_bench.reports.schema import TABLES, frame
from econgs_bench.reports.sections.answers import conclusion as conclusions
from econgs_bench.reports.sections.answers.conclusion import (
    CRITERIA,
    EDITABLE,
    ROBUST,
    compare,
    scope,
)
from econgs_bench.reports.sections.answers.contest import contests, of_report
from econgs_bench.reports.sections.ladders.table import ladders
from econgs_bench.reports.tables.protocols import by_protocol
from tests.reports.sections.ladders.test_table import table as rungs

SMALLEST, PICTURE, TRAINING, DRAWING, MEMORY = CRITERIA
NO_LADDERS = ladders(frame("rungs"))


def row(method, psnr, dataset="d", scene="s", seed=0, **more):
    speeds = {"train_seconds": 10.0, "fps": 100.0, "processor": "P", "fit_processor": "P", "threads": 1}
    kernel = {"reference_seconds": 1.0, "fit_reference_seconds": 1.0}
    axes = {
        "job": f"{method}-{dataset}-{scene}-{seed}-{sorted(more.items())}",
        "dataset": dataset,
        "seed": seed,
    }
    axes |= {"kind": "basic", "variant": "", "preset": "quick", "split": "test", "requested_views": 42}
    numbers = {"size_bytes": 1 << 20, "peak_host_bytes": 1 << 28, "status": "ok", "stale": False}
    return axes | speeds | kernel | numbers | {"method": method, "scene": scene, "psnr": psnr} | more


def contest(*rows):
    return contests(table(*rows))[0]


def table(*rows):
    return compared(by_protocol({"results": judged(frame("results", rows))}))["results"]


ALONE = Family()
"""Of a page that has no other lead."""


def measured(criterion, rivals, family=ALONE):
    return conclusions.measured(criterion, rivals, family)


def answers(rivals, results, climbed):
    return conclusions.answers(rivals, results, climbed, ALONE)


def of(answered, title):
    return next(answer for answer in answered if answer.title == title)


def pair(differences, first="a", second="b", **more):
    """Two methods on one dataset per difference of PSNR."""
    for i, difference in enumerate(differences):
        yield row(first, 30.0 + difference, f"d{i}", **more)
        yield row(second, 30.0, f"d{i}", **more)


def test_a_lead_is_significant_where_students_t_says_so():
    differences = [1.0, 1.5, 0.7, 1.2]
    answer = measured(PICTURE, contest(*pair(differences)))
    low, high = stats.ttest_1samp(differences, 0.0).confidence_interval()
    assert answer.winner == "a"
    assert f"1.10 dB higher than b (95 %: {low:.2f} to {high:.2f}; " in answer.sentence
    p = stats.ttest_1samp(differences, 0.0).pvalue
    assert compare(PICTURE, contest(*pair(differences))).p == pytest.approx(p)
    assert "better on 4 of 4 datasets; one seed" in answer.sentence
    assert [place.method for place in answer.places] == ["a", "b"]


def test_first_places_are_counted_by_scene_from_means_over_seeds():
    values = {"x": {"s": (31.0, 33.0), "t": (30.0, 30.0), "u": (29.0, 29.0)},
              "y": {"s": (32.5, 30.5), "t": (30.0, 30.0), "u": (35.0, 27.0)}}  # fmt: skip
    rows = [
        row(name, psnr, scene=scene, seed=seed)
        for name, scenes in values.items()
        for scene, seeds in scenes.items()
        for seed, psnr in enumerate(seeds)
    ]
    answer = measured(PICTURE, contest(*rows))
    assert {place.method: answer.firsts(place) for place in answer.places} == {
        "x": "first on 2 of 3 scenes",  # equal to y on t
        "y": "first on 2 of 3 scenes",
    }
    sizes = measured(
        SMALLEST, contest(*(one | {"size_bytes": 2 if one["method"] == "x" else 1} for one in rows))
    )
    assert [(place.method, place.firsts) for place in sizes.places] == [("y", 3), ("x", 0)]
    assert sizes.firsts(sizes.places[1]) == ""


def test_datasets_that_disagree_have_no_winner():
    answer = measured(PICTURE, contest(*pair([3.0, -1.0, 2.0, -1.5])))
    assert answer.winner == ""
    assert answer.sentence.startswith("No winner among a and b: a, 30.62 dB, is 0.62 dB higher than b")
    assert "better on 2 of 4 datasets" in answer.sentence


def test_a_tie_has_no_winner():
    tables = [*pair([0.0, 0.0, 0.0])]
    answered = answers(contest(*tables), table(*tables), NO_LADDERS)
    assert {answer.winner for answer in answered} == {""}
    assert "30.00 dB of both a and b on 3 datasets" in of(answered, "Best picture").sentence


def test_one_scene_with_one_seed_decides_nothing():
    answer = measured(PICTURE, contest(*pair([5.0])))
    assert answer.winner == ""
    assert "no interval" in answer.sentence
    assert "--seed 0 --seed 1 --seed 2" in answer.sentence, "what would give one"


def test_an_interval_that_says_nothing_is_not_printed():
    values = (("s", 30.0, 38.0), ("t", 31.0, 30.0))
    rows = [row(name, psnr, scene=s) for s, a, b in values for name, psnr in (("x", a), ("y", b))]
    sentence = measured(PICTURE, contest(*rows)).sentence
    assert "2 scenes decide nothing" in sentence
    assert "95 %" not in sentence


def test_a_lead_counts_by_what_else_the_page_reports():
    """Alone it is significant; among ten leads that say nothing it is not, and wins nothing."""
    rows = contest(*pair([1.0, 1.5, 0.3, 1.2]))
    p = compare(PICTURE, rows).p
    assert 0.005 < p < 0.05
    alone, among = (measured(PICTURE, rows, Family.of(others)) for others in ([p], [p, *([0.9] * 9), None]))
    assert alone.winner == "a"
    assert "significant among 1 lead of this page" in alone.sentence
    assert among.winner == ""
    assert among.sentence.startswith("No winner among a and b:")
    assert "not significant among 10 leads of this page" in among.sentence
    assert "95 %" in among.sentence, "the interval of this lead alone"


def test_no_method_wins_where_nothing_differs_but_by_chance():
    """Of 200 pages with five criteria of equal methods about 5 % declare a winner; uncorrected about 20 %."""
    declared = uncorrected = 0
    rng = np.random.default_rng(5)
    for _ in range(200):
        p_values = [stats.ttest_1samp(rng.normal(size=4), 0.0).pvalue for _ in range(5)]
        family = Family.of(p_values)
        declared += any(map(family.significant, p_values))
        uncorrected += min(p_values) < 0.05
    assert declared <= 18
    assert uncorrected >= 30


def test_scenes_of_one_dataset_and_seeds_are_both_counted():
    """Variance of the scenes' means and of the seeds' means, each over its number (two-way layout)."""
    noise = np.array([[0.9, 1.3, 1.1], [1.6, 1.4, 1.9]])  # scene, seed
    cells = {
        sign: {
            "d": {f"s{i}": {k: sign * v / 2 for k, v in enumerate(seeds)} for i, seeds in enumerate(noise)}
        }
        for sign in (1, -1)
    }
    result = effect(cells[1], cells[-1], 1, ratio=False)
    scenes, seeds = noise.mean(1), noise.mean(0)
    terms = np.array([scenes.var(ddof=1) / 2, seeds.var(ddof=1) / 3])
    freedom = terms.sum() ** 2 / (terms**2 / (1, 2)).sum()
    assert result.mean == pytest.approx(noise.mean())
    assert result.half == pytest.approx(stats.t.ppf(0.975, freedom) * math.sqrt(terms.sum()))
    assert result.p == pytest.approx(2 * stats.t.sf(noise.mean() / math.sqrt(terms.sum()), freedom))
    assert (result.seeds, result.scenes) == ((3, 3), 2)


def test_factors_are_means_of_logarithms():
    rows = [*pair([0.0] * 3)]
    for one, size in zip(rows, (100, 200, 100, 400, 100, 800), strict=True):
        one["size_bytes"] = size << 20
    answer = measured(SMALLEST, contest(*rows))
    assert answer.sentence.startswith(
        "No winner among a and b: a, 100 MiB, is 4.0 times smaller than b (400 MiB"
    )
    assert answer.places[1].value == pytest.approx(400 << 20)


def test_a_method_with_few_datasets_is_not_ranked():
    found = contest(*pair([1.0] * 4), row("c", 50.0, "d0"))
    assert found.methods == ["a", "b"]
    assert found.others == {"c": 1}
    assert measured(PICTURE, found).winner == "a"


def test_a_failed_fit_counts_for_robustness_and_takes_its_dataset_out_of_the_rest():
    rows = [*pair([1.0, 1.2, 1.4, -9.0])]
    rows[-1] |= {"status": "oom", "psnr": None}
    answered = answers(contest(*rows), table(*rows), NO_LADDERS)
    assert "better on 3 of 3 datasets" in of(answered, "Best picture").sentence
    robust = of(answered, ROBUST)
    assert robust.winner == "a"
    assert "1 failed fit" in robust.sentence


def test_robust_is_who_is_least_behind_in_the_worst_scene():
    answered = answers(contest(*pair([3.0, 3.0, -1.0])), table(*pair([3.0, 3.0, -1.0])), NO_LADDERS)
    robust = of(answered, ROBUST)
    assert robust.winner == "a"
    assert "by at most 1.0 dB (d2 / s); b: behind the best method of a scene" in robust.sentence
    assert robust.sentence.endswith("by at most 3.0 dB (d0 / s). The worst of 3 scenes.")


def test_who_leads_everywhere_is_behind_nobody():
    robust = of(answers(contest(*pair([3.0, 2.0])), table(*pair([3.0, 2.0])), NO_LADDERS), ROBUST)
    assert robust.sentence.startswith("a: never behind another method; b: behind the best")
    assert [place.text for place in robust.places] == ["0.0 dB", "\N{MINUS SIGN}3.0 dB"]


def test_few_training_views_count_for_robustness_alone():
    rows = [*pair([1.0, 1.1, 1.2]), *pair([-7.0, -7.0, -7.0], requested_views=6)]
    answered = answers(contest(*rows), table(*rows), NO_LADDERS)
    assert of(answered, "Best picture").winner == "a"
    assert of(answered, ROBUST).winner == "b"
    assert of(answered, ROBUST).sentence.endswith("few training views included.")


def test_speeds_are_of_one_processor():
    rows = [*pair([0.0] * 4), *pair([0.0], seed=1)]
    for one in rows:
        one["train_seconds"] = 10.0 if one["method"] == "a" else 20.0
    rows[-3] |= {"fit_processor": "Q", "train_seconds": 1.0}
    answer = measured(TRAINING, contest(*rows))
    assert answer.winner == "a"
    assert "2.00 times faster than b" in answer.sentence
    assert "1 row from other processors" in answer.sentence
    assert "better on 3 of 3 datasets" in answer.sentence, "the dataset without a time of b is out"


def test_disturbed_times_are_left_out_and_counted_and_none_is_corrected():
    """Two datasets beside a kernel that took twice its quiet time; 1.4 times is within the limit."""
    rows = [*pair([0.0] * 8)]
    for one in rows[:3:2]:
        one |= {"reference_seconds": 2.0, "fit_reference_seconds": 2.0, "fps": 50.0, "train_seconds": 20.0}
    for one in rows[1:]:
        one |= {"reference_seconds": 1.4, "fit_reference_seconds": 1.4} if one["method"] == "b" else {}
    for criterion, value in ((DRAWING, 100.0), (TRAINING, 10.0)):
        answer = measured(criterion, contest(*rows))
        assert [place.value for place in answer.places] == pytest.approx([value, value])
        assert "without 2 rows with a disturbed time" in answer.sentence
        column = contest(*rows).values(criterion.column)
        assert sorted(column.cells["a"]) == sorted(column.cells["b"]) == [f"d{i}" for i in range(2, 8)]


def test_a_winner_leads_every_other_method_significantly():
    """The next best is behind everywhere by as much; one with a lower mean was ahead somewhere."""
    rows = [*pair([1.0, 1.1, 0.9, 1.0])]
    assert measured(PICTURE, contest(*rows)).winner == "a"
    rows += [row("c", psnr, f"d{i}") for i, psnr in enumerate((31.4, 29.0, 28.0, 28.0))]
    answer = measured(PICTURE, contest(*rows))
    assert answer.winner == ""
    assert answer.sentence.startswith(
        "No winner among a and c: a, 31.00 dB, is 1.90 dB higher than c (29.10 dB"
    )


def test_stale_rows_are_counted():
    rows = [*pair([0.0] * 4)]
    assert "Stale" not in scope(contest(*rows))
    rows[0]["stale"] = rows[2]["stale"] = True
    assert scope(contest(*rows)).endswith("Stale rows, which today's methods would not make: a 2.")


def test_datasets_that_not_all_finished_are_named():
    rows = [*pair([1.0] * 4)]
    assert " on 4 datasets, " in scope(contest(*rows))
    rows[-1] |= {"status": "oom", "psnr": None}
    assert " on 3 of 4 datasets, " in scope(contest(*rows))


def test_a_method_on_fewer_scenes_leaves_the_others_their_answer():
    whole = [
        row(name, 30.0 + gain, scene=f"s{i}") for i in range(3) for name, gain in (("a", 1 + i / 9), ("b", 0))
    ]
    alone = measured(PICTURE, contest(*whole))
    one_of_three = contest(*whole, row("c", 50.0, scene="s0"))
    assert one_of_three.others == {"c": 0}
    assert measured(PICTURE, one_of_three) == alone
    two_of_three = contest(*whole, row("c", 50.0, scene="s0"), row("c", 50.1, scene="s1"))
    places = {place.method: place.value for place in measured(PICTURE, two_of_three).places}
    assert places == pytest.approx({"c": 50.05, "a": 31 + 1 / 18, "b": 30.0}), "the means of s0 and s1"


def test_a_time_of_zero_is_no_time():
    """Tables of other tools may round to whole seconds."""
    rows = [*pair([0.0] * 4)]
    rows[0]["train_seconds"] = 0.0
    assert "of both a and b on 3 datasets" in measured(TRAINING, contest(*rows)).sentence


def test_variants_rates_and_choices_of_scenes_are_not_compared():
    others = [
        row("c", 99.0, variant="x=1"), row("c", 99.0, rate=4.0), row("c", 99.0, kind="composed"),
        row("c", 99.0, scenes_together=3),
    ]  # fmt: skip
    assert contest(*pair([1.0]), *others).methods == ["a", "b"]
    assert contests(table(row("a", 30.0))) == []


def test_edits_are_counted_and_compared_where_all_make_them():
    edits = [
        row("a", 30.0, kind="edited", edit="light"), row("a", 40.0, kind="edited", edit="color"),
        row("b", 20.0, kind="edited", edit="light"),
        row("b", None, kind="edited", edit="color", status="refused"),
        *(row("c", None, kind="edited", edit=edit, status="refused") for edit in ("light", "color")),
    ]  # fmt: skip
    rows = [*pair([1.0]), row("c", 30.0, "d0"), row("e", 30.0, "d0"), *edits]
    answer = of(answers(contest(*rows), table(*rows), NO_LADDERS), EDITABLE)
    assert answer.winner == "a"
    assert [place.text for place in answer.places] == ["2 of 2", "1 of 2", "0 of 2"]
    assert "1 edit that they share: 30.00 dB, 20.00 dB" in answer.sentence
    assert "c refuses all; not tried: e" in answer.sentence


def climb(method, *psnr, **more):
    """A method's rungs, from the usual run on."""
    return [{"method": method, "place": place, "psnr": value} | more for place, value in enumerate(psnr)]


def robust(*climbs, methods="ab"):
    """The answer on robustness, of a contest that says nothing about it."""
    rows = [row(name, 30.0, f"d{i}") for i in range(2) for name in methods]
    table_of_ladders = ladders(rungs(*(each for own in climbs for each in own)))
    return of(answers(contest(*rows), table(*rows), table_of_ladders), ROBUST)


def test_the_most_robust_holds_the_most_rungs() -> None:
    answer = robust(climb("a", 30.0, 29.0, 28.0, 20.0), climb("b", 33.0, 29.0, 28.0, 32.0))
    assert answer.winner == "a"
    assert answer.sentence == "a holds 2 rungs of 3 on 1 ladder from harmless to fatal; b 1."
    assert [place.text for place in answer.places] == ["2 of 3 rungs", "1 of 3 rungs"]


def test_equally_many_rungs_have_no_winner() -> None:
    answer = robust(climb("a", 30.0, 29.0, 20.0), climb("b", 33.0, 32.0, 25.0))
    assert answer.winner == ""
    assert answer.sentence.startswith("No winner: a and b hold 1 rung of 2 on 1 ladder")


def test_only_rungs_count_on_which_all_were_measured() -> None:
    shared = [climb("a", 30.0, 29.0, 29.0), climb("b", 30.0, 20.0)]
    other = [climb("a", 30.0, 20.0, ladder="start")]
    assert robust(*shared, *other).sentence.startswith("a holds 1 rung of 1 on 1 ladder")
    # Of two scenes, a rung holds where it holds on both.
    again = [climb("a", 30.0, 20.0, 20.0, subject="x/y"), climb("b", 30.0, 29.0, subject="x/y")]
    assert robust(*shared, *again).winner == ""


def test_a_method_with_few_ladders_is_not_compared() -> None:
    climbs = [climb(name, 30.0, 29.0, ladder=ladder) for name in "ab" for ladder in ("x", "y", "z")]
    answer = robust(*climbs, climb("c", 30.0, 20.0, ladder="x"), methods="abcd")
    assert [place.method for place in answer.places] == ["a", "b"]
    assert "c climbed 1 ladder and is not compared; d climbed 0 ladders and" in answer.sentence


def test_a_failed_fit_holds_nothing() -> None:
    failed = climb("b", 30.0, 29.0, 29.0)
    failed[1] |= {"status": "oom", "psnr": None}
    assert robust(climb("a", 30.0, 29.0, 29.0), failed).winner == "a"


def test_without_two_methods_on_a_ladder_the_worst_case_decides() -> None:
    assert "behind" in robust(climb("a", 30.0, 20.0)).sentence
    assert "behind" in robust(climb("a", 30.0, 20.0, preset="other"), climb("b", 30.0, 20.0)).sentence


def drawings(method="plenoxels", **drawn):
    """A method on two datasets, as published and as means over 16 points, beside another."""
    for dataset in ("d", "e"):
        yield row("3dgs", 35.0, dataset)
        yield row(method, 30.0, dataset, fps=64.0)
        yield row(method, 36.0, dataset, fps=4.0, variant="samples=16", **drawn)


def test_the_drawing_of_means_stands_for_a_method_with_its_speed():
    contest_ = contest(*drawings())
    assert contest_.methods == ["3dgs", "Plenoxels [samples=16]"]
    assert "Plenoxels [samples=16], 36.00 dB" in measured(PICTURE, contest_).sentence
    assert {place.method: place.text for place in measured(DRAWING, contest_).places} == {
        "3dgs": "100 FPS",
        "Plenoxels [samples=16]": "4.0 FPS",
    }


def test_a_drawing_of_means_that_lacks_a_model_takes_no_part():
    *rows, _ = drawings()
    contest_ = contest(*rows)
    assert contest_.methods == ["3dgs", "plenoxels"]
    assert compare(PICTURE, contest_).means == {"3dgs": 35.0, "plenoxels": 30.0}


def test_other_options_beside_a_drawing_take_no_part():
    rows = drawings(options="{}")
    changed = [one | {"variant": "resolution=64,samples=16"} if one["variant"] else one for one in rows]
    assert contest(*changed).methods == ["3dgs", "plenoxels"]


def test_a_method_behind_at_every_shared_seed_never_wins():
    """Its mean is higher by seeds that the other lacks."""
    rows = [row("a", psnr, f"d{i}", seed=seed) for i in range(3) for seed, psnr in enumerate((30, 36, 36))]
    rows += [row("b", 32.0 + 0.1 * i, f"d{i}") for i in range(3)]
    answer = measured(PICTURE, contest(*rows))
    assert answer.winner == "b"
    assert answer.sentence.startswith("b, 32.10 dB: 2.10 dB higher than a (")
    robust = of(answers(contest(*rows), table(*rows), NO_LADDERS), ROBUST)
    assert robust.sentence.startswith("b: never behind another method; a: behind the best method")


def test_a_lead_is_over_the_seeds_of_both_but_never_against_those_of_all():
    """c has one seed; a leads b by all their seeds, and by that of c."""
    own = {"a": (33, 34, 35), "b": (32, 32.5, 34.5), "c": (20,)}
    rows = [
        row(name, psnr, f"d{i}", seed=seed)
        for i in range(3)
        for name, each in own.items()
        for seed, psnr in enumerate(each)
    ]
    answer = measured(PICTURE, contest(*rows))
    assert {place.method: place.value for place in answer.places} == pytest.approx(
        {"a": 33, "b": 32, "c": 20}
    )
    assert "a, 34.00 dB, is 1.00 dB higher than b (33.00 dB;" in answer.sentence
    assert "3 seeds" in answer.sentence
    turned = [one | {"psnr": one["psnr"] - 6.0 * (one["method"] == "a" and one["seed"] > 0)} for one in rows]
    answer = measured(PICTURE, contest(*turned))
    assert "33.00 dB" in answer.sentence, "by the seed of all three, a is first"
    assert "one seed" in answer.sentence


def test_methods_without_a_common_seed_are_compared_by_means_and_it_is_said():
    rows = [row("a", 31.0, f"d{i}", seed=0) for i in range(3)] + [
        row("b", 30.0, f"d{i}", seed=1) for i in range(3)
    ]
    assert "no common seed" in measured(PICTURE, contest(*rows)).sentence


def test_robustness_counts_what_all_methods_tried():
    values = {
        "a": {"easy": 40.0, "plain": 40.0, "hard": 30.0, "hardest": None},
        "b": {"easy": 41.0, "plain": 41.0, "hard": 20.0},
        "c": {"easy": 39.5, "plain": 39.5},
    }
    rows = [
        row(name, psnr, scene=scene, **({} if psnr else {"status": "failed"}))
        for name, scenes in values.items()
        for scene, psnr in scenes.items()
    ]
    robust = of(answers(contest(*rows), table(*rows), NO_LADDERS), ROBUST)
    assert {place.method: place.value for place in robust.places} == {"b": 0.0, "a": 1.0, "c": 1.5}
    assert "failed" not in robust.sentence
    assert "The worst of 2 scenes." in robust.sentence


def test_methods_of_other_datasets_leave_the_rest_their_answer():
    rows = [*pair([1.0, 1.0], "a", "b"), row("c", 20.0, "e0"), row("d", 21.0, "e0"), row("c", 20.0, "e1")]
    found = contest(*rows, row("d", 21.0, "e1"))
    assert found.methods == ["a", "b"]
    assert "Not ranked, as measured on fewer or other datasets: c (2), d (2)." in scope(found)
    assert "1.00 dB higher" in measured(PICTURE, found).sentence


def test_one_dataset_in_several_versions_counts_once():
    """Other rays a pixel make other truths of one scene."""
    apart = {
        f"d, {words}": '{"dataset": "another setting: truth"}'
        for words in ("one ray a pixel", "4 rays a pixel")
    }
    rows = [
        row(name, psnr, dataset, differences=why)
        for dataset, why in apart.items()
        for name, psnr in (("a", 31.0), ("b", 30.0))
    ]
    answer = measured(PICTURE, contest(*rows))
    assert "better on 1 of 1 dataset" in answer.sentence
    assert "no interval" in answer.sentence


def test_another_programs_clock_leaves_the_others_their_answer():
    rows = [
        row(name, 30.0, f"d{i}", fps=fps + i, ruler=ruler)
        for i in range(3)
        for name, fps, ruler in (("a", 100.0, 3), ("b", 80.0, 3), ("c", 900.0, 0))
    ]
    answer = measured(DRAWING, contest(*rows))
    assert answer.winner == "a"
    assert answer.sentence.endswith("; without 3 rows timed by other programs and c.")


def test_edits_of_another_split_are_not_counted():
    rows = list(pair([1.0, 1.0, 1.0]))
    rows += [row("a", 30.0, "d0", kind="edited", edit="opacity=2")]
    rows += [row("b", 40.0, "d0", kind="edited", edit="opacity=2", split="val")]
    found = of(answers(contest(*rows), table(*rows), NO_LADDERS), EDITABLE)
    assert found.sentence == "a makes 1 of 1; not tried: b."


def test_seeds_that_failed_leave_no_luckier_ones():
    rows = [row(name, psnr + 0.1 * i, f"d{i}", seed=seed) for i in range(3) for seed in range(3)
            for name, psnr in (("a", 31.0), ("b", 30.0))]  # fmt: skip
    failed = {"status": "diverged", "psnr": None, "size_bytes": None}
    lucky = [
        row("c", 33.0, f"d{i}", seed=seed) | (failed if seed else {}) for i in range(3) for seed in range(3)
    ]
    answer = measured(PICTURE, contest(*rows, *lucky))
    assert answer.winner == "a"
    assert answer.sentence.endswith("3 seeds; without c.")
    assert measured(SMALLEST, contest(*rows, *lucky)).sentence.endswith("without c.")


def test_a_lone_scene_of_a_second_dataset_hides_no_spread_of_scenes():
    scenes = [4.9 if i % 2 else -4.5 for i in range(10)]
    rows = [row(name, 30.0 + gap * (name == "a") + 0.01 * seed, scene=f"s{i}", seed=seed)
            for i, gap in enumerate(scenes) for seed in range(3) for name in "ab"]  # fmt: skip
    rows += [
        row(name, 30.5 if name == "a" else 30.0, "other", seed=seed) for seed in range(3) for name in "ab"
    ]
    low, high = compare(PICTURE, contest(*rows)).leads[0].ends
    spread = np.var(scenes, ddof=1) * (1 / 10 + 1) / 4
    assert (high - low) / 2 == pytest.approx(stats.t.ppf(0.975, 9) * math.sqrt(spread), rel=1e-6)


def test_seeds_that_change_nothing_repeat_nothing():
    rows = [
        row(name, 30.0, seed=seed, size_bytes=size)
        for seed in range(3)
        for name, size in (("a", 100), ("b", 101))
    ]
    answer = measured(SMALLEST, contest(*rows))
    assert (answer.winner, compare(SMALLEST, contest(*rows)).p) == ("", None)
    assert "no interval: add seeds" in answer.sentence


def test_test_views_decide_before_validation_views():
    on_val = pair([3.0, 3.0, 3.0], split="val")
    on_test = pair([-3.0, -2.0])
    found = contests(table(*on_val, *on_test))
    assert [one.split for one in found] == ["test", "val"]
    assert "preset quick, split val" in scope(found[1])
    assert "split" not in scope(found[0])


def test_a_lead_that_the_pace_of_the_machine_explains_is_none():
    def rows(*kernels):
        methods = (("a", 140.0, kernels[0]), ("b", 100.0, kernels[1]))
        return [row(name, 30.0, f"d{i}", fps=fps + i * (name == "a"), reference_seconds=kernel)
                for i in range(4) for name, fps, kernel in methods]  # fmt: skip

    assert measured(DRAWING, contest(*rows(1.0, 1.0))).winner == "a"
    answer = measured(DRAWING, contest(*rows(1.0, 1.45)))
    assert answer.winner == ""
    assert "the reference kernel beside them differs by 1.45 times" in answer.sentence


def test_rows_that_do_not_compete_choose_no_place():
    def at(place, **more):
        return [row(name, 30.0 + i, scene=scene, processor=place, fit_processor=place,
                    train_seconds=10.0 * (1 + i) + 0.1 * ord(scene) % 1, **more)
                for i, name in enumerate("ab") for scene in "stuv"]  # fmt: skip

    others = [one for k in ("q=1", "q=2") for one in at("server, 8 cores", variant=k, base="")]
    tables = {name: frame(name) for name in TABLES}
    tables["results"] = judged(frame("results", [*at("laptop, 2 cores"), *others]))
    (found,) = of_report(Report(tables))
    assert measured(TRAINING, found).winner == "a"


def test_edits_that_nobody_asked_for_are_not_refused():
    rows = list(pair([-1.0, -1.0]))
    rows += [row(name, psnr, f"d{i}", kind="edited", edit=edit, scene=f"s {edit}")
             for i in range(2) for edit in ("x=1", "y=1")
             for name, psnr in (("a", 30.0), ("b", 35.0)) if (name, i) != ("b", 1)]  # fmt: skip
    everything = table(*rows)
    answer = of(answers(contests(everything)[0], everything, NO_LADDERS), EDITABLE)
    assert answer.winner == ""
    assert answer.sentence.startswith(
        "b makes 2 of 2; a makes 2 of 2; PSNR of the 2 edits that they share: 35.00 dB, 30.00 dB"
    )
