"""The noise floor of the truth: what is known of it, its means, and when a comparison is at it."""

import pandas as pd
import pytest

from econgs_bench.reports.comparability import fixed_rays
from econgs_bench.reports.floors import NEAR, Floor, by_scene, closeness, mean, of_table
from econgs_bench.reports.schema import records
from econgs_bench.reports.tables.columns import numbers
from econgs_bench.reports.tables.documents import to_csv, to_markdown
from econgs_bench.reports.tables.means import summary
from econgs_bench.reports.tables.results import display, for_terminal, notes


def test_of_a_scene_what_any_row_knows_counts():
    rows = [
        {"scene": "a", "floor": pd.NA, "one_ray": pd.NA},
        {"scene": "a", "floor": 54.0, "one_ray": 31.0},
        {"scene": "b", "floor": 50.0, "one_ray": float("nan")},
        {"scene": "c"},
    ]
    assert by_scene(rows) == {"a": Floor(54.0, 31.0), "b": Floor(50.0, None), "c": None}


def test_a_mean_is_over_the_scenes_and_there_is_none_where_one_lacks():
    assert mean([Floor(50.0, 30.0), Floor(54.0, 32.0)]) == Floor(52.0, 31.0)
    assert mean([Floor(50.0, 30.0), Floor(54.0, None)]) == Floor(52.0, None)
    assert mean([Floor(50.0, 30.0), None]) is None
    assert mean([]) is None
    table = pd.DataFrame({"scene": ["a", "a", "b"], "floor": [50.0, 50.0, 56.0]})
    assert of_table(table) == Floor(53.0, None), "scenes count once, whatever their rows"
    assert of_table(table[["scene"]]) is None


def test_a_comparison_is_at_the_floor_within_three_decibels():
    floor = Floor(40.0, 30.0)
    assert closeness([(floor, 40.0 - NEAR)]) == ""
    assert closeness([(None, 90.0), (floor, 36.0)]) == ""
    words = closeness([(floor, 40.01 - NEAR), (floor, 45.0), (floor, 20.0), (None, 99.0)])
    assert "2 of 4 scenes" in words
    assert f"{NEAR:g} dB" in words


def row(dataset, samples):
    return {"dataset": dataset, "samples": samples}


@pytest.mark.parametrize(
    ("rows", "text"),
    [
        ([("a", 1), ("b", 1)], "one ray a pixel"),
        ([("a", 16), ("a", None)], "16 rays a pixel"),
        ([("a", 1), ("b", None), ("c", 1)], "one ray a pixel where rendered here"),
        ([("a", None)], ""),
        ([("a", 0), ("b", None)], ""),
        ([("a", 1), ("b", 0), ("c", 1), ("d", None)], "one ray a pixel (a, c)"),
        ([("a", 1), ("b", 16)], "one ray a pixel (a); 16 rays a pixel (b)"),
        ([("a, one ray a pixel", 1), ("a, rays as needed", 0)], ""),
        ([], ""),
    ],
)
def test_captions_name_a_fixed_number_of_rays(rows, text):
    assert fixed_rays(row(*each) for each in rows) == text
    if rows:
        table = pd.DataFrame([row(*each) for each in rows]).astype({"samples": "Int64"})
        assert fixed_rays(records(table)) == text


def test_the_floor_stands_beside_psnr_where_a_row_has_one(maker):
    maker.run("rendered", "a", floor=54.1, one_ray=30.8, samples=0, views=0)
    maker.run("elsewhere", "b", views=0)
    results = maker.tables()["results"]
    names = list(display(results))
    assert names[names.index("psnr") + 1] == "floor"
    assert numbers(results)[:2] == ["psnr", "floor"]
    _, fields = for_terminal(results, 200)
    (floors,) = (field.cells for field in fields if field.header == "Floor [dB]")
    assert floors == ["54.10", "\N{EN DASH}"]
    assert "| 54.10 |" in to_markdown(results)
    head, line, _ = to_csv(results).splitlines()
    assert "54.1" in line.split(",")[head.split(",").index("floor")]
    assert "Floor [dB]" not in [field.header for field in for_terminal(results, 40)[1]]
    assert "floor" not in display(results[1:])


def test_the_floor_of_a_mean_is_over_its_scenes(maker):
    for seed in (0, 1):
        for scene, floor in (("a", 50.0), ("b", 56.0)):
            maker.run("d", scene, seed=seed, floor=floor, one_ray=floor - 20.0, views=0)
        maker.run("e", "a", seed=seed, floor=50.0, views=0)
        maker.run("e", "b", seed=seed, views=0)
    means = summary(maker.tables()["results"]).set_index("dataset")
    assert (means.loc["d", "floor"], means.loc["d", "one_ray"]) == (53.0, 33.0)
    assert pd.isna(means.loc["e", "floor"])


def test_tables_of_results_say_how_many_rays_the_truth_has(maker):
    maker.run("d", "a", samples=1, reason=None, views=0)
    (note,) = notes(maker.tables()["results"])
    assert "one ray a pixel" in note
    maker.run("d", "b", samples=0, reason=None, views=0)
    assert notes(maker.tables()["results"][1:]) == []
