"""The declared tables: what is derived from them, and the page that documents them."""

import pandas as pd
import pytest

from econgs_bench.reports import reference
from econgs_bench.reports.schema import COLUMNS, TABLES, frame, joined


def test_the_page_of_tables_has_every_table_and_column():
    page = reference.page()
    assert all(f"\n## {name}\n" in page for name in TABLES)
    stored = {column for table in TABLES.values() for column in table.columns}
    assert all(f"\n| `{column}` |" in page for column in stored)


@pytest.mark.parametrize("name", TABLES)
def test_a_table_has_facts_of_its_own_and_axes_of_its_job(name):
    table = TABLES[name]
    assert set(table.axes) <= set(TABLES["jobs"].facts)
    assert set(table.axes).isdisjoint(table.facts)
    assert set(table.columns) <= set(COLUMNS)
    assert table.facts[0] == "job"
    empty = frame(name)
    assert list(empty) == list(table.columns)
    assert [str(kind) for kind in empty.dtypes] == [COLUMNS[column].dtype for column in empty]


def test_rows_are_joined_with_the_axes_of_their_job():
    jobs = frame("jobs", [{"job": "f", "dataset": "d", "seed": 1}, {"job": "g", "dataset": "e"}], stored=True)
    curve = frame("curve", [{"job": "g", "scene": "b"}, {"job": "f", "scene": "a"}], stored=True)
    table = joined({"jobs": jobs, "curve": curve})["curve"]
    assert list(table["dataset"]) == ["e", "d"]
    assert list(table["scene"]) == ["b", "a"]
    assert (pd.isna(table["seed"][0]), table["seed"][1]) == (True, 1)
    assert list(table) == list(TABLES["curve"].columns)


@pytest.mark.parametrize(
    ("name", "value", "text", "header"),
    [
        ("size_bytes", 3 * 2**20, "3.00", "Size [MiB]"),
        ("train_seconds", 0.5, "0.50 s", "Training"),
        ("fps", 12.34, "12.3", "FPS"),
        ("psnr", 30.0, "30.00", "PSNR [dB]"),
        ("knob_value", 0.001, "0.001", "Knob value"),
    ],
)
def test_values_and_headers_for_people(name, value, text, header):
    assert (COLUMNS[name].text(value), COLUMNS[name].header) == (text, header)


def test_titles_of_axes_have_units_where_values_have():
    titles = {name: COLUMNS[name].axis_title for name in ("size_bytes", "fps", "train_seconds")}
    assert titles == {
        "size_bytes": "size per scene [MiB]",
        "fps": "frames per second",
        "train_seconds": "training time per scene [s]",
    }
