"""``bench export-views``: the views that methods get, never a test picture, and renders scored."""

from __future__ import annotations

import io
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from econgs_bench.bench.__main__ import main
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.png import read_png
from econgs_bench.datasets.posed_images import read_frames
from econgs_bench.datasets.render_views import cameras_of, views_of
from econgs_bench.datasets.views import ViewRequest

FORMATS = ("blender", "colmap", "colmap-text")


def _export(dataset: Path, out: Path, *more: str) -> int:
    arguments = ["--scene", "a", "--views", "6", "--test-views", "3", "--size", "8", "--out", str(out)]
    return main(["export-views", str(dataset), *arguments, *more])


@pytest.mark.parametrize("format", FORMATS)
def test_training_views_and_no_test_picture(dataset: Path, tmp_path: Path, format: str, capsys) -> None:
    assert _export(dataset, tmp_path / "out", "--format", format, "--pictures", "rgba") == 0
    assert "6 training views, 3 test cameras, 20 points" in capsys.readouterr().out
    opened = open_dataset(dataset)
    train = views_of(opened, "a", ViewRequest("trainval", 6, 3, 8, 8))
    pictures = {path: read_png(path) for path in (tmp_path / "out").rglob("*.png")}
    assert len(pictures) == 6 + 3
    for path, picture in pictures.items():
        if "test_cameras" in path.parts:
            assert not picture.any()
        else:
            np.testing.assert_allclose(picture, train.images[int(path.stem)], rtol=0, atol=1.01 / 255)
    if format == "blender":
        frames = read_frames(tmp_path / "out" / "a" / "test_cameras", "test")
        wanted = cameras_of(opened, "a", ViewRequest("test", 6, 3, 8, 8))
        for (camera, _), other in zip(frames, wanted, strict=True):
            np.testing.assert_allclose(camera.camera_to_world, other.camera_to_world, rtol=0, atol=1e-6)
    assert not list((tmp_path / "out").glob(".*"))


def test_renders_of_another_program_are_scored(dataset: Path, tmp_path: Path, capsys) -> None:
    arguments = ["--scene", "a", "--views", "3", "--size", "8"]
    assert main(["render", str(dataset), *arguments, "--out", str(tmp_path / "truth")]) == 0
    (truth,) = (tmp_path / "truth").glob("*/a")
    renders = shutil.copytree(truth, tmp_path / "renders")
    capsys.readouterr()
    for background in ("#ffffff", "#000000"):
        command = ["score", str(renders), str(truth), "--background", background]
        assert main(command) == 0
        table = pd.read_csv(io.StringIO(capsys.readouterr().out))
        assert list(table["file"]) == ["0000.png", "0001.png", "0002.png", "mean"]
        assert table["identical"].all()
    assert main(["score", str(renders), str(truth), "--background", "red"]) == 2


def test_nothing_is_written_over(dataset: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "out" / "a").mkdir(parents=True)
    (tmp_path / "out" / "a" / "work").write_text("a year")
    assert _export(dataset, tmp_path / "out") == 2
    assert "exists already" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").rglob("*")] == ["a", "work"]


def test_what_cannot_be_is_refused(dataset: Path, tmp_path: Path, capsys) -> None:
    assert main(["export-views", str(dataset), "--scene", "zz", "--out", str(tmp_path)]) == 2
    assert "zz" in capsys.readouterr().err
    assert main(["export-views", "vortices", "--scene", "cores", "--views", "5", "--out", str(tmp_path)]) == 2
    assert not list(tmp_path.iterdir())
