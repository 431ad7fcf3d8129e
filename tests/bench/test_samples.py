"""Rays of a pixel as users ask for them: bad numbers, `bench samples`, and a truth that does not converge."""

from __future__ import annotations

import json
import logging

import numpy as np
import pandas as pd
import pytest

import econgs_bench as bench
from econgs_bench.bench.__main__ import main
from econgs_bench.bench.commands.samples import METRICS, NUMBERS
from econgs_bench.bench.jobs import views as views_job
from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.jobs.monitor import Stop
from econgs_bench.bench.plan.selection import Selection
from econgs_bench.bench.store.store import Store
from econgs_bench.bench.suites.suite import load_suite
from econgs_bench.datasets.errors import DataError

from .conftest import plan, suite_file

SCENE = """
[[files]]
path = "values.npy"

[[scenes]]
name = "s"
light = { ambient = 0.2, diffuse = 0.8, specular = 0.0 }
[[scenes.bumps]]
name = "s"
range = [0.45, 0.5, 1.0, 1.0]
color = [0.9, 0.6, 0.2]
opacity = 0.9
"""


@pytest.fixture
def noise(tmp_path, monkeypatch):
    """An opaque field of white noise, whose voxels are smaller than a pixel."""
    monkeypatch.setenv("BENCH_CACHE", str(tmp_path / "cache"))
    values = np.random.default_rng(0).random((64, 64, 64)).astype(np.float32)
    np.save(tmp_path / "values.npy", values)
    path = tmp_path / "noise.toml"
    path.write_text(SCENE)
    return path


@pytest.mark.parametrize("value", ["0", "-1", "3", "many", "1.5", str(2000**2), ""])
@pytest.mark.parametrize("command", [["run", "quick"], ["plan", "quick"], ["render", "shells@16"]])
def test_other_numbers_on_the_command_line_are_one_line(
    tmp_path, monkeypatch, capsys, command, value
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([*command, f"--samples={value}"]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("bench: --samples: a pixel has 1, 4, 9, 16 ... 1024 samples, not ")
    assert printed.err.count("\n") == 1
    assert "Take " in printed.err
    assert not list(tmp_path.iterdir())


def test_another_number_in_a_file_names_the_file_and_the_line(noise, capsys) -> None:
    noise.write_text(f'title = "n"\nsamples = 0\n{SCENE}')
    assert main(["plan", "quick", "--dataset", str(noise)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(
        f"bench: {noise}: samples (line 2): a pixel has 1, 4, 9, 16 ... 1024 samples, not 0"
    )
    assert error.count("\n") == 1


@pytest.mark.parametrize("value", [0, -1, 3, "many", 1.5, 2000**2, True, None])
def test_other_numbers_in_python_are_errors(tmp_path, value) -> None:
    with pytest.raises(DataError, match=r"^render_views: a pixel has 1, 4, .*\. Take "):
        bench.render_views(bench.open_dataset("shells@16"), "core", count=1, size=(8, 8), samples=value)
    with pytest.raises(DataError, match=r"^run: a pixel has 1, 4, .*\. Take "):
        bench.run("quick", out=tmp_path / "runs", samples=value)
    assert not list(tmp_path.iterdir())


def test_views_in_python_have_the_rays_that_are_asked_for(noise) -> None:
    dataset = bench.open_dataset(str(noise))
    one, four, needed = (
        bench.render_views(dataset, "s", count=1, size=(16, 16), samples=samples)
        for samples in (1, 4, "auto")
    )
    assert len({one.key, four.key, needed.key}) == 3
    np.testing.assert_array_equal(
        needed.images, bench.render_views(dataset, "s", count=1, size=(16, 16)).images
    )


def run_views(path, folder, **changes):
    jobs = plan(suite_file(folder, f'"{path}" = []\n{PRESET}'), **changes)
    store = Store(folder / "runs", create=True)
    results = []
    for job in jobs:
        if job.kind == "views":
            place = store.partial / job.id
            place.mkdir()
            results.append(job.run(Context(job, place, store, None, 1, Stop(), lambda **state: None)))
    return results


PRESET = """
[presets.quick]
train_views = 12
test_views = 4
width = 16
height = 16
prerendered_limit = 16
"""


def test_a_truth_that_does_not_converge_is_reported_with_its_floor(noise, tmp_path, caplog) -> None:
    with caplog.at_level(logging.WARNING):
        (result,) = run_views(noise, tmp_path)
    (message,) = [record.getMessage() for record in caplog.records if "converged" in record.getMessage()]
    assert message.startswith("noise/s: ")
    assert f"{result.floor['psnr']:.1f} dB" in message
    assert 15.0 < result.floor["psnr"] < views_job.CONVERGED
    assert result.one_ray["psnr"] < result.floor["psnr"]


def test_a_truth_that_converges_is_not_reported(noise, tmp_path, caplog) -> None:
    z, y, x = np.meshgrid(*[np.linspace(-1.0, 1.0, 24)] * 3, indexing="ij")
    np.save(noise.parent / "values.npy", np.exp(-(x**2) - y**2 - z**2).astype(np.float32))
    with caplog.at_level(logging.WARNING):
        (result,) = run_views(noise, tmp_path)
    assert result.floor["psnr"] >= views_job.CONVERGED
    assert not [record for record in caplog.records if "converged" in record.getMessage()]


def test_samples_are_compared_by_one_command(capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("BENCH_CACHE", str(tmp_path))
    arguments = [
        "samples",
        "vortices@32",
        "--scene",
        "cores",
        "--scene",
        "halos",
        "--views",
        "2",
        "--size",
        "32",
    ]
    assert main([*arguments, "--format", "json"]) == 0
    table = pd.DataFrame(json.loads(capsys.readouterr().out))
    assert list(table["scene"]) == ["cores"] * len(NUMBERS) + ["halos"] * len(NUMBERS)
    assert list(table["rays a pixel"][: len(NUMBERS)]) == ["1", "4", "9", "16", "64", "as needed"]
    assert {*METRICS, "time a view [ms]"} <= set(table.columns)
    cores = table[table["scene"] == "cores"].set_index("rays a pixel")
    assert cores["psnr"]["1"] < cores["psnr"]["4"] - 5.0 < cores["psnr"]["16"] - 10.0
    assert cores["psnr"]["as needed"] > cores["psnr"]["9"]
    assert cores["ssim"]["1"] < cores["ssim"]["16"]
    assert (table["time a view [ms]"] > 0.0).all()


def test_samples_of_pre_rendered_views_are_refused(capsys, dataset) -> None:
    assert main(["samples", str(dataset)]) == 2
    assert "was rendered elsewhere" in capsys.readouterr().err


def test_a_suite_has_the_rays_of_its_datasets_unless_others_are_asked_for(noise, tmp_path) -> None:
    suite = suite_file(tmp_path, f'"{noise}" = []\n{PRESET}')

    def samples(**changes):
        (found,) = {job.request.samples for job in plan(suite, **changes)}
        return found

    assert samples() == 0
    noise.write_text(f"samples = 4\n{SCENE}")
    assert samples() == 4
    assert samples(samples=1) == 1
    assert Selection(load_suite(suite)).samples is None
