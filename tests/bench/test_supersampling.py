"""Methods that draw what is at the centre of a pixel, drawn as means over pixels."""

from __future__ import annotations

import shutil
import textwrap
from collections import Counter
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from econgs_bench.bench import api
from econgs_bench.bench.jobs.supersampling import Supersampled, drawn_as
from econgs_bench.bench.plan.planner import Planner
from econgs_bench.bench.plan.selection import Selection
from econgs_bench.bench.results.bundle import write_bundle
from econgs_bench.bench.run.redo import redo
from econgs_bench.bench.saved import load
from econgs_bench.bench.store.store import Store
from econgs_bench.bench.suites.suite import load_suite
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError
from econgs_bench.methods import reference
from econgs_bench.methods.interface import HasAttributes, HasDecoders
from econgs_bench.methods.options import resolve
from econgs_bench.methods.registry import Registry
from econgs_bench.reports.report import Report

from .conftest import SMALL, suite_file

BOTH = ({}, {"plenoxels": {"samples": 16}})
TOY = """
    from dataclasses import dataclass
    from econgs_bench.methods.interface import MethodSpec, RateKnob, option

    @dataclass(frozen=True)
    class Options:
        size: float = option(1.0, "how much", minimum=0.5)

    SPEC = MethodSpec(
        name="drawn-toy", title="A toy", reference="", version="1", implementation="drawn_toy.method:Toy",
        uses_alpha="no", options=Options, iterations={"quick": 20, "standard": 200, "paper": 2000},
        rate_knobs=(RateKnob("digits", (2.0, 6.0), refit=False),), devices=("cpu",), point_sampled=True,
    )
"""
STRIPES = """
    import numpy as np
    from econgs_bench.methods.interface import Checkpoint

    class Stripes:
        scenes = ("a",)

        widths = set()  # of all pictures so far

        def __init__(self, each_frame=False):
            self.each_frame = each_frame

        def primitives(self, scene=None):
            return 1

        def save(self, folder, rate=None):
            (folder / "empty").write_text("1")
            return {"a": {"one": 1}}

        def render(self, camera, scenes=None, edit=None, background=None):
            assert camera.width in self.widths or not self.each_frame, "decoding is timed on another size"
            self.widths.add(camera.width)
            x = (np.arange(camera.width) + 0.5) / camera.width
            row = (np.floor(13.0 * x + camera.camera_to_world[0, 3]) % 2).astype(np.float32)
            rows = np.broadcast_to(row, (camera.height, camera.width)).copy()
            return np.stack([rows, 0.5 * rows, 1.0 - rows], axis=-1), rows

        def timings(self, camera, scenes=None):
            return {"rasterise": 1e-4}

        def attributes(self, scene, count):
            return {"place": np.zeros((1, 3), np.float32)}

        def decoding(self, scenes):
            return "once"

        def decoding_each_frame(self):
            return Stripes(each_frame=True)

    class Toy:
        def partition(self, scenes, options):
            return [[scene] for scene in scenes]

        def fit(self, group, options, budget, seed, device, monitor, resume=None):
            monitor.progress(budget.iterations, {"loss": 1.0}, 1)
            monitor.pause(budget.iterations, Stripes, lambda: Checkpoint(budget.iterations, {}, {}))
            return Stripes()

        def restore(self, checkpoint, options, device):
            return Stripes()

        def load(self, folder, device):
            return Stripes()

        def compose(self, models):
            return models[0]
"""


def jobs(method, variants):
    chosen = replace(load_suite("quick"), variants=tuple(variants))
    return Planner(Selection(chosen, scenes=("cores",), methods=(method,))).jobs(None)


@pytest.fixture(scope="module")
def toys(tmp_path_factory):
    """A folder with a point-sampled plugin, whose model has networks and attributes."""
    package = tmp_path_factory.mktemp("toys") / "drawn_toy"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "spec.py").write_text(textwrap.dedent(TOY))
    (package / "method.py").write_text(textwrap.dedent(STRIPES))
    return str(package.parent)


def keys(jobs, kind):
    return {job.key for job in jobs if job.kind == kind}


def test_one_fit_and_one_model_serve_both_drawings():
    both = jobs("plenoxels", BOTH)
    alone = jobs("plenoxels", [{}])
    assert keys(both, "fit") == keys(alone, "fit")
    assert keys(both, "encode") == keys(alone, "encode")
    assert keys(alone, "measure") < keys(both, "measure")
    drawn = {job.variant: job for job in both if job.kind == "measure"}
    assert set(drawn) == {"", "samples=16"}
    assert drawn["samples=16"].options == drawn[""].options
    assert drawn["samples=16"].overrides == {"samples": 16}
    assert {job.variant for job in both if job.kind in ("fit", "encode")} == {""}


def test_one_sample_is_the_drawing_as_published():
    assert keys(jobs("plenoxels", [{"plenoxels": {"samples": 1}}]), "measure") == keys(
        jobs("plenoxels", [{}]), "measure"
    )


def models(variants, **overrides):
    """Variant and rate of what is measured where a suite asks for all rates and another length."""
    chosen = replace(load_suite("quick"), variants=tuple(variants), rates="all", lengths=(0.25,))
    selection = Selection(chosen, scenes=("cores",), methods=("plenoxels",), overrides=overrides)
    return {(job.variant, job.rate) for job in Planner(selection).jobs(None) if job.kind == "measure"}


def test_a_second_drawing_is_of_every_model_that_the_first_one_has():
    usual = models([{}])
    assert len(usual) > 2
    drawn = models(BOTH) - usual
    lengths = {variant for variant, _ in usual} - {""}
    assert lengths
    assert drawn == {("samples=16", rate) for variant, rate in usual if not variant} | {
        (f"{variant},samples=16", None) for variant in lengths
    }


def test_a_drawing_that_the_user_sets_has_all_rates_and_lengths():
    assert models([{"plenoxels": {"samples": 1}}]) == models([{}]) == models(BOTH, plenoxels={"samples": 1})
    drawn = models([{}], plenoxels={"samples": 16})
    assert len(drawn) == len(models([{}]))
    assert all("samples=16" in variant for variant, _ in drawn)
    assert models(BOTH, plenoxels={"samples": 16}) == drawn


def test_jobs_of_one_sample_have_the_keys_of_before(toys, tmp_path, monkeypatch):
    """The keys were computed at commit 94dde38, which knew no samples, with the same plugin and suite."""
    monkeypatch.setattr("econgs_bench.bench.jobs.measure.RULERS", {"frame": 2, "parts": 3})
    chosen = replace(load_suite(suite_file(tmp_path, SMALL)), variants=({}, {"drawn-toy": {"samples": 16}}))
    selection = Selection(chosen, methods=("drawn-toy",), samples=1, plugins=(toys,))
    planned = Planner(selection, {"psnr": "1"}).jobs(None)
    assert {(job.kind, job.scenes[0]): job.key for job in planned if not job.axes()["variant"]} == {
        ("views", "shock"): "cef49b33a101465b",
        ("views", "bubble"): "d4cac2b9b9c840f2",
        ("fit", "shock"): "d400cafd95758b17",
        ("fit", "bubble"): "f5a3fb7f4d45b4a8",
        ("encode", "shock"): "f47ff79431b7ff08",
        ("encode", "bubble"): "025adf225d0593b6",
        ("measure", "shock"): "bfe03b01aa529392",
        ("measure", "bubble"): "e30f597ea0d3fa53",
    }
    assert [(job.kind, job.variant) for job in planned if job.axes()["variant"]] == [
        ("measure", "samples=16")
    ] * 2


@pytest.mark.parametrize(
    ("samples", "near"), [(3, "1 or 4"), ("17", "16 or 25"), (0, "minimum 1"), (1025, "maximum 1024")]
)
def test_only_squares_are_drawn(samples, near):
    with pytest.raises(DataError, match=near):
        resolve(Registry().spec("sz3"), "quick", {"samples": samples})


def test_methods_that_integrate_have_no_such_setting():
    with pytest.raises(DataError, match="samples"):
        resolve(Registry().spec("3dgs"), "quick", {"samples": 16})


def test_the_page_of_options_lists_it_where_a_method_has_it():
    sections = reference.page().split("\n## ")[1:]
    listed = {text.partition("\n")[0] for text in sections if "| `samples` | 1 | 1 to 1024 |" in text}
    assert listed == {"plenoxels", "ccnerf", "mesh", "sz3", "zfp"}


@dataclass
class Ramp:
    """Draws the column and the row of a pixel's centre, in the camera's own pixels."""

    scenes: tuple[str, ...] = ("s",)

    def render(self, camera, scenes=None, edit=None, background=None):
        column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rgb = np.stack([column / camera.width, (row / camera.height) ** 2, column % 2], axis=-1)
        return rgb.astype(np.float32), (row / camera.height).astype(np.float32)

    def timings(self, camera, scenes=None):
        return {"rasterise": float(camera.width)}


def test_a_pixel_is_the_mean_over_a_larger_picture():
    camera = Camera.with_fov(np.eye(4), 0.5, 6, 4)
    model = Supersampled(Ramp(), 4)
    rgb, alpha = model.render(camera)
    larger, larger_alpha = Ramp().render(camera.resized(24, 16))
    np.testing.assert_allclose(rgb, larger.reshape(4, 4, 6, 4, 3).mean((1, 3)), atol=1e-6)
    np.testing.assert_allclose(alpha, larger_alpha.reshape(4, 4, 6, 4).mean((1, 3)), atol=1e-6)
    parts = model.timings(camera)
    assert parts.keys() == {"rasterise", "average"}
    assert parts["rasterise"] == 24.0
    assert model.scenes == ("s",)


def test_the_larger_picture_has_the_edges_of_the_picture():
    """A point of the scene is at the same share of both pictures, off the middle and of unequal sides too."""
    camera = replace(Camera.with_fov(np.eye(4), 0.5, 6, 4), cx=2.2, cy=1.7, fy=9.0)
    seen = []

    class Watched(Ramp):
        def render(self, camera, *more):
            seen.append(camera)
            return super().render(camera)

    Supersampled(Watched(), 3).render(camera)
    x, y = np.array([0.0, 1.3, 6.0]), np.array([0.0, 3.1, 4.0])
    for here, there in zip(camera.rays_through(x, y), seen[0].rays_through(3.0 * x, 3.0 * y), strict=True):
        np.testing.assert_allclose(here, there, atol=1e-12)


def test_parts_are_timed_without_a_picture_each():
    sizes = []

    class Counted(Ramp):
        def render(self, camera, *more):
            sizes.append((camera.width, camera.height))
            return super().render(camera)

    model, camera = Supersampled(Counted(), 2), Camera.with_fov(np.eye(4), 0.5, 6, 4)
    for one in (camera, camera, camera.resized(3, 2), camera.resized(3, 2)):
        assert model.timings(one)["rasterise"] == 2.0 * one.width
    assert sizes == [(12, 8), (6, 4)]


def test_what_is_drawn_larger_can_draw_and_nothing_else():
    """What a model can do is the same on every Python: 3.12 asks no ``__getattr__`` for a protocol."""

    class Decoded(Ramp):
        def attributes(self, scene, count):
            return {}

        def decoding(self, scenes):
            return "once"

        def decoding_each_frame(self):
            return self

    model = Decoded()
    assert isinstance(model, HasAttributes)
    assert isinstance(model, HasDecoders)
    drawn = drawn_as(SimpleNamespace(overrides={"samples": 4}, device="cpu"), model)
    assert not isinstance(drawn, HasAttributes)
    assert not isinstance(drawn, HasDecoders)


def test_a_measurement_without_it_has_the_model_itself():
    model = Ramp()
    assert drawn_as(SimpleNamespace(overrides={}), model) is model


@pytest.fixture(scope="module")
def measured(dataset, toys, tmp_path_factory):
    """Store, plugins and data of a run of the plugin, drawn as means, on pre-rendered views of 8 x 8."""
    folder = tmp_path_factory.mktemp("drawn")
    suite = suite_file(folder, f'"{dataset}" = ["a"]', "variants = [{ drawn-toy = { samples = 16 } }]")
    api.run(suite, out=folder / "runs", methods=["drawn-toy"], plugins=[toys], quiet=True)
    return Store(folder / "runs"), toys, dataset


def of_kind(store, kind):
    (record,) = (record for record in store.records() if record.job.kind == kind)
    return record


def test_a_measurement_times_and_describes_the_model_that_it_draws(measured):
    store, *_ = measured
    record = of_kind(store, "measure")
    assert record.ok, record.reason
    assert record.job.variant == "samples=16"
    assert of_kind(store, "fit").job.variant == ""
    assert set(record.result.timing) == {"frame", "rasterise", "average"}
    assert record.result.decoding == "once"  # it fails where frames with decoding have another size
    assert record.result.frame_seconds_decoding is not None
    assert set(record.result.features) == {"place"}


def test_a_saved_model_renders_as_its_measurement(measured):
    store, plugins, _ = measured
    camera = Camera.with_fov(np.eye(4), 0.5, 6, 4)
    *_, plain = load(store, of_kind(store, "encode").job.id, [plugins])
    *_, drawn = load(store, of_kind(store, "measure").job.id, [plugins])
    larger = [part.reshape(4, 4, 6, 4, -1).mean((1, 3)) for part in plain.render(camera.resized(24, 16))]
    rgb, alpha = drawn.render(camera)
    np.testing.assert_allclose(rgb, larger[0], atol=1e-6)
    np.testing.assert_allclose(alpha[..., None], larger[1], atol=1e-6)
    assert np.abs(rgb - plain.render(camera)[0]).max() > 0.2


def test_a_bundle_is_verified_as_it_was_drawn(measured, tmp_path):
    store, plugins, data = measured
    bundle = tmp_path / "mine.zip"
    write_bundle(store, bundle, models=True)
    redone = redo(store, bundle, 1, datasets=[str(data)], plugins=[plugins])
    assert (redone.problems, redone.unverified) == ([], [])
    assert list(redone.views) == [of_kind(store, "measure").job.id]


def test_both_drawings_of_one_model_are_rows_beside_each_other(measured, tmp_path):
    store, plugins, data = measured
    shutil.copytree(store.root, tmp_path / "runs")
    suite = suite_file(tmp_path, f'"{data}" = ["a"]')
    runs = api.run(suite, out=tmp_path / "runs", methods=["drawn-toy"], plugins=[plugins], quiet=True)
    kinds = Counter(record.job.kind for record in Store(runs.path).records())
    assert (kinds["fit"], kinds["encode"], kinds["measure"]) == (1, 1, 2)
    rows = {row["variant"]: row for _, row in runs.results.iterrows()}
    assert rows.keys() == {"", "samples=16"}
    assert runs.tables["superseded"].empty
    report = Report(runs.tables)
    assert {one.title for one in report.models} == {"drawn-toy", "drawn-toy [samples=16]"}
    assert list(report.of_defaults.results["variant"]) == [""]
    records = [record for record in Store(runs.path).records() if record.job.kind == "measure"]
    measurements = {record.job.variant: record.result for record in records}
    for variant, row in rows.items():
        assert row["fps"] == pytest.approx(1.0 / measurements[variant].frame_seconds)
        assert row["psnr"] == pytest.approx(measurements[variant].metrics["psnr"])
    assert rows[""]["psnr"] != rows["samples=16"]["psnr"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "data", "options"),
    [
        ("mesh", '"jet_flame_iso" = ["middle"]', {}),
        ("sz3", '"vortices@48" = ["cores"]', {"error_bound": 1e-4}),
    ],
    ids=["mesh", "sz3"],
)
def test_means_over_pixels_come_nearer_to_a_truth_of_means(tmp_path, method, data, options):
    """One fit, two rows with a speed each, at least 8 dB apart, the second within 12 dB of the floor."""
    size = "train_views = 12\ntest_views = 4\nwidth = 64\nheight = 64\nprerendered_limit = 64"
    variants = f"variants = [{{}}, {{ {method} = {{ samples = 16 }} }}]"
    suite = suite_file(tmp_path, f"{data}\n[presets.quick]\n{size}", variants)
    runs = api.run(suite, out=tmp_path / "runs", methods=[method], options={method: options}, quiet=True)
    rows = [row for _, row in runs.results.iterrows()]
    assert len(rows) == 2
    assert runs.tables["superseded"].empty
    one, means = sorted(rows, key=lambda row: "samples=16" in row["variant"])
    assert means["psnr"] - one["psnr"] >= 8.0
    assert means["floor"] - means["psnr"] <= 12.0
    assert one["size_bytes"] == means["size_bytes"]
    assert min(one["fps"], means["fps"]) > 0.0
    assert one["fps"] != means["fps"]
    assert sum(record.job.kind == "fit" for record in Store(runs.path).records()) == 1
