"""Races on hand-made tables: what a method reaches at a limit, and who leads."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from econgs_bench.reports.family import Family
from econgs_bench.reports.sections.order import family
from econgs_bench.reports.sections.races.conclusion import DISCIPLINES, Front, conclusion, races, row
from econgs_bench.reports.sections.races.section import race_chart, section
from econgs_bench.reports.sections.section import Page
from econgs_bench.reports.style import MISSING, models
from tests.reports.sections.answers.test_conclusion import row as result
from tests.reports.sections.answers.test_conclusion import table

ALONE = Family()
"""Of a page that reports no other lead."""
TIME, SIZE, GAUSSIANS = DISCIPLINES
spots = st.lists(
    st.tuples(st.floats(0.01, 1e4), st.floats(10.0, 60.0)), min_size=1, max_size=8, unique_by=lambda s: s[0]
)


def fit(method, seconds, psnr, scene="s", seed=0, **more):
    """A model of some length of schedule, or rate."""
    length = "" if seconds == 10.0 else f"iterations={round(100 * seconds)}"
    more = {"variant": length, "base": length, "iterations": round(100 * seconds), **more}
    return result(method, psnr, scene=scene, seed=seed, train_seconds=seconds, **more)


def of(discipline, *rows):
    """The one race of a discipline."""
    (race,) = [race for race in races(table(*rows)) if race.discipline == discipline]
    return race


@given(spots, st.floats(0.001, 1e5))
def test_what_is_reached_is_numpys_interpolation_of_the_best_so_far(models_, limit):
    ordered = sorted(models_)
    best = np.maximum.accumulate([psnr for _, psnr in ordered])
    steps = [i for i in range(len(ordered)) if i == 0 or best[i] > best[i - 1]]
    x, y = [np.log(ordered[i][0]) for i in steps], [best[i] for i in steps]
    reached = Front.of(models_).at(limit)
    if limit < ordered[0][0]:
        assert reached is None
    else:
        assert reached == pytest.approx(np.interp(np.log(limit), x, y), abs=1e-9)


@given(spots, st.floats(0.001, 1e5), st.floats(1.0, 10.0))
def test_more_is_never_worse_and_no_model_beats_the_front(models_, limit, factor):
    front = Front.of(models_)
    reached, later = front.at(limit), front.at(limit * factor)
    affordable = [psnr for cost, psnr in models_ if cost <= limit]
    assert (reached is None) == (not affordable)
    if reached is not None:
        assert later >= reached >= max(affordable)


def test_the_leader_changes_with_the_limit_and_beginners_wait():
    race = of(
        TIME,
        *(fit("3dgs", seconds, psnr) for seconds, psnr in ((10.0, 30.0), (40.0, 34.0), (160.0, 35.0))),
        *(fit("hac", seconds, psnr) for seconds, psnr in ((100.0, 35.0), (400.0, 38.0))),
    )
    assert [(lead.limit, lead.method, lead.starters) for lead in race.leads] == [
        (10, "3dgs", 1),
        (30, "3dgs", 1),
        (120, "hac", 2),
    ]
    assert race.leads[1].psnr == pytest.approx(30.0 + 4.0 * np.log(3) / np.log(4))
    assert [lead.expense.seconds for lead in race.leads] == pytest.approx([10.0, 10.0, 100.0])
    assert race.costs("hac") == [100.0, 400.0]
    assert race.mean("hac", 99.0) is None


def test_a_model_that_a_seed_lacks_takes_no_part():
    """Or the mean at a limit would be of long schedules for one seed and of short ones for another."""
    rows = [
        fit(method, seconds, 30.0 + seconds / 10.0, seed=seed)
        for method in ("3dgs", "hac")
        for seed in range(3)
        for seconds in (10.0, 40.0)
    ]
    longer = fit("3dgs", 160.0, 50.0, seed=1)
    race, plain = of(TIME, *rows, longer), of(TIME, *rows)
    assert race.costs("3dgs") == [10.0, 40.0]
    assert race.leads == plain.leads
    # Seeds that have no length in common race as they are.
    apart = [fit("3dgs", 10.0, 30.0, seed=0), fit("3dgs", 40.0, 34.0, seed=1), *rows[6:]]
    assert of(TIME, *apart).seeds("3dgs") == [0, 1]


def test_a_lead_is_significant_by_scenes_and_seeds_alone():
    def race(lead, spread):
        rows = [
            fit(method, seconds, psnr + spread * ((-1) ** seed) * (method == "3dgs"), f"s{scene}", seed)
            for method, psnr in (("3dgs", 30.0 + lead), ("hac", 30.0))
            for scene in range(4)
            for seed in range(3)
            for seconds in (10.0, 40.0)
        ]
        return of(TIME, *rows)

    assert all(ALONE.significant(lead.p) and lead.method == "3dgs" for lead in race(1.0, 0.01).leads)
    assert not any(ALONE.significant(lead.p) for lead in race(0.1, 1.0).leads)
    line = row(race(1.0, 0.01), race(1.0, 0.01).leads[0], ALONE)
    assert line[:7] == ["training time", "d", "10 s", "3DGS", f"{31.0 + 0.01 / 3:.2f}", "10.0 s", "256"]
    assert line[-2:] == ["3", "2 of 2"]
    assert row(race(0.1, 1.0), race(0.1, 1.0).leads[0], ALONE)[3].startswith("not significant (")


def test_a_lead_is_significant_if_it_is_on_every_other_method():
    """VQ-3DGS has a lower mean than HAC, and is first on a scene."""
    psnr = {"3dgs": (31.0, 31.0, 31.0), "hac": (30.0, 30.1, 29.9), "vq-3dgs": (33.0, 27.0, 27.0)}
    race = of(
        TIME,
        *(
            fit(method, seconds, value, f"s{scene}")
            for method, values in psnr.items()
            for scene, value in enumerate(values)
            for seconds in (10.0, 40.0)
        ),
    )
    (lead,) = race.leads
    assert (lead.method, lead.nearest(ALONE)[0], ALONE.significant(lead.p)) == ("3dgs", "vq-3dgs", False)
    assert lead.p == max(effect.p for _, effect in lead.rivals)
    assert row(race, lead, ALONE)[3] == "not significant (3DGS)"


def test_only_default_settings_race_at_any_length_and_rate_and_trained_methods():
    mib = 1 << 20
    rows = [
        fit("3dgs", 10.0, 30.0, size_bytes=mib // 2),
        fit("3dgs", 40.0, 33.0, size_bytes=mib),
        fit("3dgs", 20.0, 60.0, variant="sh_degree=0", base="sh_degree=0", size_bytes=mib // 4),
        fit("ivr-gs", 10.0, 29.0, rate=16.0, size_bytes=mib // 8),
        fit("ivr-gs", 10.0, 31.0, rate=64.0, size_bytes=mib // 4),
        fit("sz3", 0.01, 90.0, size_bytes=mib // 9),
    ]
    race = of(SIZE, *rows)
    assert set(race.fronts) == {"3dgs", "ivr-gs"}
    assert [(lead.limit, lead.method) for lead in race.leads] == [
        (0.25, "ivr-gs"), (0.5, "ivr-gs"), (1.0, "3dgs"),
    ]  # fmt: skip


def test_disturbed_times_and_those_of_another_processor_are_left_out():
    quiet = [fit("3dgs", 10.0, 30.0, scene=f"s{i}") for i in range(6)]
    longer = [fit("3dgs", 40.0, 31.0, scene=f"s{i}") for i in range(6)]
    hindered = [fit("hac", 60.0, 32.0, scene=f"s{i}", fit_reference_seconds=2.0) for i in range(6)]
    foreign = [fit("econgs", 1.0, 39.0, scene=f"s{i}", fit_processor="Q") for i in range(6)]
    slower = [fit("hac", 70.0, 33.0, scene=f"s{i}", fit_reference_seconds=1.4) for i in range(6)]
    race = of(TIME, *quiet, *longer, *hindered, *slower, *foreign)
    assert set(race.fronts) == {"3dgs", "hac"}
    assert race.costs("hac") == [70.0], "no time is corrected"
    by_size = of(SIZE, *({**one, "size_bytes": 1 << 18} for one in quiet), *longer, *hindered)
    assert by_size.leads[-1].expense.seconds is None, "bytes race on; their time is not known"


def test_a_method_without_half_of_the_scenes_does_not_race():
    rows = [fit("3dgs", seconds, 30.0 + seconds, f"s{i}") for seconds in (10.0, 40.0) for i in range(3)]
    rows += [fit("hac", 10.0, 33.0, f"s{i}") for i in range(3)] + [fit("econgs", 10.0, 40.0, "s0")]
    race = of(TIME, *rows)
    assert (set(race.fronts), race.others) == ({"3dgs", "hac"}, ("econgs",))


def test_one_model_each_is_no_race():
    rows = [fit(method, 10.0, 30.0) for method in ("3dgs", "hac")]
    assert races(table(*rows)) == []


@pytest.mark.parametrize(
    ("short", "long", "sentence"),
    [
        (1.0, 1.0, "3DGS leads significantly on d (10 s [one seed], 30 s [one seed])"),
        (1.0, -1.0, "3DGS leads significantly on d (10 s [one seed]); HAC on d (30 s [one seed])"),
        (
            1.0,
            0.0,
            "3DGS leads significantly on d (10 s [one seed]); 1 of 2 limits on 1 dataset are not significant",
        ),
        (0.0, 0.0, "no lead is significant at 2 limits on 1 dataset"),
    ],
)
def test_a_sentence_names_the_significant_leads_of_a_discipline(short, long, sentence):
    """Leads of 3DGS at 10 and at 30 s; none is one that differs from scene to scene."""
    rows = []
    for scene, spread in enumerate((0.5, -0.4, -0.1)):
        for seconds, lead in ((10.0, short), (30.0, long)):
            rows.append(fit("hac", seconds, 30.0 + seconds / 10, f"s{scene}"))
            ahead = lead + 0.01 * scene if lead else spread
            rows.append(fit("3dgs", seconds, 30.0 + seconds / 10 + ahead, f"s{scene}"))
    (found,) = [one for one in conclusion(races(table(*rows)), ALONE) if "training time" in one]
    assert found == f"At equal training time, {sentence} ({ALONE.size})."
    # Among many leads that say nothing, none is significant.
    many = Family.of([lead.p for race in races(table(*rows)) for lead in race.leads] + [0.9] * 10_000)
    (none,) = [one for one in conclusion(races(table(*rows)), many) if "training time" in one]
    assert "no lead is significant at 2 limits" in none


def test_a_sentence_counts_the_methods_within_a_limit_that_not_all_hold():
    rows = [fit("3dgs", seconds, 33.0 + 0.01 * n, f"s{n}") for seconds in (5.0, 20.0) for n in range(3)]
    rows += [fit("hac", seconds, 30.0, f"s{n}") for seconds in (5.0, 20.0) for n in range(3)]
    rows += [fit("econgs", 15.0, 30.0, f"s{n}") for n in range(3)]
    (found,) = [one for one in conclusion(races(table(*rows)), ALONE) if "training time" in one]
    assert "3DGS leads significantly on d (10 s [2 of 3 methods, one seed])" in found


def test_a_lead_has_the_time_and_memory_of_the_leaders_largest_models_within_the_limit():
    """Geometric means over scenes; none where a model has none."""
    mib = 1 << 20
    rows = [
        fit(method, seconds, psnr, scene, size_bytes=int(size * mib), peak_host_bytes=memory * mib)
        for scene, memory in (("a", 100), ("b", 400))
        for method, seconds, psnr, size in (
            ("3dgs", 10.0, 33.0, 0.3), ("3dgs", 40.0, 35.0, 0.8), ("hac", 10.0, 30.0, 0.4),
        )
    ]  # fmt: skip
    leads = of(SIZE, *rows).leads
    assert [(lead.limit, *lead.expense) for lead in leads] == [
        (0.5, pytest.approx(10.0), pytest.approx(200 * mib))
    ]
    unknown = of(SIZE, *({**each, "peak_host_bytes": None} for each in rows))
    assert unknown.leads[0].expense.memory is None
    assert row(unknown, unknown.leads[0], ALONE)[6] == MISSING


def test_bands_reach_over_the_seeds_and_lines_over_all_costs():
    rows = [
        fit(method, seconds, 30.0 + seconds / 40 + seed, seed=seed)
        for method in ("3dgs", "hac")
        for seconds in (10.0, 40.0, 90.0 if method == "hac" else 40.5)
        for seed in (0, 1)
    ]
    found = [race for race in races(table(*rows)) if race.discipline == TIME]
    (panel,) = race_chart(found, models(table(*rows))).panels
    bands = [one for one in panel.series if one.fill]
    lines = [one for one in panel.series if one.line]
    assert len(bands) == len(lines) == 2
    for band, line in zip(bands, lines, strict=True):
        n = len(line.x)
        assert (line.x[0], line.x[-1]) == (10.0, 90.0)
        np.testing.assert_allclose(band.y[:n], np.array(line.y) + 0.5)
        np.testing.assert_allclose(band.y[n:][::-1], np.array(line.y) - 0.5)


def test_a_line_is_of_the_seeds_that_all_methods_have():
    """Or a chart would show a lead of one method by its luckier seeds, which the leads leave out."""
    both = [(10.0, 30.0), (40.0, 32.0)]
    race = of(
        TIME,
        *(fit("hac", seconds, psnr) for seconds, psnr in both),
        *(fit("3dgs", seconds, psnr - 1.0) for seconds, psnr in both),
        *(fit("3dgs", seconds, psnr + 5.0, seed=1) for seconds, psnr in both),
    )
    assert race.leads[0].method == "hac"
    assert race.mean("3dgs", 10.0) == 29.0
    assert race.seeds("3dgs") == [0]


def test_the_report_has_a_section_where_methods_have_several_models(maker):
    for method, factor in (("3dgs", 1.0), ("econgs", 2.0)):
        for variant, share in (("", 1.0), ("iterations=99", 0.25)):
            seconds = 40.0 * share / factor
            maker.run(method=method, variant=variant, psnr=30 + factor + share, seconds=seconds)
    report = maker.report()
    found = section(Page(report.of_defaults, family(report)))  # as the page has it
    assert found.answer[0].startswith("At equal training time")
    assert {"race-train", "race-size"} <= set(found.charts)
    assert [table.caption for table in found.tables] == ["Who leads at which limit"]


def test_a_scene_that_one_method_lacks_leaves_the_others_and_not_the_method():
    rows = [fit(name, seconds, psnr + seconds / 100, scene=scene, seed=seed)
            for name, psnr in (("a", 35.0), ("b", 30.0), ("c", 29.0)) for seconds in (10.0, 40.0)
            for scene in "stuvx" for seed in range(3) if (name, scene) != ("a", "x")]  # fmt: skip
    race = of(TIME, *rows)
    assert (race.leads[0].method, race.methods, set(race.fronts["b"])) == ("a", 3, set("stuv"))


def test_a_method_that_failed_with_a_seed_is_named_and_does_not_race():
    rows = [fit(name, seconds, psnr + seconds / 100 + 0.1 * seed, scene=scene, seed=seed)
            | ({"status": "diverged", "psnr": None} if name == "c" and seed else {})
            for name, psnr in (("a", 31.0), ("b", 30.0), ("c", 33.0)) for seconds in (10.0, 40.0)
            for scene in "st" for seed in range(3)]  # fmt: skip
    race = of(TIME, *rows)
    assert (race.leads[0].method, race.leads[0].starters, race.methods) == ("a", 2, 3)
    text = " ".join(conclusion([race], Family.of([lead.p for lead in race.leads])))
    assert "without c, not finished or measured on all scenes" in text
    assert row(race, race.leads[0], ALONE)[-1] == "2 of 3"
