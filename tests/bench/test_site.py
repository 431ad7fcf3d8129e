"""A site of bundles: pages for what they hold, a history that grows, nothing from what does not hold."""

from __future__ import annotations

import json
import re
import zipfile

import pandas as pd
import pytest

from econgs_bench.bench.__main__ import main
from econgs_bench.reports.site import HISTORY, Submission, with_division


@pytest.fixture
def bundle(finished, tmp_path):
    """A bundle of one result."""
    path = tmp_path / "mine.zip"
    assert main(["bundle", "--runs", str(finished.store), "--out", str(path)]) == 0
    return path


def _site(bundle, out, *more) -> int:
    from .conftest import PLUGINS

    return main(["site", str(bundle), "--plugins", str(PLUGINS), "--out", str(out), *map(str, more)])


def test_every_page_that_the_index_names_is_there_with_its_data(bundle, tmp_path) -> None:
    out = tmp_path / "site"
    assert _site(bundle, out, "--title", "Mine <b>") == 0
    index = (out / "index.html").read_text(encoding="utf-8")
    assert "<h1>Mine &lt;b&gt;</h1>" in index
    links = re.findall(r'href="([^"#]+)"', index)
    assert {link.partition("/")[0] for link in links} == {"datasets", "methods", "submissions"}
    for link in links:
        assert (out / link).is_file(), link
    rows = json.loads(next(out.glob("datasets/*/results.json")).read_text(encoding="utf-8"))
    assert [row["division"] for row in rows] == ["closed"]
    assert "fake" in index


@pytest.mark.slow
def test_the_history_only_grows(bundle, finished, tmp_path) -> None:
    out = tmp_path / "site"
    assert _site(bundle, out) == 0
    first = json.loads((out / HISTORY).read_text(encoding="utf-8"))
    assert _site(bundle, out) == 0
    assert json.loads((out / HISTORY).read_text(encoding="utf-8")) == first
    finished.run("--seed", "1")
    assert main(["bundle", "--runs", str(finished.store), "--out", str(bundle)]) == 0
    assert _site(bundle, out) == 0
    both = json.loads((out / HISTORY).read_text(encoding="utf-8"))
    assert both[:1] == first
    assert [one["seeds"] for one in both] == [[0], [0, 1]]
    index = (out / "index.html").read_text(encoding="utf-8")
    assert index.count("replaced by a later one") == 1
    assert all((out / one["place"] / "index.html").is_file() for one in both)


def test_a_forged_bundle_stops_it_before_anything_is_written(bundle, tmp_path, capsys) -> None:
    forged = tmp_path / "forged.zip"
    with zipfile.ZipFile(bundle) as old, zipfile.ZipFile(forged, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            new.writestr(
                name,
                content.replace(b'"psnr":', b'"psnr": 9') if name.startswith("jobs/measure") else content,
            )
    assert _site(forged, tmp_path / "site") == 2
    assert f"{forged}: does not hold" in capsys.readouterr().err
    assert not (tmp_path / "site").exists()


@pytest.mark.parametrize(
    ("change", "division"),
    [
        ({}, "closed"),
        ({"options": '{"configuration": "paper"}'}, "closed"),
        ({"options": '{"samples": 16}'}, "closed"),
        ({"options": '{"iterations": 300}'}, "open"),
        ({"options": '{"low_pass": 0.1}'}, "open"),
        ({"requested_views": 6}, "open"),
        ({"split": "val"}, "open"),
        ({"preset": "small"}, "open"),
    ],
)
def test_divisions(change, division) -> None:
    row = {"options": "{}", "preset": "quick", "split": "test", "requested_views": 42}
    table = with_division(pd.DataFrame([{**row, **change}]), {"quick": 42})
    assert table["division"].tolist() == [division]


def test_names_of_submissions_are_folders_below_the_site() -> None:
    one = Submission("../../x y", "ab" * 32, "", 1, 0, "", "", (), (), (), (), ())
    assert one.place == "submissions/x-y-abababab"
