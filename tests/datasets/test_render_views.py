from __future__ import annotations

import logging
import os
import subprocess
import sys
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from econgs_bench.datasets import render_views
from econgs_bench.datasets.edits import Edit
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.ground_truth import probe
from econgs_bench.datasets.render_views import views_of
from econgs_bench.datasets.scene import BasicScene, Dataset, Isosurface, Light
from econgs_bench.datasets.transfer import Bump, TransferFunction
from econgs_bench.datasets.views import ViewRequest
from econgs_bench.datasets.volume import Volume

ROOT = Path(__file__).parents[2]
TRAIN = ViewRequest("train", 12, 5, 24, 24)
TRANSFER = TransferFunction("t", (Bump("b", 0.5, 0.6, 0.9, 1.0, (0.9, 0.4, 0.2), 0.4),))


def field(seed=0):
    values = gaussian_filter(np.random.default_rng(seed).standard_normal((14, 16, 12)), 1.5)
    return ((values - values.min()) / np.ptp(values)).astype(np.float32)


def dataset(values=None, spacing=(1.0, 1.0, 1.0), **scene):
    v = Volume("v", field() if values is None else values, spacing, (0.0, 1.0), "made here")
    basic = replace(BasicScene("s", "v", TRANSFER, background=(0.1, 0.2, 0.3)), **scene)
    return Dataset("d", "made here", "volume", (basic,), volumes={"v": lambda: v})


@pytest.fixture
def no_backend(monkeypatch):
    """A machine without a usable libLLVM."""
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/nonsense/libLLVM.so")
    monkeypatch.setattr(probe, "_has_cuda_driver", lambda: False)
    probe.find_backend.cache_clear()
    render_views._notice.cache_clear()
    yield
    probe.find_backend.cache_clear()


def test_splits_share_one_rendering(cache, monkeypatch):
    data = dataset()
    train = views_of(data, "s", TRAIN, cache=cache)
    monkeypatch.setattr(render_views.RenderJob, "render", None)  # all else comes from the cache
    val = views_of(data, "s", replace(TRAIN, split="val"), cache=cache)
    both = views_of(data, "s", replace(TRAIN, split="trainval"), cache=cache)
    assert (len(train), len(val), len(both)) == (11, 1, 12)
    assert [c.name for c in val.cameras] == ["train_009"]
    np.testing.assert_array_equal(np.insert(train.images, 9, val.images[0], axis=0), both.images)
    assert len({train.key, val.key, both.key}) == 3
    assert train.background == (0.1, 0.2, 0.3)
    assert train.images.shape == (11, 24, 24, 4)
    assert train.images.dtype == np.float32
    assert train.images[..., 3].max() > 0.3


def test_a_hit_equals_the_rendering_and_a_damaged_entry_is_made_again(cache):
    first = views_of(dataset(), "s", TRAIN, cache=cache)
    second = views_of(dataset(), "s", TRAIN, cache=cache)
    np.testing.assert_array_equal(first.images, second.images)
    (entry,) = cache.folder.iterdir()
    size = (entry / "images.zst").stat().st_size
    (entry / "images.zst").write_bytes(b"rubbish")
    np.testing.assert_array_equal(views_of(dataset(), "s", TRAIN, cache=cache).images, first.images)
    assert (entry / "images.zst").stat().st_size == size


def key_of(data, request=TRAIN, renderer="auto"):
    return render_views.RenderJob.of(data, data.parts("s"), request, renderer).key


def test_the_key_follows_content_and_nothing_else():
    other = field()
    other[3, 4, 5] += 1e-3
    bump = TRANSFER.bumps[0]
    keys = [
        key_of(dataset()),
        key_of(dataset(other)),
        key_of(dataset(spacing=(1.0, 1.0, 1.1))),
        key_of(dataset(light=None)),
        key_of(dataset(light=Light(shininess=21.0))),
        key_of(dataset(light=Light(direction=(0.0, 0.0, 1.0)))),
        key_of(dataset(light=Light(model="phong"))),
        key_of(dataset(depth_enhancement=0.5)),
        key_of(dataset(depth_enhancement=0.6)),
        key_of(dataset(transfer=None, isosurfaces=(Isosurface("i", 0.5, (1.0, 0.0, 0.0)),))),
        key_of(dataset(transfer=None, isosurfaces=(Isosurface("i", 0.5, (1.0, 0.0, 0.0), 0.9),))),
        key_of(dataset(transfer=replace(TRANSFER, reference_length=0.02))),
        key_of(dataset(transfer=replace(TRANSFER, bumps=(replace(bump, rise=0.61),)))),
        key_of(dataset(), replace(TRAIN, width=25)),
        key_of(dataset(), replace(TRAIN, train_views=42)),
        key_of(dataset(), replace(TRAIN, split="test")),
        key_of(dataset(), replace(TRAIN, split="test", test_views=6)),
        key_of(dataset(), renderer="reference"),
    ]
    assert len(set(keys)) == len(keys)
    named = replace(TRANSFER, name="other", bumps=(replace(bump, name="other"),))
    same = [
        key_of(dataset(transfer=named)),
        key_of(dataset(background=(1.0, 1.0, 1.0))),  # images are background-free
        key_of(dataset(), replace(TRAIN, test_views=9)),
    ]
    assert set(same) == {keys[0]}


def test_keys_of_scenes_stay_what_they_were(monkeypatch):
    """A change of key renders every recorded ground truth anew: only MODEL_VERSION may do that."""
    monkeypatch.setattr(render_views.RenderJob, "renderer", {"renderer": "none"})
    values = np.arange(64, dtype=np.uint8).reshape(4, 4, 4)
    one_ray = key_of(dataset(values), replace(TRAIN, samples=1))
    assert one_ray == "f4bde0f2ea9e342e50fe69bc696993dfe24457a6"


def two(**second):
    """A dataset of two variables with a scene each, and the composition of both."""
    volumes = {
        "v": Volume("v", field(), (1.0, 1.0, 1.0), (0.0, 1.0), "made here"),
        "w": Volume("w", field(1), (1.0, 1.0, 1.0), (0.0, 1.0), "made here"),
    }
    other = TransferFunction("o", (Bump("b", 0.2, 0.3, 0.4, 0.5, (0.1, 0.4, 0.9), 0.3),))
    scenes = (
        BasicScene("s", "v", TRANSFER, background=(0.1, 0.2, 0.3)),
        replace(BasicScene("t", "w", other, Light(direction=(0.0, 0.0, 1.0))), **second),
    )
    return Dataset(
        "d", "made", "volume", scenes, {"both": ("s", "t")}, {n: lambda v=v: v for n, v in volumes.items()}
    )


def test_a_composition_has_views_cost_and_a_key_of_its_own(cache):
    data, train = two(), replace(TRAIN, samples=1)  # along a ray optical depths add
    both = views_of(data, "both", train, cache=cache)
    alone = [views_of(data, name, train, cache=cache) for name in ("s", "t")]
    assert both.background == (0.1, 0.2, 0.3)
    assert len({both.key, *(views.key for views in alone)}) == 3
    # Nothing that is composed shows less than the most opaque of its parts, nor more than both together.
    alphas = [views.images[..., 3] for views in alone]
    assert (both.images[..., 3] >= np.maximum(*alphas) - 1e-4).all()
    np.testing.assert_allclose(
        both.images[..., 3], 1.0 - (1.0 - alphas[0]) * (1.0 - alphas[1]), atol=1e-4
    )  # Extinctions add.
    assert both.cost["views"] == 12
    reference = views_of(data, "both", train, renderer="reference", cache=cache)
    assert reference.key != both.key
    np.testing.assert_allclose(both.images, reference.images, atol=1e-3)


def test_volumes_of_a_composition_must_share_their_grid(cache):
    data = two()
    data.volumes["w"] = lambda: Volume("w", field()[:, :, ::2], (2.0, 1.0, 1.0), (0.0, 1.0), "made here")
    with pytest.raises(DataError, match=r"d/s \+ t.*differ in grid or box: v \(12x16x14.* and w \(6x16x14"):
        views_of(data, "both", TRAIN, cache=cache)


def test_edits_have_views_of_their_own_and_any_background(cache):
    data, train = two(), replace(TRAIN, samples=1)  # how many rays a pixel needs depends on its colors
    plain = views_of(data, "both", train, cache=cache)
    same = views_of(data, "both", train, edit={"s": Edit()}, background=(0.0, 1.0, 0.0), cache=cache)
    assert same.key == plain.key
    assert same.background == (0.0, 1.0, 0.0)
    red = views_of(data, "both", train, edit={"t": Edit(palette=(0.9, 0.1, 0.1))}, cache=cache)
    assert red.key != plain.key
    np.testing.assert_array_equal(red.images[..., 3], plain.images[..., 3])
    assert red.images[..., 0].mean() > plain.images[..., 0].mean() + 0.01
    gone = views_of(data, "both", train, edit={"t": Edit(opacity=0.0)}, cache=cache)
    np.testing.assert_allclose(gone.images, views_of(data, "s", train, cache=cache).images, atol=2e-5)
    with pytest.raises(DataError, match="edited scene 'x'"):
        views_of(data, "both", train, edit={"x": Edit(opacity=0.5)}, cache=cache)
    assert gone.cost["views"] == 12


def test_progress_and_cost(cache):
    seen = []
    views = views_of(
        dataset(), "s", TRAIN, renderer="reference", cache=cache, progress=lambda *a: seen.append(a)
    )
    assert seen == [(i, 12) for i in range(1, 13)]
    cost = views.cost
    assert cost["renderer"] == "reference"
    assert cost["views"] == 12
    assert 0.0 < cost["ms_per_view"] < 1e5
    assert key_of(dataset(), renderer="mitsuba") != views.key.removesuffix("-train")


def test_requests_that_cannot_be_met_are_refused(cache):
    for request, reason in (
        (replace(TRAIN, split="val", train_views=6), "fewer than ten"),
        (replace(TRAIN, train_views=13), "12 and 42"),
        (replace(TRAIN, width=0), "at least one pixel"),
    ):
        with pytest.raises(DataError, match=reason):
            views_of(dataset(), "s", request, cache=cache)
    with pytest.raises(DataError, match="no transfer function"):
        views_of(dataset(transfer=None), "s", TRAIN, cache=cache)
    with pytest.raises(DataError, match="unknown name"):
        views_of(dataset(), "x", TRAIN, cache=cache)


def test_without_libllvm_the_reference_renders_with_a_notice(no_backend, cache, caplog):
    with caplog.at_level(logging.WARNING):
        views = views_of(dataset(), "s", TRAIN, cache=cache)
        assert len(views_of(dataset(), "s", replace(TRAIN, split="test"), cache=cache)) == 5
    assert views.images[..., 3].max() > 0.3
    assert views.cost["renderer"] == "reference"
    (notice,) = [r.getMessage() for r in caplog.records]
    for word in ("/nonsense/libLLVM.so does not exist", "libllvm19", "DRJIT_LIBLLVM_PATH", "reference"):
        assert word in notice
    with pytest.raises(DataError, match="libllvm19"):
        views_of(dataset(), "s", TRAIN, renderer="mitsuba", cache=cache)


def output_of(code, **environment):
    """Output of a fresh process."""
    command, environment = [sys.executable, "-c", code], {**os.environ, **environment}
    return subprocess.check_output(command, encoding="utf-8", env=environment, cwd=ROOT)


def trial(library, cache_folder):
    """What a fresh process makes of a library, and how often it had to try."""
    code = (
        "from econgs_bench.datasets.ground_truth import probe\n"
        "probe._has_cuda_driver = lambda: False\n"
        "real, tries = probe._try, []\n"
        "probe._try = lambda *a: (tries.append(a), real(*a))[1]\n"
        "b = probe.find_backend()\n"
        "print(b.name, len(tries), b.reason)\n"
    )
    return output_of(code, DRJIT_LIBLLVM_PATH=str(library), BENCH_CACHE=str(cache_folder))


def test_a_library_that_is_none_is_found_out_once(tmp_path):
    library = tmp_path / "lib" / "libLLVM.so"  # beside no cache: its folder's time counts too
    library.parent.mkdir()
    library.write_text("this is no library")
    first = trial(library, tmp_path / "cache")
    assert first.startswith("none 1 ")
    assert "Dr.Jit" in first
    assert trial(library, tmp_path / "cache").startswith("none 0 ")
    os.utime(library, (1e9, 1e9))  # another file now: tried again
    assert trial(library, tmp_path / "cache").startswith("none 1 ")


@pytest.mark.parametrize(
    "outcome",
    [
        subprocess.TimeoutExpired("python", 120.0),
        subprocess.CompletedProcess("python", -9, "", ""),
        OSError("no memory"),
    ],
)
def test_a_trial_that_decides_nothing_is_an_error_and_no_other_renderer(
    monkeypatch, tmp_path, cache, outcome
):
    library = tmp_path / "libLLVM.so"
    library.touch()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(library))
    monkeypatch.setenv("BENCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(probe, "_has_cuda_driver", lambda: False)
    monkeypatch.setattr(probe.subprocess, "run", Mock(side_effect=repeat(outcome)))
    probe.find_backend.cache_clear()
    for _ in range(2):
        with pytest.raises(DataError, match=r"libLLVM.so.*less busy.*DRJIT_LIBLLVM_PATH"):
            views_of(dataset(), "s", TRAIN, cache=cache)
    assert not (tmp_path / "cache" / "probe").exists()
    assert views_of(dataset(), "s", TRAIN, cache=cache, renderer="reference").cost["renderer"] == "reference"
    probe.find_backend.cache_clear()


def test_cuda_is_left_alone_where_it_is_not_asked_for(monkeypatch):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "libLLVM.so")
    monkeypatch.setattr(probe, "_has_cuda_driver", lambda: True)
    monkeypatch.setattr(probe, "_trial_failure", lambda backend, library: "")
    probe.find_backend.cache_clear()
    assert probe.find_backend() == probe.Backend("cuda")
    assert probe.find_backend(cuda=False) == probe.Backend("llvm", "libLLVM.so")
    probe.find_backend.cache_clear()


def test_without_the_package_the_reference_renders_and_its_remedy_is_named(monkeypatch, cache, caplog):
    there = probe.importlib.util.find_spec
    monkeypatch.setattr(
        probe.importlib.util, "find_spec", lambda name: None if name == "mitsuba" else there(name)
    )
    for function in (probe.find_backend, render_views._notice):
        function.cache_clear()
    assert views_of(dataset(), "s", TRAIN, cache=cache).cost["renderer"] == "reference"
    assert "mitsuba not installed. pip install mitsuba" in caplog.text
    with pytest.raises(DataError, match="mitsuba not installed"):
        views_of(dataset(), "s", TRAIN, cache=cache, renderer="mitsuba")
    for function in (probe.find_backend, render_views._notice):
        function.cache_clear()


def test_the_marcher_has_the_threads_of_the_native_kernels():
    code = (
        "from econgs_bench.datasets.ground_truth import probe\n"
        "probe.activate(probe.find_backend(cuda=False))\n"
        "import drjit\n"
        "print(drjit.thread_count())\n"
    )
    assert [output_of(code, ECONGS_THREADS=str(n)).strip() for n in (1, 3)] == ["1", "3"]


def test_a_libllvm_that_aborts_is_survived(tmp_path):
    found = [p for p in probe.libllvm_candidates() if "libLLVM-15" in p or "libLLVM-16" in p]
    if not found:
        pytest.skip("neither libLLVM 15 nor 16 is installed here")
    assert trial(found[0], tmp_path).startswith("none 1 ")


def test_the_libllvm_of_the_environment_is_tried_first_then_the_newest(monkeypatch, tmp_path):
    system, own = tmp_path / "system", tmp_path / "environment"
    (own / "lib").mkdir(parents=True)
    system.mkdir()
    for name in (
        "libLLVM-15.so.1",
        "libLLVM.so.19.1",
        "libLLVM-17.so.1",
        "libLLVM-14.so.1",
        "libLLVM.so.22.0",
    ):
        (system / name).write_text("")
    (system / "libLLVM-19.so").symlink_to(system / "libLLVM.so.19.1")
    (own / "lib" / "libLLVM.so.18.1").write_text("")
    (own / "lib" / "libLLVM.so").symlink_to("libLLVM.so.18.1")
    monkeypatch.setattr(probe, "_PATTERNS", (f"{system}/libLLVM*.so*",))
    monkeypatch.setattr(sys, "prefix", str(own))
    monkeypatch.setattr(probe.sysconfig, "get_path", lambda name: str(own))
    monkeypatch.setattr(probe.site, "getuserbase", lambda: str(tmp_path / "none"))
    monkeypatch.delenv("LD_LIBRARY_PATH", raising=False)
    names = [os.path.basename(p) for p in probe.libllvm_candidates()]
    newest_first = ["libLLVM.so.22.0", "libLLVM.so.19.1", "libLLVM-17.so.1", "libLLVM-15.so.1"]
    assert names == ["libLLVM.so.18.1", *newest_first]


def test_a_libllvm_that_failed_is_tried_again_when_files_come_beside_it(monkeypatch, tmp_path):
    """The wheel's library needs links to libc++, which may come after it."""
    monkeypatch.setenv("BENCH_CACHE", str(tmp_path / "cache"))
    library = tmp_path / "lib" / "libLLVM.so.23.1"
    library.parent.mkdir()
    library.write_text("")
    answers = ["aborts", ""]
    monkeypatch.setattr(probe, "_try", lambda *_: answers.pop(0))
    assert probe._trial_failure("llvm", str(library)) == "aborts"
    assert probe._trial_failure("llvm", str(library)) == "aborts"
    (library.parent / "libc++.so.1").write_text("")
    os.utime(library.parent, ns=(1, 1))  # clocks of file systems are coarse
    assert probe._trial_failure("llvm", str(library)) == ""


def test_a_cached_view_needs_neither_mitsuba_nor_torch(tmp_path):
    code = (
        "import sys; sys.path.insert(0, 'tests/datasets')\n"
        "from test_render_views import *\n"
        "views_of(dataset(), 's', TRAIN)\n"
        "print([m for m in ('mitsuba', 'drjit', 'torch') if m in sys.modules])\n"
    )
    runs = [output_of(code, BENCH_CACHE=str(tmp_path), PYTHONPATH=".").strip() for _ in range(2)]
    assert "drjit" in runs[0] or "torch" in runs[0]
    assert runs[1] == "[]"
