"""Bytes of a classified volume without loss."""

import lzma

import numpy as np
import pytest

from econgs_bench.bench.jobs import complexity
from econgs_bench.datasets.transfer import Bump, TransferFunction
from econgs_bench.datasets.volume import Volume
from tests.bench.conftest import plan, suite_file

HALF = TransferFunction("half", (Bump("b", 0.4, 0.5, 1.0, 1.0, (1.0, 0.2, 0.0), 0.6),))


def volume(values, mask=None):
    return Volume("v", np.asarray(values, np.float32), (1.0, 1.0, 1.0), (0.0, 1.0), "test", mask=mask)


def test_voxels_have_the_color_and_opacity_of_the_transfer_function():
    """At 0.45 the bump has half of its opacity; what it does not show has no color."""
    shown = complexity.classified(np.array([0.0, 0.45, 0.5, 1.0], np.float32), HALF)
    assert shown.tolist() == [[0, 0, 0, 0], [255, 51, 0, 76], [255, 51, 0, 153], [255, 51, 0, 153]]


@pytest.mark.parametrize("masked", [False, True])
def test_bytes_are_those_of_the_colors_that_the_coder_gives_back(masked):
    values = np.random.default_rng(0).random((5, 6, 7))
    mask = values > 0.7 if masked else None
    count = complexity.coded_bytes(volume(values, mask), HALF)
    expected = np.array([complexity.classified(plane.astype(np.float32), HALF) for plane in values])
    if mask is not None:
        expected[~mask] = 0
    filters = [{"id": lzma.FILTER_DELTA, "dist": 4}, {"id": lzma.FILTER_LZMA2, "preset": 6}]
    data = lzma.compress(expected.tobytes(), lzma.FORMAT_RAW, filters=filters)
    assert count == len(data)


def test_what_is_there_costs_bytes_and_what_is_not_seen_costs_none():
    empty, noise = np.zeros((16, 16, 16)), np.random.default_rng(0).random((16, 16, 16))
    nothing = complexity.coded_bytes(volume(empty), HALF)
    assert complexity.coded_bytes(volume(0.39 * noise), HALF) == nothing < 100
    ball = np.where(noise > 0.9, 1.0, 0.0)
    assert nothing < complexity.coded_bytes(volume(ball), HALF) < complexity.coded_bytes(volume(noise), HALF)


def test_a_suite_asks_for_it_and_it_is_the_same_at_any_preset(tmp_path):
    name = '"argon_bubble_like@32" = []'
    sizes = "test_views = 4\nheight = 16\nprerendered_limit = 16\nwidth = 16"
    jobs = {
        views: plan(suite_file(tmp_path, f"{name}\n[presets.quick]\ntrain_views = {views}\n{sizes}", asks))
        for views, asks in ((6, "parsimony = true"), (12, "parsimony = true"), (42, ""))
    }
    keys = {views: {job.id for job in own if job.kind == "complexity"} for views, own in jobs.items()}
    assert keys[6] == keys[12] != keys[42] == set()
    assert {job.prunable for job in jobs[6] if job.kind == "measure"} == {True}
    assert {job.prunable for job in jobs[42] if job.kind == "measure"} == {False}


def test_models_of_other_rates_are_not_asked_what_could_go(tmp_path):
    path = tmp_path / "rates.toml"
    path.write_text(
        'title = "t"\nmethods = ["hac", "ivr-gs"]\npreset = "quick"\nrates = "all"\nparsimony = true\n'
        '[datasets]\n"argon_bubble_like@32" = []\n'
    )
    measures = [job for job in plan(str(path)) if job.kind == "measure"]
    asked = {(job.scenes, job.method) for job in measures if job.prunable}
    assert len(asked) == sum(job.prunable for job in measures) < len(measures)
    assert asked == {(job.scenes, job.method) for job in measures}
