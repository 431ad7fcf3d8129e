"""The table of what rendering volumes costs, beside the published figures."""

import csv
from pathlib import Path

import pandas as pd
import pytest

from econgs_bench.reports.sections.paper import datasets
from econgs_bench.reports.sections.paper.datasets import costs, published
from econgs_bench.reports.tables.documents import to_latex, to_markdown
from tests.reports.page.test_page import page

DIMS = "600 \N{MULTIPLICATION SIGN} 360 \N{MULTIPLICATION SIGN} 240"


def test_scenes_are_averaged_and_the_published_row_follows(maker):
    maker.dvr("tangaroa", "a", ms=20.0)
    maker.dvr("tangaroa", "b", ms=40.0, variables="DIV", peak_host_bytes=3 * 2**30)
    maker.dvr("tangaroa", "a+b", ms=900.0, kind="composed", variables="ACC;DIV")
    own, theirs = costs(maker.tables()["dvr"]).to_dict("records")
    assert (own["ms_per_view"], own["fps"], own["cpu_gib"]) == (30.0, 37.5, 3.0)
    assert (own["variables"], own["volume_gib"], own["scenes"]) == (2, 0.5, "2")
    assert theirs["dataset"] == "Tangaroa (published)"
    assert (theirs["cpu_gib"], theirs["gpu_gib"], theirs["scenes"]) == (2.6, 2.1, "8")
    assert theirs["resolution"] == own["resolution"] == DIMS
    assert pd.isna(theirs["fps"])


def test_no_average_where_a_scene_failed(maker):
    maker.dvr("d", "a")
    maker.dvr("d", "b", status="failed", ms_per_view=None)
    maker.dvr("e", "a", status="oom", reason="no memory")
    first, second = costs(maker.tables()["dvr"]).to_dict("records")
    assert (first["scenes"], second["scenes"]) == ("1 of 2", "0 of 1")
    assert pd.isna(first["fps"])


def test_the_page_shows_costs_without_any_method(maker):
    maker.dvr("vortices@32", "cores")
    maker.dvr("tangaroa", "a")
    _, text = page(maker)
    for words in ("Rendering the volumes", "vortices@32", "Tangaroa (published)", DIMS):
        assert words in text
    assert {p.name for p in maker.root.glob("datasets.*")} == {
        "datasets.csv", "datasets.md", "datasets.tex"
    }  # fmt: skip
    table = costs(maker.tables()["dvr"])
    assert f"| Tangaroa (published) | {DIMS} | 4 |" in to_markdown(table)
    assert r"600 $\times$ 360 $\times$ 240 & 4" in to_latex(table)


def test_published_figures_agree_with_themselves():
    """Volumes of one variable are those of float32 samples, as the paper's own arithmetic has it."""
    with (Path(datasets.__file__).parents[1] / "paper" / "published" / "datasets.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 9
    for row in rows:
        if row["volume_gib"] and row["published"] != "beetle":
            samples = int(row["nx"]) * int(row["ny"]) * int(row["nz"])
            assert float(row["volume_gib"]) == pytest.approx(samples * 4 / 2**30, abs=0.05)
    assert sum(int(row["scenes"]) for row in rows) == 2 + 9 + 4 + 4 + 1 + 4 + 41 + 24 + 8
    assert published()["tangaroa"]["published"] == "Tangaroa"
    stand_ins = {
        "argon_bubble_like", "supernova_like", "beetle_like", "vortices", "jet_flame", "ionisation_like",
        "ship_wake",
    }  # fmt: skip
    assert stand_ins <= published().keys()
