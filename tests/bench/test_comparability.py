"""No consumer compares what differs in silence: differences are planted, and each consumer is asked.

All plants are asked for the reason in words, which :mod:`.reports.comparability` gives. Consumers that only
print it are asked with one plant of each kind of remark.
"""

from __future__ import annotations

import contextlib
import os
import re
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pandas as pd
import pytest

from econgs_bench.bench.__main__ import main
from econgs_bench.bench.api import Runs
from econgs_bench.bench.commands.results import print_answers
from econgs_bench.bench.results.bundle import write_bundle
from econgs_bench.bench.results.tables import _rivals_together, build_tables, derived
from econgs_bench.bench.store.lineage import Lineage
from econgs_bench.bench.store.store import Store
from econgs_bench.methods.registry import Registry
from econgs_bench.reports.charts import files, svg
from econgs_bench.reports.comparability import compared, kind_of, sentences, set_apart
from econgs_bench.reports.page.document import write_report
from econgs_bench.reports.report import Report
from econgs_bench.reports.schema import frame, records
from econgs_bench.reports.sections.answers.conclusion import CRITERIA
from econgs_bench.reports.sections.answers.contest import of_report as contest_of
from econgs_bench.reports.sections.order import charts
from econgs_bench.reports.sections.paper.documents import to_text
from econgs_bench.reports.sections.paper.tables import paper_tables
from econgs_bench.reports.sections.races.conclusion import of_report as races_of
from econgs_bench.reports.sections.rates.conclusion import of_report as rates_of
from econgs_bench.reports.style import label
from econgs_bench.reports.tables.protocols import by_protocol

from .planted_store import METHODS, SCENES, VIEWS, Facts, Plant, every, write

OURS, THEIRS = METHODS[1], METHODS[0]
ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Planted:
    """A difference between the rows of two methods.

    Attributes:
        plant: makes it in the rows of one method.
        words: pattern of the reason that consumers give.
        pictures, times: whether pictures, and times, of both methods are still compared.
        told: whether it stands for all plants of its kind of remark with consumers that print remarks.
    """

    plant: Plant
    words: str
    pictures: bool = False
    times: bool = False
    told: bool = False


def of(**changes: object) -> Plant:
    return lambda facts: replace(facts, **changes)  # type: ignore[arg-type]


def where(condition: Callable[[Facts], bool], **changes: object) -> Plant:
    return lambda facts: replace(facts, **changes) if condition(facts) else facts  # type: ignore[arg-type]


PLANTS = {
    "truth": Planted(of(content="c1"), "another content", told=True),
    "definition of a scene": Planted(
        where(lambda f: f.scene == "TF02", content="c1"), "another content: TF02", pictures=True, times=True
    ),
    "split": Planted(of(split="val"), "across splits", told=True),
    "number of views": Planted(of(test_views=4, views=(0, 1, 2, 3)), "4 test views"),
    "one view less": Planted(of(views=tuple(range(VIEWS - 1))), f"{VIEWS - 1} test views"),
    "other views": Planted(of(test_views=7, views=tuple(range(1, 7))), "another truth", told=True),
    "resolution": Planted(of(size=100), "100 .{1,9} 100"),
    "samples": Planted(of(samples=1), "one ray a pixel"),
    "metric version": Planted(
        of(metrics={"psnr": "2", "ssim": "1"}), "another metric: version", times=True, told=True
    ),
    "ruler": Planted(of(ruler=1), "another ruler", pictures=True),
    "processor": Planted(of(cpu="Xeon"), "elsewhere: .*Xeon", pictures=True, told=True),
    "threads": Planted(of(threads=2), "other threads: timed with", pictures=True),
    "device": Planted(of(device="cuda"), "fitted on cuda"),
    "busy machine": Planted(of(kernel=0.09), "disturbed", pictures=True),
    "uneven frames": Planted(of(spread=3.0), "disturbed", pictures=True, told=True),
    "set of seeds": Planted(where(lambda f: f.seed == 1, made=False), "seeds differ", True, True, True),
    "set of scenes": Planted(
        where(lambda f: f.scene == "TF04", made=False), "scenes differ", True, True, True
    ),
    "method version": Planted(where(lambda f: f.seed == 1, version="0"), "another version", True, True, True),
    "stale option": Planted(
        where(lambda f: f.seed == 1, options={"sh_degree": 7}), "another version: sh_degree", True, True
    ),
    "renderer that disagrees": Planted(of(renderer="reference 1", shade=0.52), "pictures of reference 1"),
    "truth unknown": Planted(of(known=False), "truth unknown"),
}
FEW: dict[str, Any] = {"rates": (None, 1.0), "lengths": (None,)}
"""Rows that stores hold: they are compared one by one."""
of_each_kind = pytest.mark.parametrize(
    "planted", [name for name, case in PLANTS.items() if case.told], indirect=True
)


@pytest.fixture(scope="module", autouse=True)
def _quick() -> Iterator[None]:
    """Stores that no power cut must outlive."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        yield


@pytest.fixture(scope="module")
def clean(tmp_path_factory) -> Store:
    return write(tmp_path_factory.mktemp("clean") / "s", every(lambda facts: facts, **FEW))


@pytest.fixture(scope="module", params=PLANTS)
def planted(request, tmp_path_factory) -> tuple[Planted, Store, Report]:
    """A plant, a store of few rows with it, and the report of all rows with it."""
    case = PLANTS[request.param]
    store = write(tmp_path_factory.mktemp("planted") / "s", every(case.plant, **FEW))
    return case, store, Report(derived(Lineage(every(case.plant)), Registry().specs))


def test_a_clean_store_has_no_remark_and_compares_all(tmp_path) -> None:
    store = write(tmp_path / "s", every(lambda facts: facts))
    report = Report(build_tables(store, Registry().specs, write=False))
    assert report.remarks == []
    assert report.tables["differences"].empty
    (contest,) = contest_of(report)
    for each in CRITERIA:
        cells = contest.values(each.column).cells
        assert not cells or set(cells[OURS]["vortex_views"]) == set(SCENES)
    assert {len(race.fronts) for race in races_of(report)} == {2}
    (difference,) = rates_of(report)
    assert difference.rate is not None
    assert difference.rate_interval is not None


def test_renderers_that_agree_are_one_truth() -> None:
    records = every(of(renderer="reference 1", shade=0.5 + 2e-4))
    report = Report(derived(Lineage(records), Registry().specs))
    assert report.results["truth"].nunique() == len(SCENES)
    assert report.remarks == []


def test_a_remark_has_the_reason(planted) -> None:
    case, _, report = planted
    assert any(_has(case, remark.text) for remark in report.remarks)


def test_conclusions_leave_it_out(planted) -> None:
    """Contest, races, curves, means: pictures and times are compared where their own rule allows it."""
    case, _, report = planted
    pictures = [_compared(contest.values("psnr").cells) for contest in contest_of(report)]
    times = [_compared(contest.values("fps").cells) for contest in contest_of(report)]
    assert any(pictures) == case.pictures
    assert any(times) == case.times
    races = {len(race.fronts) for race in races_of(report) if race.discipline.column == "size_bytes"}
    assert (2 in races) == case.pictures
    rates = [one for one in rates_of(report) if one.rate is not None or one.psnr is not None]
    assert bool(rates) == case.pictures


def _compared(cells) -> bool:
    """Whether values of both methods on one dataset stand side by side."""
    sides = [set(cells.get(method, {})) for method in METHODS]
    return bool(sides[0] & sides[1])


def test_no_mean_is_of_several_truths_or_versions(planted) -> None:
    _, _, report = planted
    rows = report.results[report.results["status"] == "ok"]
    for _, own in rows.groupby(["dataset", "preset", "split", "scene"], dropna=False):
        assert own["truth"].nunique() <= 1
    for _, own in rows.groupby(["dataset", "preset", "split", "method", "variant"], dropna=False):
        assert own["method_version"].nunique() == 1
        assert own["changes"].nunique() == 1
    timed = rows[rows["fps"].notna()]
    for _, own in timed.groupby(["dataset", "preset", "split"], dropna=False):
        for column in ("processor", "threads", "device", "ruler"):
            assert own[column].nunique() == 1, column


def test_rows_of_one_truth_follow_each_other(planted) -> None:
    _, _, report = planted
    datasets = report.tables["results"]["dataset"].tolist()
    assert len(list(groupby(datasets))) == len(set(datasets))


def test_a_ladder_is_climbed_on_one_truth() -> None:
    """Rungs of another content, or of a model of another version, are no seeds of the same climb."""
    before = pd.Series(["own", "own", "own", "own"])
    jobs = pd.DataFrame({"job": list("abcd"), "dataset": ["own", "own [52b3]", "own", "own [52b3]"]})
    climbed = pd.DataFrame(
        {"job": list("abcd"), "ladder": ["far", "far", "far", "far"], "subject": "own/blob"}
    )
    scenes = pd.DataFrame({"job": list("bc"), "ladder": "scenes", "subject": ["", ""]})
    rungs = pd.concat([climbed, scenes], ignore_index=True)
    tables = _rivals_together({"jobs": jobs, "rungs": rungs, "results": jobs[["job"]]}, before)
    assert tables["results"]["job"].tolist() == list("acbd")
    assert tables["rungs"][["job", "ladder", "subject"]].values.tolist() == [
        ["a", "far", "own/blob"], ["c", "far", "own/blob"],
        ["b", "far", "own [52b3]/blob"], ["d", "far", "own [52b3]/blob"],
        ["c", "scenes", ""], ["b", "scenes", "[52b3]"],
    ]  # fmt: skip
    left = frame("results", [{"job": "c", "differences": '{"row": "another version: 0"}'}, {"job": "a"}])
    assert compared({"results": left, "rungs": rungs})["rungs"]["job"].tolist() == list("abdb")


def test_charts_of_times_are_without_what_is_left_out(planted) -> None:
    """The tables `timing` and `curve` lack the rows whose clocks are not compared, and no others."""
    _, _, report = planted
    every = by_protocol(report.stored)
    rows = records(report.measured)
    slow = {row["job"] for row in rows if kind_of(row, "fps")}
    timed = every["timing"]
    assert set(report.tables["timing"]["job"]) == set(timed["job"]) - slow
    late = {_fit(row) for row in rows if kind_of(row, "train_seconds")}
    assert {*map(_fit, records(report.tables["curve"]))} == {*map(_fit, records(every["curve"]))} - late


def _fit(row) -> tuple:
    return tuple(str(row[name]) for name in ("dataset", "method", "variant", "seed", "scene"))


def test_no_row_is_lost(planted) -> None:
    case, _, report = planted
    measured = [record.job.id for record in every(case.plant) if record.job.kind == "measure"]
    assert sorted(report.measured["job"]) == sorted(measured)


@of_each_kind
def test_the_page_and_its_files_give_the_reason(planted, tmp_path, monkeypatch) -> None:
    case, store, report = planted
    monkeypatch.setattr(files, "output", lambda folder: contextlib.nullcontext(Mock()))
    page = write_report(report.stored, store.root, tmp_path / "r.html", report=report)
    names = ["r.html", "results.md", "results.tex"]
    if not report.tables["differences"].empty:
        names.append("differences.csv")
    for name in names:
        assert _has(case, (page.parent / name).read_text(encoding="utf-8")), name


@of_each_kind
def test_the_terminal_and_python_give_the_reason(planted, capsys) -> None:
    case, store, report = planted
    print_answers(report)
    assert _has(case, capsys.readouterr().out)
    assert any(_has(case, text) for text in Runs(store.root).remarks)


@of_each_kind
def test_charts_give_the_reason(planted) -> None:
    """Every chart that would have compared what differs."""
    case, _, report = planted
    drawn = dict(charts(report))
    names = [name for name in ("psnr-size", "psnr-fps") if name in drawn]
    assert names
    texts = [svg.file(drawn[name]) for name in names]
    assert any(_has(case, re.sub(r"\s+", " ", re.sub("<[^>]*>", " ", text))) for text in texts)


@of_each_kind
def test_the_papers_tables_give_the_reason(planted) -> None:
    case, _, report = planted
    papers = [one for one in paper_tables(report.stored, report.views) if one.name == "univariate"]
    apart = sentences(one for one in report.remarks if one.quantity == "dataset")
    blocks = [block for paper in papers for block in paper.blocks]
    if all(len([row for row in block.rows if row.jobs]) < 2 for block in blocks):
        return  # the rows are in no table together
    assert _has(case, " ".join([*map(to_text, papers), *apart]))


def test_two_stores_are_compared_only_where_they_may_be(planted, clean, capsys) -> None:
    case, store, _ = planted
    code = main(["compare", str(clean.root), str(store.root), "--format", "csv"])
    out, err = capsys.readouterr()
    ours = [line for line in out.splitlines() if f",{OURS}," in line and ",psnr," in line]
    if case.pictures:
        assert code == 0
        assert ours
    elif f"{VIEWS - 1} test" not in case.words:  # views are paired one by one
        assert not ours
        assert err.strip(), "the reason"


@pytest.fixture(scope="module")
def baseline(clean, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("baseline") / "baseline.json"
    assert main(["baseline", str(clean.root), "--out", str(path), "--reason", "first"]) == 0
    return path


def test_the_gate_gives_the_reason(planted, baseline, capsys) -> None:
    case, store, _ = planted
    capsys.readouterr()
    code = main(["gate", str(store.root), "--baseline", str(baseline)])
    out = capsys.readouterr().out
    # What is the same but for chance is a note, and seeds that lack are no difference of results.
    assert code in (1, 2) or case.times, out
    assert code or label(OURS) in out or case.words.startswith("seeds")
    assert not code or label(OURS) in out


@of_each_kind
def test_the_documentation_gives_the_reason(planted, generate, tmp_path, monkeypatch) -> None:
    case, store, _ = planted
    write_bundle(store, tmp_path / "planted.zip.xz")
    monkeypatch.setattr(generate, "MEASURED", tmp_path)
    generate.tables.cache_clear()
    block = 'bundles = ["planted"]\nrows = ["dataset", "method"]\ncolumns = ["psnr", "fps", "mib"]\n'
    block += "where = \"kind == 'basic' and rate.isna() and variant == ''\"\n"
    try:
        text = generate.table(tomllib.loads(block))
    except SystemExit as refusal:
        text = str(refusal)
    kind = case.words.partition(":")[0]  # a line counts rows by the kind of the reason
    assert _has(case, text) or kind in text or "means over different scenes" in text


def _has(case: Planted, text: str) -> bool:
    return re.search(case.words, text.replace("\\", "")) is not None


def test_other_pictures_of_several_scenes_are_one_dataset() -> None:
    """A store whose truths all differ is told apart as one, not scene by scene."""
    rows = [{"job": f"{method}{scene}", "dataset": "d", "preset": "quick", "split": "test", "method": method,
             "requested_views": 42, "scene": scene, "kind": "basic", "test_views": 16, "stress": "",
             "finished": f"2026-01-0{day}", "truth": f"{truth}{scene}-16", "renderer": "r"}
            for day, (method, truth) in enumerate((("a", "x"), ("b", "x"), ("c", "y"), ("e", "z")), 1)
            for scene in ("s0", "s1", "s2")]  # fmt: skip
    apart = set_apart(frame("jobs", rows))
    names = {method: set(own["dataset"]) for method, own in apart.groupby("method")}
    assert names["a"] == names["b"] == {"d"}
    assert [len(names[method]) for method in "ce"] == [1, 1]
    assert len(set().union(*names.values())) == 3
