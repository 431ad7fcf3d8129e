"""The views job owns the truth: what it stored is what every later job reads, whatever is installed then."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from econgs_bench.bench.jobs import scenes
from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.jobs.fit import read_volumes, refuse_without_volume
from econgs_bench.bench.jobs.monitor import Stop
from econgs_bench.bench.jobs.truth import Truth, write_truth
from econgs_bench.bench.results import tables
from econgs_bench.bench.store.records import Record, derived_seed
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets import scratch
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.cloud import cloud_source, initial_cloud
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.render_views import views_of
from econgs_bench.datasets.views import ViewRequest, ViewSet
from econgs_bench.methods.contract.scene import tiny_scene
from econgs_bench.methods.gaussian_splatting.spec import SPEC
from econgs_bench.methods.interface import Refused

from .conftest import plan

REQUEST = {"train_views": 12, "test_views": 4, "width": 16, "height": 16}


@pytest.mark.parametrize("split", ["test", "val"])
def test_a_fit_reads_what_was_rendered_bit_for_bit_and_opens_no_dataset(
    suite, tmp_path, monkeypatch, split
) -> None:
    monkeypatch.setenv("BENCH_CACHE", str(tmp_path / "cache"))
    jobs = plan(suite(), scenes=("shock",), split=split)
    views, fit = jobs[0], jobs[1]
    dataset = open_dataset(views.dataset)
    splits = ("train", "val") if split == "val" else ("trainval", "test")
    sets = {name: views_of(dataset, "shock", ViewRequest(name, **REQUEST)) for name in splits}
    store = Store(tmp_path / "runs", create=True)
    folder = store.partial / views.id
    folder.mkdir()
    write_truth(folder, sets, dataset.scene("shock"), cloud_source(dataset, dataset.scene("shock")))
    store.finish(Record(job=views, status="ok", started="2026", finished="2026", wall_seconds=0.0), folder)

    monkeypatch.setattr(scenes, "open_dataset", lambda name: Path("/nowhere").stat())
    context = Context(fit, tmp_path, store, None, 1, Stop(), lambda **state: None)
    (scene,) = scenes.scene_inputs(context.job, context)
    assert scene.scene == dataset.scene("shock")
    train, other = (sets[name] for name in splits)
    np.testing.assert_array_equal(scene.train.images, train.images)
    assert len(scene.validation) == (1 if split == "val" else 0)
    cloud = initial_cloud(dataset, "shock", 10_000, derived_seed("cloud", fit.dataset_name, "shock", 0))
    np.testing.assert_array_equal(scene.cloud.points, cloud.points)
    np.testing.assert_array_equal(scene.cloud.colors, cloud.colors)
    measured = context.truth("shock").views(split)
    np.testing.assert_array_equal(measured.images, other.images)
    for camera, rendered in zip(measured.cameras, other.cameras, strict=True):
        np.testing.assert_array_equal(camera.camera_to_world, rendered.camera_to_world)
        for field in ("fx", "fy", "cx", "cy", "width", "height", "name"):
            assert getattr(camera, field) == getattr(rendered, field)
    assert measured.background == other.background
    with pytest.raises(FileNotFoundError):
        scene.volume()  # what a method asks for that reads the volume itself


def test_each_seed_of_a_fit_has_an_initial_cloud_of_its_own(suite, tmp_path, monkeypatch) -> None:
    """Without it, repetitions would differ by less than the choice of the cloud makes of a result."""
    monkeypatch.setenv("BENCH_CACHE", str(tmp_path / "cache"))
    jobs = plan(suite(), scenes=("shock",), seeds=(0, 1))
    (views,) = (job for job in jobs if job.kind == "views")
    dataset, store = open_dataset(views.dataset), Store(tmp_path / "runs", create=True)
    folder = store.partial / views.id
    folder.mkdir()
    sets = {name: views_of(dataset, "shock", ViewRequest(name, **REQUEST)) for name in ("trainval", "test")}
    write_truth(folder, sets, dataset.scene("shock"), cloud_source(dataset, dataset.scene("shock")))
    store.finish(Record(job=views, status="ok", started="2026", finished="2026", wall_seconds=0.0), folder)

    clouds = {}
    for fit in (job for job in jobs if job.kind == "fit"):
        few = fit.model_copy(update={"cloud_points": 200})  # of some thousand candidates
        context = Context(few, tmp_path, store, None, 1, Stop(), lambda **state: None)
        first, again = (scenes.scene_inputs(context.job, context)[0].cloud.points for _ in range(2))
        np.testing.assert_array_equal(first, again)
        clouds[fit.seed] = {tuple(point) for point in first.tolist()}
    assert set(clouds) == {0, 1}
    assert [len(cloud) for cloud in clouds.values()] == [200, 200]
    assert len(clouds[0] & clouds[1]) < 100


def test_pictures_that_16_bits_do_not_hold_survive_and_some_can_be_read_alone(tmp_path) -> None:
    images = _stored(tmp_path).images
    back = Truth(tmp_path).views("test")
    np.testing.assert_array_equal(back.images, images)
    assert back.background == (0.1, 0.2, 1 / 3)
    np.testing.assert_array_equal(Truth(tmp_path).views("test", [1, 3]).images, images[[1, 3]])


def test_views_of_a_group_beyond_the_limit_lie_in_a_file_with_the_same_values(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("BENCH_CACHE", str(tmp_path / "cache"))
    images = _stored(tmp_path).images
    truth = Truth(tmp_path)
    assert truth.images_bytes("test") == images.nbytes
    monkeypatch.setattr(scratch, "LIMIT", 3 * images.nbytes)
    for scenes_of_a_group, in_a_file in ((3, False), (4, True)):
        found = truth.views("test", together=scenes_of_a_group * truth.images_bytes("test")).images
        assert scratch.is_mapped(found) == in_a_file
        np.testing.assert_array_equal(found, images)


def _stored(folder: Path) -> ViewSet:
    """Four stored views of noise."""
    images = np.random.default_rng(0).random((4, 3, 5, 4), dtype=np.float32)
    views = ViewSet((Camera.with_fov(np.eye(4), 0.6, 5, 3),) * 4, images, (0.1, 0.2, 1 / 3), "key")
    write_truth(folder, {"test": views}, None, None)
    return views


@pytest.mark.parametrize("name", ["views.json", "test.zst"])
@pytest.mark.parametrize(
    "damage",
    [lambda data: data[:-9], lambda data: b"", lambda data: data[:-9] + b"3" + data[-8:], None],
)
def test_damaged_truth_is_an_error_that_names_the_file(tmp_path, name, damage) -> None:
    _stored(tmp_path)
    file = tmp_path / name
    if damage is None:
        file.unlink()
    else:
        file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(DataError, match=f"{name}.*bench run makes it again"):
        Truth(tmp_path).views("test")


def test_a_cloud_that_cannot_be_unpacked_is_an_error_that_names_the_file(tmp_path) -> None:
    _stored(tmp_path)
    file = tmp_path / "cloud.npz"
    np.savez_compressed(file, points=np.random.default_rng(0).random(1000))
    data = file.read_bytes()
    file.write_bytes(data[:100] + 200 * b"\xff" + data[300:])
    with pytest.raises(DataError, match=r"cloud.npz.*bench run makes it again"):
        Truth(tmp_path).cloud(10, 1)


def test_a_method_that_reads_volumes_refuses_scenes_that_have_only_views():
    reads = replace(SPEC, needs_volume=True)
    with pytest.raises(Refused, match="scene 'there' has only views"):
        refuse_without_volume(reads, [tiny_scene("here", volume="transfer"), tiny_scene("there")])
    refuse_without_volume(reads, [tiny_scene("here", volume="transfer")])
    refuse_without_volume(SPEC, [tiny_scene("there")])


def test_volumes_are_read_before_a_fit_for_methods_that_read_them():
    read = []
    scene = replace(tiny_scene("here"), volume=lambda: read.append("here"))
    read_volumes(SPEC, [scene])
    assert not read
    read_volumes(replace(SPEC, needs_volume=True), [scene, tiny_scene("there")])
    assert read == ["here"]


@pytest.mark.slow
def test_a_renderer_that_comes_or_goes_between_two_jobs_changes_nothing(bench, suite) -> None:
    """Fits that failed, another method and another rate go on with the views that are there."""
    run = partial(bench.run_suite, suite(), "--scene", "shock")
    cure = bench.store.parent / "cure"
    wrong = ("--method", "fake", "--set", "fake.behaviour=raise", "--set", f"fake.file={cure}")
    run(*wrong, code=1)
    (before,) = bench.of_kind("views")

    bench.environment |= {
        "DRJIT_LIBLLVM_PATH": str(bench.store.parent / "none" / "libLLVM.so"),
        "CUDA_VISIBLE_DEVICES": "-1",
        "BENCH_CACHE": str(bench.store.parent / "another cache"),
    }
    cure.touch()
    run(*wrong, "--retry")
    run("--method", "fake-joint")
    assert bench.of_kind("views") == [before]
    assert not (bench.store.parent / "another cache" / "views").exists()  # nothing was rendered
    assert all(record.ok for record in bench.records().values())
    measures = bench.of_kind("measure")
    assert {record.job.method for record in measures} == {"fake", "fake-joint"}
    for record in measures:
        (fit,) = [fit for fit in bench.of_kind("fit") if fit.job.method == record.job.method]
        # The four views of the curve are those that are measured on: from one truth, so the same number.
        assert fit.result.curve[-1].psnr["shock"] == pytest.approx(record.result.metrics["psnr"], abs=1e-9)


def test_the_views_of_a_basic_scene_tell_what_it_shows_and_how_long_its_cloud_took(
    suite, tmp_path, monkeypatch
) -> None:
    monkeypatch.setenv("BENCH_CACHE", str(tmp_path / "cache"))
    jobs = plan(suite('compositions = "all"'))
    store = Store(tmp_path / "runs", create=True)
    results, rows = {}, {}
    for name in ("shock", "all"):
        job = next(one for one in jobs if one.kind == "views" and one.subject == name)
        folder = store.partial / job.id
        folder.mkdir()
        context = Context(job, folder, store, None, 1, Stop(), lambda **state: None)
        results[name] = job.run(context)
        record = Record(
            job=job, status="ok", started="2026", finished="2026", wall_seconds=0.0, views=results[name]
        )
        (rows[name],) = tables.stored_tables([record])["scenes"].to_dict("records")
    variable = open_dataset(job.dataset).scene("shock").variable
    assert results["shock"].variable == rows["shock"]["variable"] == variable
    assert 0.0 < results["shock"].cloud_seconds < 60.0
    assert rows["shock"]["cloud_seconds"] == results["shock"].cloud_seconds
    assert (results["all"].variable, results["all"].cloud_seconds) == ("", None)
    assert pd.isna(rows["all"]["variable"])
