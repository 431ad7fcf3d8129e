"""A scene in other units is the same scene: fits of powers of two apart are equal, others as good."""

from __future__ import annotations

import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.units import camera_in_units, cloud_in_units, scene_in_units, views_in_units
from econgs_bench.econgs.splat import LINEAGE
from econgs_bench.methods.contract.checks import Subject
from econgs_bench.methods.contract.scene import cameras, tiny_scene
from econgs_bench.methods.interface import OptionValue, Refused, SceneInput
from econgs_bench.methods.registry import Registry, load_method
from econgs_bench.methods.shared.rendering import FILE
from econgs_bench.methods.shared.splatting import PUBLISHED
from econgs_bench.methods.shared.units import units_of
from tests.methods.conftest import Fits, Recorder

NAMES = ("3dgs", "vq-3dgs", "scaffold-gs", "hac", "ivr-gs", "econgs")


def scene_in(scene: SceneInput, units: float) -> SceneInput:
    return replace(
        scene,
        scene=scene_in_units(scene.scene, units),
        train=views_in_units(scene.train, units),
        validation=views_in_units(scene.validation, units),
        cloud=cloud_in_units(scene.cloud, units),
        extent=units * scene.extent,
    )


def pictures(model, units: float) -> np.ndarray:
    return np.stack([model.render(camera_in_units(one, units))[0].numpy() for one in cameras(2, phase=0.5)])


@pytest.mark.parametrize("name", NAMES)
def test_a_fit_does_not_depend_on_scene_units(name: str, tmp_path: Path) -> None:
    spec = Registry().spec(name)
    subject = Subject(spec, load_method(spec), tmp_path, 24)
    usual = subject.fit([subject.tiny("one")])
    expected = pictures(usual, 1.0)
    for units in (1.0 / 1024.0, 1024.0):
        model = subject.fit([scene_in(subject.tiny("one"), units)])
        assert model.rendering.units == units
        assert (pictures(model, units) == expected).all()
        folder, ledger = subject.saved(model, f"in{units}")
        assert ledger[""]["rendering"] == (folder / FILE).stat().st_size
        loaded = subject.method.load(folder, "cpu")
        assert (
            pictures(loaded, units)
            == pictures(subject.method.load(subject.saved(usual, f"as{units}")[0], "cpu"), 1.0)
        ).all()
        assert (pictures(subject.method.compose([loaded]), units) == pictures(loaded, units)).all()
        with pytest.raises(Refused, match="units"):
            subject.method.compose([loaded, usual])


def test_checkpoints_hold_the_units(tmp_path: Path) -> None:
    spec = Registry().spec("3dgs")
    subject = Subject(spec, load_method(spec), tmp_path, 8)
    kept = []

    class Keeps:
        def due(self, iteration):
            return iteration == 8

        def pause(self, iteration, model, checkpoint):
            kept.append((model(), checkpoint()))

        def progress(self, iteration, losses, primitives): ...

        def stage(self, name): ...

    subject.fit([scene_in(subject.tiny("one"), 64.0)], Keeps())
    ((paused, checkpoint),) = kept
    assert (pictures(subject.restore(checkpoint), 64.0) == pictures(paused, 64.0)).all()


@pytest.mark.parametrize(
    ("extent", "units"),
    [
        (4.0, 1.0),
        (1.0, 1.0),
        (16.0, 1.0),
        (0.99, 0.25),
        (17.0, 4.0),
        (4000.0, 1024.0),
        (0.004, 1 / 1024),
        (0.0, 1.0),
    ],
)
def test_units_bring_scenes_to_a_usual_size(extent: float, units: float, tmp_path: Path) -> None:
    spec = Registry().spec("3dgs")
    scene = Subject(spec, load_method(spec), tmp_path, 8).tiny("one")
    assert units_of([replace(scene, extent=extent)]) == units


def test_a_damaged_file_is_an_error(tmp_path: Path) -> None:
    spec = Registry().spec("3dgs")
    subject = Subject(spec, load_method(spec), tmp_path, 2)
    folder, _ = subject.saved(subject.fit([scene_in(subject.tiny("one"), 64.0)]), "model")
    for content in (
        "units=nan",
        "units=-1",
        "low_pass=0",
        "compensated=2",
        "smoothing=-1",
        "ray_power=1.5",
        "ray_power=[]",
        "low_pass=[]",
        "x",
        "a=1",
    ):
        (folder / FILE).write_text(f"{content}\ncrc32={zlib.crc32(content.encode())}")
        with pytest.raises(DataError, match=FILE) as error:
            subject.method.load(folder, "cpu")
        assert "checksum" not in str(error.value)
    for content in ("", "units=2.0", "units=2.0\ncrc32=1"):
        (folder / FILE).write_text(content)
        with pytest.raises(DataError, match="checksum"):
            subject.method.load(folder, "cpu")


@pytest.mark.parametrize("name", NAMES)
def test_a_fit_draws_several_points_of_a_pixel_from_half_of_its_budget_on(name: str) -> None:
    scene, losses = tiny_scene("tiny"), {}
    for side in (1, 2):
        recorder = Recorder()
        Fits(name)(scene, recorder, 12, supersampling=side)
        losses[side] = recorder.losses
    assert losses[1][:5] == losses[2][:5]
    assert losses[1][6:] != losses[2][6:]


@pytest.mark.parametrize("name", NAMES)
def test_a_model_is_drawn_with_the_filter_of_its_fit(name: str, tmp_path: Path) -> None:
    spec = Registry().spec(name)
    subject = Subject(spec, load_method(spec), tmp_path, 16)
    lineage = {name: PUBLISHED[name] for name in ("low_pass", "antialiased", "smoothing", "ray_power")}
    lineage["supersampling"] = PUBLISHED["supersampling"]
    usual = subject.fit(**lineage)
    assert usual.rendering.low_pass == LINEAGE
    every: list[dict[str, OptionValue]] = [{"low_pass": 0.05}, {"antialiased": True}, {"smoothing": 0.5}]
    for changed in (*every, {"ray_power": 1.0}, {"supersampling": 2}):
        model = subject.fit(**lineage | changed)
        low_pass = model.rendering.low_pass
        assert low_pass.variance == changed.get("low_pass", 0.3)
        assert low_pass.compensated == changed.get("antialiased", False)
        assert (low_pass.smoothing > 0.0) == ("smoothing" in changed)
        assert low_pass.ray_power == changed.get("ray_power", 0.0)
        assert low_pass.points == changed.get("supersampling", 1)
        assert (pictures(model, 1.0) != pictures(usual, 1.0)).any()
        folder, _ = subject.saved(model, f"with {next(iter(changed))}")
        loaded = subject.method.load(folder, "cpu")
        assert loaded.rendering == model.rendering
        own = pictures(loaded, 1.0)
        loaded = loaded.drawn_by(usual.rendering)
        assert (pictures(loaded, 1.0) != own).any()
        with pytest.raises(Refused, match="filter"):
            subject.method.compose([model, usual])
