"""Tables in the paper's layout, and its claims held against them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from reports.claims import FAILS, HOLDS, UNKNOWN, check, claims
from reports.claims import to_text as claims_text
from reports.paper_documents import to_html, to_latex, to_markdown, to_text
from reports.paper_tables import (
    QUANTITIES,
    Block,
    PaperTable,
    Row,
    Value,
    layouts,
    paper_tables,
    reference_rows,
)
from tests.reports.conftest import RESULTS, frame

SCENES = ("TF01", "TF02", "TF03", "TF04")


def row(method="econgs", scene="TF01", psnr=36.0, **changed):
    said = {
        "dataset": "vortex_views", "scene": scene, "kind": "basic", "method": method, "variant": "",
        "preset": "paper", "split": "test", "seed": 0, "status": "ok", "psnr": psnr, "fps": 100.0,
        "size_bytes": 2**19, "train_seconds": 120.0, "primitives": 1000, "group": "g", "train_views": 92,
        "width": 200, "height": 200, "job": f"{method}-{scene}",
    }  # fmt: skip
    return said | changed


def results(*rows):
    return frame(RESULTS, list(rows))


def four(method, psnr, **changed):
    return [row(method, scene, psnr + i, **changed) for i, scene in enumerate(SCENES)]


def table(tables, name):
    return next(one for one in tables if one.name == name)


def line(block, label):
    return next(one for one in block.rows if one.label == label)


def test_measured_values_stand_beside_the_published_ones_in_their_units():
    found = paper_tables(results(*four("econgs", 35.0), *four("3dgs", 34.0, fps=300.0)))
    block = table(found, "univariate").blocks[0]
    assert (block.dataset, block.published, block.same) == ("vortex_views", "vortex", True)
    ours = line(block, "ECoNGS").values
    assert ours["psnr"].mean == pytest.approx(36.5)
    assert ours["psnr"].published == 36.74
    assert ours["train_seconds"].mean == pytest.approx(8.0)  # minutes of all scenes together
    assert ours["train_seconds"].published == 9.32
    assert ours["size_bytes"].mean == pytest.approx(2.0)  # MiB, sum
    assert line(block, "HAC").values["psnr"].mean is None
    assert line(block, "HAC").values["psnr"].published == 26.74
    text = to_text(table(found, "univariate"))
    assert "36.74 (-0.24)" in text
    assert "second line: published for vortex (difference)" in text


def test_seeds_give_a_spread_and_an_incomplete_seed_is_named():
    rows = [*four("econgs", 35.0), *four("econgs", 36.0, seed=1), *four("econgs", 50.0, seed=2)[:3]]
    block = table(paper_tables(results(*rows)), "univariate").blocks[0]
    ours = line(block, "ECoNGS")
    assert ours.values["psnr"].mean == pytest.approx(37.0)
    assert ours.values["psnr"].spread == pytest.approx(0.5**0.5)
    assert ours.note == "seed 2: TF04 missing or failed"
    assert "37.00 ± 0.71" in to_markdown(table(paper_tables(results(*rows)), "univariate"))


def test_a_failed_scene_leaves_the_cells_empty():
    rows = [*four("econgs", 35.0)[:3], row(scene="TF04", psnr=None, status="failed"), *four("3dgs", 30.0)]
    block = table(paper_tables(results(*rows)), "univariate").blocks[0]
    assert line(block, "ECoNGS").values["psnr"].mean is None
    assert line(block, "3DGS").values["psnr"].mean is not None


def test_other_data_than_the_papers_are_compared_with_no_published_difference():
    rows = [row(dataset="jet_flame", scene=f"mf_{i}") for i in range(9)]
    rows += [row(dataset="jet_flame", scene=f"mf_{i}", variant="joint=false", psnr=37.0) for i in range(9)]
    found = paper_tables(results(*rows))
    block = table(found, "joint-gain").blocks[0]
    assert (block.published, block.same) == ("combustion (MF)", False)
    assert "98,174 (" not in to_text(table(found, "joint-gain"))
    assert "98,174" in to_text(table(found, "joint-gain"))
    assert "design" in {one.name for one in found}, "unknown data: beside the paper's only dataset"
    # A part of a dataset is not the dataset.
    assert not [one for one in paper_tables(results(*rows[:5])) if one.name == "univariate"]


def test_one_row_without_published_values_is_no_table():
    assert paper_tables(results(row(dataset="nucleon"))) == []
    assert paper_tables(results()) == []


def test_tables_of_other_questions_are_not_filled_with_what_happens_to_fit():
    rows = [one for m in ("econgs", "ivr-gs") for one in four(m, 35.0)]
    assert not {"multivariate", "limited-views"} & {one.name for one in paper_tables(results(*rows))}
    fewer = [one for m in ("econgs", "ivr-gs") for one in four(m, 30.0, train_views=12, requested_views=12)]
    found = paper_tables(results(*rows, *fewer))
    assert "limited-views" in {one.name for one in found}
    ours = [one | {"dataset": "cth_impact", "scene": one["scene"]} for one in rows]
    assert "multivariate" in {one.name for one in paper_tables(results(*ours))}


def test_quality_is_not_ranked_where_views_cannot_tell():
    rows = results(*four("econgs", 35.0), *four("3dgs", 34.9), *four("ivr-gs", 30.0))

    def seen(spread):
        noise = np.random.default_rng(0)
        views = [
            {"job": job, "scene": scene, "view": f"v{i}", "psnr": psnr + spread * noise.normal()}
            for job, scene, psnr in rows[["job", "scene", "psnr"]].itertuples(index=False)
            for i in range(40)
        ]
        return pd.DataFrame(views)

    for spread, mark in ((0.0, 1), (3.0, 3)):
        block = table(paper_tables(rows, seen(spread)), "univariate").blocks[0]
        labels = [one.label for one in block.rows]
        assert block.marks[labels.index("ECoNGS"), "psnr"] == mark
    assert "\N{ALMOST EQUAL TO}" in to_text(table(paper_tables(rows, seen(3.0)), "univariate"))


def test_times_of_a_frame_come_from_their_own_table():
    rows = results(*four("econgs", 35.0), *four("3dgs", 34.0))
    timing = pd.DataFrame(
        [
            {"job": job, "part": part, "seconds": seconds * (2.0 if job.startswith("3dgs") else 1.0)}
            for job in rows["job"]
            for part, seconds in (("frame", 0.004), ("decode", 0.001), ("rasterise", 0.003))
        ]
    )
    assert not [one for one in paper_tables(rows) if one.name == "timing"]
    block = table(paper_tables(rows, None, timing), "timing").blocks[0]
    ours, theirs = line(block, "ECoNGS").values, line(block, "3DGS").values
    assert (ours["rasterise_ms"].mean, ours["rasterise_ms"].published) == (pytest.approx(3.0), 0.69)
    assert theirs["frame_ms"].mean == pytest.approx(8.0)


def test_documents_hold_every_row_and_escape_what_they_must():
    tables = paper_tables(
        results(*four("econgs", 35.0), *four("econgs", 34.0, variant="view_direction=false"))
    )
    design = table(tables, "design")
    for write in (to_markdown, to_html, to_latex, to_text):
        text = write(design)
        for label in ("full ECoNGS", "w/o view direction", "w/o joint learning"):
            assert label in text
    latex = to_latex(design)
    assert latex.count(r"\begin{tabular}") == latex.count(r"\end{tabular}") == 1
    assert "vortex\\_views" in latex
    assert {
        text.count("&") for text in latex.splitlines() if text.endswith(r"\\") and "multicolumn" not in text
    } == {6}
    assert r"\textbf{36.50}" in latex


def published(name):
    """A table as if the paper's own values had been measured."""
    said = layouts()["tables"][name]
    blocks = []
    for dataset in dict.fromkeys(one["dataset"] for one in reference_rows(name)):
        rows = []
        for one in said["rows"]:
            match = one.get("match")
            found = [
                r for r in reference_rows(name)
                if match is not None and r["dataset"] == dataset and all(r[k] == v for k, v in match.items())
            ]  # fmt: skip
            assert len(found) <= 1, "a row of the layout names one published row"
            cells = {}
            for column in said["columns"]:
                text = found[0].get(QUANTITIES[column].published, "") if found else ""
                cells[column] = Value(float(text) if text else None)
            rows.append(Row(one["label"], cells))
        blocks.append(Block(dataset, dataset, True, "", rows, {}))
    return PaperTable(name, said["title"], said["head"], said["columns"], blocks)


def test_every_layout_row_with_a_published_one_finds_it():
    for name, said in layouts()["tables"].items():
        for one in said["rows"]:
            match = one.get("match")
            assert not match or any(all(r[k] == v for k, v in match.items()) for r in reference_rows(name)), (
                one
            )


def test_the_papers_own_numbers_bear_out_its_claims_but_for_those_it_contradicts():
    verdicts = check([published(name) for name in layouts()["tables"]])
    failed = {one.claim for one in verdicts if one.verdict == FAILS}
    # Both are contradictions within the paper: joint learning costs PSNR, and iVR-GS is ahead at 12 views.
    assert failed == {"joint-accuracy", "views-robust-12"}
    held = {one.claim for one in verdicts if one.verdict == HOLDS}
    unknown = {one.claim for one in verdicts if one.verdict == UNKNOWN}
    assert held | failed | unknown == {one["id"] for one in claims()}
    assert {one["id"] for one in claims() if "table" not in one} <= unknown
    assert unknown <= {one["id"] for one in claims() if "table" not in one} | {"init-all"}


def test_a_claim_is_held_against_what_was_measured():
    rows = [*four("econgs", 35.0, size_bytes=10), *four("3dgs", 30.0, size_bytes=1000)]
    verdicts = {one.claim: one for one in check(paper_tables(results(*rows)))}
    assert verdicts["vortex-3dgs-psnr"].verdict == HOLDS
    assert verdicts["vortex-3dgs-psnr"].measured == pytest.approx(5.0)
    assert verdicts["vortex-3dgs-size"].measured == pytest.approx(100.0)
    assert verdicts["vortex-fps"].verdict == FAILS
    assert verdicts["uni-ivrgs-psnr"].verdict == UNKNOWN
    text = claims_text(list(verdicts.values()))
    assert "holds" in text
    assert text.rstrip().endswith("not measured")
