"""`bench render`: the pictures of a folder are of one call, and a truth that is not the model's is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench.conftest import Bench

pytestmark = pytest.mark.usefixtures("inside")


def _render(bench: Bench, out: Path, *more: object, code: int = 0) -> str:
    job = bench.of_kind("encode")[0].job.id
    done = bench(
        "render", bench.dataset, "--scene", "a", "--model", job, "--runs", bench.store,
        "--plugins", bench.plugins, "--size", "8x8", "--out", out, *more, code=code,
    )  # fmt: skip
    return done.stdout + done.stderr


def _files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_pictures_of_two_calls_never_mix(finished: Bench, tmp_path: Path) -> None:
    _render(finished, tmp_path / "out", "--views", 4, "--truth")
    folder = tmp_path / "out" / "tiny" / "a"
    (folder / "notes.png").write_bytes(b"a reader's own")
    _render(finished, tmp_path / "out", "--views", 2)
    assert sorted(_files(folder)) == ["0000.png", "0001.png", "notes.png"]


def test_a_refused_edit_leaves_the_pictures_as_they_were(finished: Bench, tmp_path: Path) -> None:
    _render(finished, tmp_path / "out", "--views", 2)
    before = _files(tmp_path / "out")
    assert "opacity" in _render(finished, tmp_path / "out", "--views", 2, "--edit", "a.opacity=3", code=2)
    assert _files(tmp_path / "out") == before


def test_a_truth_that_the_model_did_not_learn_is_named(finished: Bench, tmp_path: Path) -> None:
    import shutil

    import numpy as np

    from econgs_bench.datasets.png import write_png

    assert "is not what the model learned" not in _render(finished, tmp_path / "out", "--views", 2, "--truth")
    other = tmp_path / "tiny"
    shutil.copytree(finished.dataset, other)
    write_png(next((other / "a" / "train").glob("*.png")), np.zeros((8, 8, 4), np.float32))
    finished.dataset = other
    assert "not what the model learned as a." in _render(finished, tmp_path / "out", "--views", 2, "--truth")
