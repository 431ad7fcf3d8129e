import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from econgs_bench.bench.metrics import METRICS, evaluate
from econgs_bench.bench.metrics.image import _FUNCTIONS, Pair, to_8bit
from econgs_bench.datasets.errors import DataError
from econgs_bench.reports.schema import COVERAGE

CHEAP = ["psnr", "psnr_fg", "ssim", "flip", "delta_e_uv"]


def image(seed: int, size: int = 32) -> np.ndarray:
    """Premultiplied RGBA of a soft ball on nothing, with noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:size, 0:size] / size * 2 - 1
    alpha = np.clip(1.4 - 2 * np.hypot(x, y), 0, 1).astype(np.float32)
    rgb = np.clip(rng.random(3) + 0.1 * rng.normal(size=(size, size, 3)), 0, 1)
    return np.concatenate([rgb * alpha[..., None], alpha[..., None]], -1).astype(np.float32)


def over(rgba: np.ndarray) -> np.ndarray:
    return rgba[..., :3] + (1 - rgba[..., 3:])


def values(truth: np.ndarray, render: np.ndarray, *names: str, rgb: np.ndarray | None = None):
    """Metrics of two RGBA pictures on white; ``rgb`` goes before the render's own colors."""
    return evaluate(truth, over(render) if rgb is None else rgb, render[..., 3], (1, 1, 1), names).values


def shown(rgba: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(over(rgba), 0, 1) * 255).astype(np.uint8)


def test_the_registry_imports_nothing_heavy():
    heavy = "('torch', 'numpy', 'skimage', 'PIL')"
    code = f"import econgs_bench.bench.metrics, sys; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=True)
    assert done.stdout.strip() == "[]"


def test_every_registered_metric_has_a_function_and_no_other_has():
    assert set(_FUNCTIONS) == set(METRICS)
    assert all(name == metric.name for name, metric in METRICS.items())


def test_against_scikit_image_flip_and_colour():
    import colour
    import flip_evaluator
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    truth, render = image(0, 48), image(1, 48)
    got = values(truth, render, *CHEAP)
    a, b = shown(truth), shown(render)
    assert got["psnr"] == pytest.approx(peak_signal_noise_ratio(a, b, data_range=255), abs=1e-9)
    expected = structural_similarity(
        a, b, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255
    )
    assert got["ssim"] == pytest.approx(expected, abs=1e-6)
    x, y = (v.astype(np.float32) / 255 for v in (a, b))
    _, expected, used = flip_evaluator.evaluate(x, y, "LDR", applyMagma=False)  # default viewing conditions
    assert used["ppd"] == pytest.approx(67, abs=0.05)
    assert got["flip"] == pytest.approx(expected, abs=1e-4)
    d65 = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]
    luv = [colour.XYZ_to_Luv(colour.sRGB_to_XYZ(v.astype(np.float64)), d65) for v in (x, y)]
    assert got["delta_e_uv"] == pytest.approx(np.linalg.norm(luv[0] - luv[1], axis=-1).mean(), abs=1e-4)


def test_ssim_is_the_definition_of_wang_et_al():
    """Straight from the paper's equation, window by window, in float64."""
    truth, render = image(2, 16), image(3, 16)
    a, b = shown(truth) / 255.0, shown(render) / 255.0
    line = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = np.outer(line, line)[..., None] / line.sum() ** 2
    windows = []
    for i in range(6):
        for j in range(6):
            p, q = a[i : i + 11, j : j + 11], b[i : i + 11, j : j + 11]
            mp, mq = (window * p).sum((0, 1)), (window * q).sum((0, 1))
            vp, vq = (window * p * p).sum((0, 1)) - mp**2, (window * q * q).sum((0, 1)) - mq**2
            c = (window * p * q).sum((0, 1)) - mp * mq
            windows.append(
                (2 * mp * mq + 1e-4) * (2 * c + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4))
            )
    assert values(truth, render, "ssim")["ssim"] == pytest.approx(np.mean(windows), abs=1e-6)


def test_psnr_of_one_level_everywhere_is_48_13_db():
    truth = np.ones((8, 8, 4), np.float32)
    rgb = np.full((8, 8, 3), 254 / 255, np.float32)
    assert values(truth, truth, "psnr", rgb=rgb)["psnr"] == pytest.approx(20 * np.log10(255))


def test_psnr_is_of_8_bit_pictures_and_identical_ones_count_100_db():
    truth = image(4)
    near = over(truth) + np.float32(1e-4) * (np.rint(over(truth) * 255) / 255 - over(truth))
    got = values(truth, truth, *CHEAP, rgb=near)
    assert got["psnr"] == got["psnr_fg"] == 100.0
    assert got["ssim"] == pytest.approx(1.0)
    assert got["flip"] == got["delta_e_uv"] == 0.0


def test_pictures_are_rounded_to_the_nearest_of_256_levels():
    levels = np.arange(256)
    shifts = np.array([-0.49, 0.0, 0.49], np.float32)
    got = to_8bit((levels[:, None] + shifts).astype(np.float32) / np.float32(255))
    np.testing.assert_array_equal(got, np.broadcast_to(levels[:, None], got.shape))
    np.testing.assert_array_equal(to_8bit(np.array([-1.0, 2.0])), [0, 255])


def test_one_step_in_a_large_image_does_not_beat_identical_ones():
    truth = np.ones((400, 400, 4), np.float32)
    rgb = truth[..., :3].copy()
    rgb[0, 0, 0] = 254 / 255
    assert values(truth, truth, "psnr", rgb=rgb)["psnr"] == 100.0


def test_foreground_counts_pixels_of_truth_or_model_only():
    truth = np.zeros((20, 20, 4), np.float32)
    truth[:10, :, 3], alpha = 1.0, np.zeros((20, 20), np.float32)
    alpha[:, :10] = 1 / 255  # the model covers the left half
    rgb = over(truth)
    rgb[:, :10] -= np.float32(0.2) * (rgb[:, :10] > 0.5)
    got = evaluate(truth, rgb, alpha, (1, 1, 1), ["psnr", "psnr_fg"]).values
    a, b = (to_8bit(v).astype(float) for v in (over(truth), rgb))
    inside = (truth[..., 3] > 0) | (alpha > 0)
    assert got["psnr_fg"] == pytest.approx(10 * np.log10(255**2 / ((a - b)[inside] ** 2).mean()))
    assert got["psnr_fg"] < got["psnr"]


def test_what_cannot_be_computed_is_missing_with_a_reason():
    nothing = np.zeros((8, 8, 4), np.float32)
    got = evaluate(nothing, np.ones((8, 8, 3), np.float32), nothing[..., 3], (1, 1, 1), ["psnr_fg", "ssim"])
    assert got.values == {"psnr_fg": None, "ssim": None}
    assert "alpha" in got.reasons["psnr_fg"]
    assert "window" in got.reasons["ssim"]


def test_missing_and_excess_are_shares_of_the_truths_alpha():
    truth = np.zeros((4, 10, 4), np.float32)
    truth[:2, :, 3], alpha = 1.0, np.zeros((4, 10), np.float32)
    alpha[0], alpha[1, :5], alpha[3, 0] = 1.0, 0.6, 0.4  # half a row is not there, half of it too faint
    got = evaluate(truth, over(truth), alpha, (1, 1, 1), COVERAGE).values
    assert got == {"missing": pytest.approx((5 + 5 * 0.4) / 20), "excess": pytest.approx(0.4 / 20)}
    nothing = evaluate(np.zeros_like(truth), over(truth), alpha, (1, 1, 1), COVERAGE)
    assert nothing.values == dict.fromkeys(COVERAGE)
    assert nothing.reasons["missing"] == "the truth shows nothing"


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 10**6))
def test_missing_and_excess_account_for_all_alpha(one: int, two: int):
    a, b = (np.random.default_rng(seed).random((16, 16, 4)).astype(np.float32) for seed in (one, two))
    got, back = values(a, b, *COVERAGE), values(b, a, *COVERAGE)
    there, ours = (to_8bit(rgba[..., 3]).astype(int).sum() for rgba in (a, b))
    assert 1 - got["missing"] + got["excess"] == pytest.approx(ours / there)
    assert got["missing"] * there == pytest.approx(back["excess"] * ours)
    assert values(a, a, *COVERAGE) == dict.fromkeys(COVERAGE, 0.0)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 10**6))
def test_symmetric_and_bounded(one: int, two: int):
    a, b = image(one, 16), image(two, 16)
    forth, back = values(a, b, *CHEAP), values(b, a, *CHEAP)
    for name in CHEAP:
        assert forth[name] == pytest.approx(back[name], rel=1e-4, abs=1e-5)
        low, high = METRICS[name].bounds
        assert low <= forth[name] <= high


def test_more_noise_is_worse_by_every_metric():
    truth = image(5, 48)
    noise = np.random.default_rng(0).normal(size=(48, 48, 3))
    scores = [
        values(truth, truth, *CHEAP, rgb=(over(truth) + s * noise).astype(np.float32))
        for s in (0.02, 0.05, 0.15)
    ]
    for name in CHEAP:
        ladder = [score[name] for score in scores]
        assert ladder == sorted(ladder, reverse=METRICS[name].column.better > 0)


def test_unknown_names_and_bad_shapes_are_refused():
    truth = image(0)
    with pytest.raises(DataError, match="psnr"):
        values(truth, truth, "pnsr")
    with pytest.raises(ValueError, match="does not match"):
        values(truth, truth, "psnr", rgb=over(truth)[1:])
    with pytest.raises(ValueError, match="finite"):
        values(truth, truth, "psnr", rgb=np.full_like(over(truth), np.nan))


def test_pairs_know_when_pictures_are_identical():
    truth = image(0)
    for rgb, identical in ((over(truth), True), (over(truth) * 0.9, False)):
        assert Pair.composite(truth, rgb, truth[..., 3], (1, 1, 1)).identical is identical
