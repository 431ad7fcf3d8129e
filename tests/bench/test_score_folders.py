import numpy as np
import pytest
from PIL import Image

from econgs_bench.bench.metrics import METRICS, evaluate
from econgs_bench.bench.metrics.folders import score
from econgs_bench.bench.metrics.lpips import load
from econgs_bench.datasets.errors import DataError


@pytest.fixture
def folders(tmp_path):
    made = tmp_path / "renders", tmp_path / "truth"
    for folder in made:
        folder.mkdir()
    return made


def save(path, seed, mode="RGBA", size=(24, 20)):
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 256, (size[1], size[0], len(mode)), dtype=np.uint8)
    Image.fromarray(pixels).save(path)
    return pixels


def test_numbers_are_those_of_evaluate_on_the_same_pictures(folders):
    renders, truth = folders
    a, b = save(renders / "v.png", 0), save(truth / "v.png", 1)
    table = score(renders, truth, (1.0, 1.0, 1.0))
    straight = [v.astype(np.float32) / 255 for v in (a, b)]
    rgba = [np.concatenate([s[..., :3] * s[..., 3:], s[..., 3:]], -1) for s in straight]
    rgb = rgba[0][..., :3] + (1 - rgba[0][..., 3:])
    expected = evaluate(rgba[1], rgb, rgba[0][..., 3], (1, 1, 1)).values
    for name in METRICS:
        if expected[name] is None:
            assert table[name].isna()[0]
        else:
            assert table[name][0] == pytest.approx(expected[name], abs=1e-6)


def test_last_row_is_the_mean_and_tells_reasons(folders):
    renders, truth = folders
    for i in range(3):
        save(renders / f"{i}.png", i)
        save(truth / f"{i}.png", 10 + i)
    table = score(renders, truth)
    assert list(table["file"]) == ["0.png", "1.png", "2.png", "mean"]
    assert table["psnr"][3] == pytest.approx(table["psnr"][:3].astype(float).mean())
    assert not table["identical"].any()


def test_a_reason_that_all_images_share_is_there_once(folders, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(folders[0]))
    load.cache_clear()
    renders, truth = folders
    for folder in folders:
        save(folder / "a.png", 0, "RGBA", (40, 36))
        save(folder / "b.png", 0, "RGB", (40, 36))
    alone, *_, last = score(renders, truth)["reason"][[1, 0, 2]]
    assert alone.startswith("psnr_fg: the images have no alpha")
    assert "lpips" not in alone
    assert last.count("bench fetch lpips") == 1
    assert "lpips_vgg, lpips_vgg01, lpips_alex: no backbone weights" in last
    assert "psnr_fg: the images have no alpha" in last
    load.cache_clear()


def test_background_shows_through_alpha(folders):
    renders, truth = folders
    Image.new("RGBA", (16, 16), (0, 0, 0, 0)).save(renders / "a.png")
    Image.new("RGB", (16, 16), (255, 0, 0)).save(truth / "a.png")
    assert score(renders, truth, (1, 0, 0))["identical"][0]
    assert not score(renders, truth, (1, 1, 1))["identical"][0]


def test_pictures_without_alpha_have_no_foreground(folders):
    renders, truth = folders
    for folder in folders:
        save(folder / "a.png", 0, "RGB")
    table = score(renders, truth)
    assert table["psnr"][0] == 100.0
    assert table["identical"][0]
    assert table["psnr_fg"].isna().all()
    assert "psnr_fg: the images have no alpha" in table["reason"][1]


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda r, t: save(r / "b.png", 0), "partner"),
        (lambda r, t: save(t / "b.png", 0), "partner"),
        (lambda r, t: save(r / "a.png", 0, size=(8, 9)), "8x9 pixels"),
        (lambda r, t: (r / "a.png").write_bytes(b"\x89PNG broken"), "cannot be read"),
        (lambda r, t: (r / "a.png").write_bytes((r / "a.png").read_bytes()[:200]), "cannot be read"),
        (lambda r, t: Image.new("I;16", (24, 20)).save(r / "a.png"), "16 bits a channel"),
        (lambda r, t: (r / "a.png").rename(r / "a.txt"), "no images"),
        (lambda r, t: save(r / "a.bmp", 0, "RGB"), "same name"),
    ],
)
def test_bad_folders_are_refused_by_name(folders, spoil, told):
    renders, truth = folders
    for folder in folders:
        save(folder / "a.png", 0)
    spoil(renders, truth)
    with pytest.raises(DataError, match=told):
        score(renders, truth)


def test_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(DataError, match="no folder"):
        score(tmp_path / "none", tmp_path)
