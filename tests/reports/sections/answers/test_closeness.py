"""Leads in PSNR at the noise floor of the truth are called so: best picture, races, rates."""

import re

import pytest

from econgs_bench.reports.report import Report
from econgs_bench.reports.sections.answers.conclusion import scope
from econgs_bench.reports.sections.order import family
from econgs_bench.reports.sections.races import conclusion as races
from econgs_bench.reports.sections.rates import conclusion as rates
from tests.reports.sections.answers.test_conclusion import PICTURE, SMALLEST, contest, measured, row
from tests.reports.sections.races.test_races import ALONE, TIME, fit, of

WORDS = re.compile(r"within 3 dB of the truth's own floor on (\d) of (\d) scenes?")


def near(text):
    """(scenes at the floor, scenes) of each place in a text."""
    return [tuple(map(int, match)) for match in WORDS.findall(text)]


def test_the_best_picture_names_the_scenes_at_the_floor():
    rivals = [
        row(method, psnr, f"d{i}", floor=floor)
        for i, floor in enumerate((35.0, 33.9, 34.1, None))
        for method, psnr in (("a", 31.0), ("b", 30.0 + 0.01 * i))
    ]
    answer = measured(PICTURE, contest(*rivals))
    assert answer.winner == "a"
    assert near(answer.sentence) == [(1, 4)], "31.0 is above 33.9 - 3, and not above 34.1 - 3"
    assert near(measured(SMALLEST, contest(*rivals)).sentence) == []
    far = [one | {"floor": 50.0} for one in rivals]
    assert near(measured(PICTURE, contest(*far)).sentence) == []


def test_the_compared_method_may_be_the_one_at_the_floor():
    """On a scene where the winner is far below it."""
    rivals = [
        row(method, psnr, f"d{i}", floor=40.0)
        for i, pair in enumerate(((36.0, 39.0), (36.0, 20.0), (36.0, 20.0), (36.0, 20.0)))
        for method, psnr in zip("ab", pair, strict=True)
    ]
    assert near(measured(PICTURE, contest(*rivals)).sentence) == [(1, 4)]


def test_a_lead_of_a_race_names_the_scenes_at_the_floor():
    race = of(
        TIME,
        *(
            fit(method, seconds, psnr + seconds / 10.0, f"s{scene}", seed, floor=34.0 + scene)
            for method, psnr in (("3dgs", 30.0), ("hac", 29.0))
            for scene in range(4)
            for seed in range(3)
            for seconds in (10.0, 40.0)
        ),
    )
    sentence = " ".join(races.conclusion([race], ALONE))
    expected = {
        lead.limit: sum(race.mean("3dgs", lead.limit) > 34.0 + scene - 3.0 for scene in range(4))
        for lead in race.leads
    }
    assert set(expected) == {10, 30}
    assert expected[30] > expected[10] == 0, "31.0 dB is 3 dB below the lowest floor"
    assert near(sentence) == [(expected[30], 4)]
    first, second = (races.row(race, lead, ALONE) for lead in race.leads)
    assert near(" ".join(first)) == []
    assert near(second[races.HEADS.index("By [dB]")]) == [(expected[30], 4)]


@pytest.mark.parametrize(("floor", "scenes"), [(60.0, []), (38.5, [(1, 2)]), (None, [])])
def test_a_lead_at_equal_bytes_names_the_scenes_at_the_floor(maker, floor, scenes):
    """The best model of the two curves has 36 and 34 dB."""
    for scene, shift in (("a", 0.0), ("b", -2.0)):
        for method, gain in (("econgs", 1.0), ("hac", 0.0)):
            for rate, psnr in ((0.5, 32.0), (1.0, 33.0), (2.0, 34.0), (4.0, 35.0)):
                for seed in range(3):
                    maker.run("d", scene, method, rate=rate, psnr=psnr + shift + gain + 0.01 * seed,
                              size=int(1e5 * rate), seed=seed, floor=floor, reason=None)  # fmt: skip
    report = Report(maker.tables())
    sentence = rates.conclusion(rates.of_report(report), family(report))
    assert "significantly has the highest PSNR" in sentence
    assert near(sentence) == scenes


def test_the_scope_names_a_fixed_number_of_rays():
    rows = [row(method, 30.0, dataset) for dataset in "xy" for method in "ab"]
    assert "one ray a pixel" in scope(contest(*(one | {"samples": 1} for one in rows)))
    mixed = scope(contest(*(one | {"samples": 1 if one["dataset"] == "x" else 0} for one in rows)))
    assert "one ray a pixel (x)" in mixed
    assert "ray" not in scope(contest(*rows))
