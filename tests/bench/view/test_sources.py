"""What `bench view` takes for the truth of a model, and why it refuses a folder."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from econgs_bench.bench.store.store import Store
from econgs_bench.bench.view.server import Server, Viewer
from econgs_bench.bench.view.sources import Marched, Stored, found, of_job
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.content import fingerprint
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.png import write_png
from econgs_bench.methods.gaussian_splatting.model import GaussianModel
from tests.bench.conftest import PLUGINS, Bench
from tests.bench.view.conftest import CAMERAS, Flat, harmonic, source


def test_the_truth_of_a_model_is_what_it_learned(entry: Path, tmp_path: Path) -> None:
    path = shutil.copytree(entry.parent, tmp_path / "own") / "ball.toml"
    text = path.read_text().replace("opacity = 0.3", "opacity = 0.9")

    def written(color: str, name: str = "ball") -> None:
        path.write_text(text.replace("[0.8, 0.2, 0.1]", color).replace('"ball"', f'"{name}"'))

    written("[1.0, 0.0, 0.0]")
    dataset = open_dataset(str(path))
    learned = {"ball": (dataset.scene("ball"), fingerprint(dataset, "ball"))}
    camera = CAMERAS[0].resized(24, 24)

    def drawn(**more) -> np.ndarray:
        return Marched(str(path), samples=1, **more).draw(camera, ["ball"], {}, None)

    first = drawn()
    assert first[..., 0].max() > 0.3
    written("[0.0, 0.0, 1.0]")
    assert not np.allclose(drawn(), first, atol=0.1)
    np.testing.assert_allclose(drawn(learned=learned), first, atol=1e-6)
    written("[0.0, 0.0, 1.0]", "renamed")
    np.testing.assert_allclose(drawn(learned=learned), first, atol=1e-6)
    (volume,) = (path.parent / "data").iterdir()
    volume.write_bytes(bytes(value // 2 for value in volume.read_bytes()))
    with pytest.raises(DataError, match="not the data any more that the model learned as ball"):
        drawn(learned=learned)


def test_a_stored_view_is_shown_in_its_own_shape_alone() -> None:
    class Views:
        def __init__(self, images: np.ndarray) -> None:
            self.images = images

    class Truth:
        def cameras(self, split: str) -> tuple:
            assert split == "val"
            return (CAMERAS[0].resized(96, 64),)

        def views(self, split: str, which: list[int]) -> Views:
            return Views(np.full((1, 64, 96, 4), 0.5, np.float32))

    stored = Stored("a", Truth(), "val")
    own = Truth().cameras("val")[0]
    for size in ((96, 64), (600, 400), (400, 267)):  # rounded to pixels
        assert stored.draw(own.resized(*size), ["a"], {}, None).shape == (64, 96, 4)
    wider = replace(own, width=128, cx=own.cx + 16)  # what a window shows that is wider
    with pytest.raises(DataError, match="another shape of picture"):
        stored.draw(wider, ["a"], {}, None)


def test_a_model_measured_on_validation_views_is_shown_at_them(bench: Bench) -> None:
    bench.run("--split", "val")
    opened = of_job(Store(bench.store), bench.of_kind("encode")[0].job.id, [str(PLUGINS)], "cpu")
    assert [camera.name for camera in opened.cameras] == ["r_0009"]  # every tenth of training
    assert opened.truth(opened.cameras[0], ["a"], {}, None).shape[-1] == 4


def _refusal(path: Path) -> str:
    with pytest.raises(DataError) as error:
        found([str(path)], path.parent / "runs", (), "cpu")
    return str(error.value)


def test_a_folder_is_refused_for_what_is_wrong_with_it(tmp_path: Path) -> None:
    slices = tmp_path / "slices"
    slices.mkdir()
    write_png(slices / "s0.png", np.zeros((4, 4, 4), np.float32))
    (slices / "s1.png").write_bytes(b"cut")
    assert "s1.png" in _refusal(slices)
    model = tmp_path / "model"
    model.mkdir()
    GaussianModel([harmonic("one").scene("one")]).save(model)
    file = model / "one.ply"
    file.write_bytes(file.read_bytes()[:-7])
    assert file.name in _refusal(model)
    (tmp_path / "none").mkdir()
    assert "Give a job" in _refusal(tmp_path / "none")


def test_pictures_are_no_model(dataset: Path) -> None:
    assert "View a model that was trained on it" in _refusal(dataset)


def test_a_model_without_its_store_keeps_its_background(tmp_path: Path) -> None:
    scene = replace(harmonic("one").scene("one"), background=(0.0, 0.25, 1.0))
    (tmp_path / "model").mkdir()
    GaussianModel([scene]).save(tmp_path / "model")
    (one,) = found([str(tmp_path / "model")], tmp_path, (), "cpu")
    np.testing.assert_allclose(one.open().background, (0.0, 0.25, 1.0), atol=1e-3)


@pytest.mark.parametrize("port", [99999, -1])
def test_a_port_that_is_none_is_named(port: int) -> None:
    with pytest.raises(DataError, match="from 1 to 65535"):
        Server(Viewer([source("flat", Flat())]), port)
