"""The interface from Python, on models of the method fake."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import econgs_bench as api
from econgs_bench.datasets.errors import UnknownName
from tests.bench.conftest import PLUGINS, Bench


@pytest.fixture
def runs(finished: Bench) -> api.Runs:
    return api.Runs(finished.store, plugins=[PLUGINS])


def test_the_package_starts_without_what_it_does_not_need() -> None:
    script = (
        "import sys, econgs_bench as bench; assert not {'numpy', 'torch', 'pandas'} & set(sys.modules); "
        "assert set(bench.__all__) == set(dir(bench)); "
        "from econgs_bench.bench import api; assert set(api.__all__) == set(bench.__all__); bench.Runs; "
        "assert not {'torch', 'pandas'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
    with pytest.raises(AttributeError, match="nothing"):
        api.nothing  # noqa: B018


def test_a_run_from_python_is_that_of_the_command(finished: Bench, monkeypatch, capsys) -> None:
    for name in ("BENCH_CACHE", "BENCH_LOCKS"):
        monkeypatch.setenv(name, finished.environment[name])
    before = {path: path.stat().st_mtime_ns for path in (finished.store / "jobs").rglob("*")}
    arguments = {"datasets": [finished.dataset], "methods": ["fake"], "plugins": [PLUGINS], "quiet": True}
    runs = api.run("quick", scenes=["a"], out=finished.store, **arguments)
    assert {path: path.stat().st_mtime_ns for path in (finished.store / "jobs").rglob("*")} == before
    runs = api.run("quick", scenes=["b"], out=finished.store, **arguments)
    assert list(runs.results["scene"]) == ["a", "b"]
    assert capsys.readouterr().err == ""
    with pytest.raises(UnknownName, match="fakes"):
        api.run("quick", out=finished.store, **(arguments | {"methods": ["fakes"]}))


def test_a_saved_model_renders_what_was_measured(runs: api.Runs, finished: Bench) -> None:
    row = runs.results.iloc[0]
    model = runs.model(row["job"])
    assert (model.method, model.scenes, model.size_bytes) == ("fake", ("a",), row["size_bytes"])
    dataset = api.open_dataset(finished.dataset)
    truth = api.render_views(dataset, "a", count=4, size=(8, 8))
    scores = api.score_views(truth, model.render_views(truth))
    assert scores["psnr"].mean() == pytest.approx(row["psnr"], abs=1e-4)
    assert list(scores.index) == [camera.name for camera in truth.cameras]
    picture = model.render(truth.cameras[0])
    assert picture.shape == (8, 8, 3)
    assert picture.dtype == np.float32
    with pytest.raises(UnknownName, match="scene"):
        model.render(truth.cameras[0], ["b"])
    with pytest.raises(api.DataError, match="no finished"):
        runs.model("measure-0000")


def test_charts_are_saved_in_three_formats(runs: api.Runs, tmp_path) -> None:
    name, drawing = next(iter(runs.charts.items()))
    assert drawing.name == name
    assert drawing._repr_svg_().startswith("<svg")
    for ending, head in ((".svg", b"<svg"), (".pdf", b"%PDF"), (".png", b"\x89PNG")):
        drawing.save(tmp_path / f"chart{ending}")
        assert (tmp_path / f"chart{ending}").read_bytes().startswith(head)
    with pytest.raises(api.DataError, match=r"SVG, PDF or PNG"):
        drawing.save(tmp_path / "chart.jpg")
    assert runs.report(tmp_path / "page" / "report.html").is_file()
    assert runs.answers == {}
