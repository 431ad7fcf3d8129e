"""Forged bundles: what contradicts itself is refused by name, and what is honest holds.

The honest bundle is a committed one of two methods on a rendered scene. A forger has the program: records are
changed, sealed and bundled again, so that checksums, hashes and tables follow from them.
"""

from __future__ import annotations

import json
import math
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from econgs_bench.bench.metrics.image import Pair, psnr, ssim
from econgs_bench.bench.results.bundle import MANIFEST, verdict, verify_bundle, write_bundle, zip_of
from econgs_bench.bench.results.verification import LEAST_ITERATION_SECONDS, least_ssim
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.seals import sealed, unsealed

HONEST = Path(__file__).resolve().parents[2] / "reports" / "measured" / "speed" / "gpu-probe.zip.xz"
VIEWS = 24
VALUES = 3 * 800 * 800


@pytest.fixture
def store(tmp_path):
    folder = tmp_path / "store"
    with zip_of(HONEST) as archive:
        archive.extractall(folder)
    (folder / MANIFEST).unlink()
    return folder


def record_file(store, kind, method):
    """The record of a job, by its kind and method."""
    for file in sorted(store.glob(f"jobs/{kind}-*/record.json")):
        if json.loads(unsealed(file.read_text()))["job"]["method"] == method:
            return file
    raise LookupError(kind)


def change(store, kind, edit, method="3dgs"):
    """Edit a record, and seal it."""
    file = record_file(store, kind, None if kind == "views" else method)
    record = json.loads(unsealed(file.read_text()))
    edit(record)
    file.write_text(sealed(json.dumps(record)))
    return file.parent.name


def problems_of(store):
    """What does not hold in the bundle of a store, and what is noted."""
    path = store.parent / "forged.zip"
    write_bundle(Store(store), path)
    return verdict(path)


def test_the_honest_bundle_holds(store):
    assert verify_bundle(HONEST) == []
    assert problems_of(store).problems == []
    assert problems_of(store).notes == []


def renewed_means(record):
    measure = record["measure"]
    for name in measure["metrics"]:
        values = [view["metrics"][name] for view in measure["views"]]
        measure["metrics"][name] = None if None in values else math.fsum(values) / len(values)


def mean_alone(record):
    record["measure"]["metrics"]["psnr"] += 5.0


def no_mean(record):
    record["measure"]["metrics"]["flip"] = None


def mean_of_nothing(record):
    record["measure"]["metrics"]["lpips_vgg"] = 0.1
    del record["measure"]["missing"]["lpips_vgg"]


def reason_alone(record):
    record["measure"]["missing"]["psnr"] = "too good"


def absent_metric(record):
    for one in (record["measure"], *record["measure"]["views"]):
        del one["metrics"]["flip"]


def metric_of_a_view_alone(record):
    record["measure"]["views"][0]["metrics"]["beauty"] = 1.0


def five_decibels(record):
    for view in record["measure"]["views"]:
        view["metrics"]["psnr"] += 5.0
    renewed_means(record)


def best_views(record):
    views = sorted(record["measure"]["views"], key=lambda view: -view["metrics"]["psnr"])[:3]
    job = record["job"]
    for index, view in enumerate(views):
        view["render_file"] = f"jobs/{job['kind']}-{job['key']}/renders/{index:04d}.png"
    record["measure"]["views"] = views
    renewed_means(record)


def view_twice(record):
    views = record["measure"]["views"]
    views[1] = {**views[0], "truth_file": views[1]["truth_file"], "render_file": views[1]["render_file"]}
    renewed_means(record)


def other_truth(record):
    view = record["measure"]["views"][3]
    view["truth_file"] = view["truth_file"].replace("0003", "0099")


def other_request(record):
    record["job"]["request"]["width"] = 400


def psnr_of(squares):
    """PSNR of pictures of 800 x 800 with a sum of squared differences."""
    return 10.0 * math.log10(255.0**2 * VALUES / squares)


def impossible_ssim(record):
    for view in record["measure"]["views"]:
        view["metrics"].update(psnr=psnr_of(16), ssim=0.2)
    renewed_means(record)


def identical_but_not_best(record):
    record["measure"]["views"][0]["identical"] = True


def identical_but_for_ssim(record):
    view = record["measure"]["views"][0]
    view["identical"] = True
    view["metrics"].update(psnr=100.0, psnr_fg=100.0, flip=0.0, delta_e_uv=0.0)
    renewed_means(record)


def out_of_bounds(record):
    record["measure"]["views"][0]["metrics"]["flip"] = 1.5
    renewed_means(record)


def ten_times_the_frames(record):
    measure = record["measure"]
    for name in ("frame_seconds", "frame_seconds_p05", "frame_seconds_p95"):
        measure[name] /= 10.0
    measure["timing"]["frame"] = measure["frame_seconds"]


def frames_without_time(record):
    record["measure"]["frames"] = 500_000


def percentiles_out_of_order(record):
    record["measure"]["frame_seconds_p05"] = 2.0 * record["measure"]["frame_seconds"]


def other_frame(record):
    record["measure"]["timing"]["frame"] /= 2.0


def tenth_of_the_bytes(record):
    record["encode"]["total_bytes"] //= 10


def negative_bytes(record):
    parts = record["encode"]["ledger"]["cores"]
    parts["header"] -= 10_000
    record["encode"]["total_bytes"] -= 10_000


def bytes_of_another_scene(record):
    record["encode"]["ledger"]["rims"] = {"positions": 0}


def no_time_to_fit(record):
    record["fit"]["seconds"] = 0.01


def no_time_in_all_clocks(record):
    fit = record["fit"]
    share = 0.01 / fit["seconds"]
    fit["seconds"] *= share
    fit["cpu_seconds"] *= share
    for point in fit["curve"]:
        point["train_seconds"] *= share


def longer_than_the_job(record):
    record["fit"]["seconds"] = 2.0 * record["wall_seconds"]


def curve_that_turns_back(record):
    curve = record["fit"]["curve"]
    curve[3]["train_seconds"] = 0.5 * curve[1]["train_seconds"]


def other_iterations(record):
    record["fit"]["iterations"] //= 2


def idle_cores(record):
    record["fit"]["seconds"] *= 0.5
    record["fit"]["curve"] = []
    record["fit"]["cpu_seconds"] = 16.0 * 128.0 * record["fit"]["seconds"]


def other_processor(record):
    record["provenance"]["cpu"] = "AMD EPYC"


def ends_before_it_starts(record):
    record["started"], record["finished"] = record["finished"], record["started"]


def longer_than_the_clock(record):
    record["wall_seconds"] *= 3.0


def starts_amid_the_fit(record):
    record["started"] = "2026-11-27T19:25:00.000+00:00"


def local_time(record):
    record["started"] = record["started"].removesuffix("+00:00")


def no_machine(record):
    record["provenance"] = None


def no_result(record):
    record["fit"] = None


def failed(record):
    record["status"] = "failed"


@pytest.mark.parametrize(
    ("kind", "forge", "words"),
    [
        ("measure", mean_alone, f"psnr is 33.0418536, but the mean of its {VIEWS} views is 28.0418536"),
        ("measure", no_mean, f"flip is None, but 0 of {VIEWS} views lack it"),
        ("measure", mean_of_nothing, f"lpips_vgg is 0.1, but {VIEWS} of {VIEWS} views lack it"),
        ("measure", reason_alone, "psnr is 28.041853599543586, with a reason"),
        ("measure", absent_metric, "flip was asked for and is not there"),
        ("measure", metric_of_a_view_alone, "view test_000 has other metrics than the mean"),
        ("measure", five_decibels, f"no two 8-bit pictures of {VALUES} values have a psnr of 33.0505"),
        ("measure", best_views, f"has 3 views, and its truth {VIEWS}"),
        ("measure", best_views, f"has 3 views, and {VIEWS} were asked for"),
        ("measure", view_twice, f"{VIEWS} views have {VIEWS - 1} names"),
        ("measure", other_truth, "/truth/0099.png"),
        ("measure", other_request, "asks for other views than views-"),
        ("measure", impossible_ssim, "ssim is 0.2, and 0.999999 or more with a psnr of 98.9"),
        ("measure", identical_but_not_best, "is identical with its truth, but psnr is 28.0505"),
        ("measure", identical_but_for_ssim, "is identical with its truth, but ssim is 0.935845"),
        ("measure", out_of_bounds, "flip is 1.5, and it lies between 0 and 1"),
        ("measure", ten_times_the_frames, "312 frames of 0.000"),
        ("measure", frames_without_time, "500000 frames take "),
        ("measure", percentiles_out_of_order, "(5th percentile), 0.00319006 s (median)"),
        ("measure", other_frame, "a frame takes 0.00319006 s, but 0.0015950"),
        ("encode", tenth_of_the_bytes, "179801 bytes of model, but 1798016 in the ledger"),
        ("encode", negative_bytes, "has negative bytes in the ledger"),
        ("encode", bytes_of_another_scene, "has scenes in the ledger that it does not hold: rims"),
        ("fit", no_time_to_fit, "1500 iterations in 0.01 s, 0.15 s or more on any machine"),
        ("fit", no_time_in_all_clocks, "1500 iterations in 0.01 s, 0.15 s or more on any machine"),
        ("fit", no_time_to_fit, "the fit at 1500 and 0.01 s"),
        ("fit", longer_than_the_job, "fit.seconds is 113.874 s of a job of 56.9372 s"),
        ("fit", curve_that_turns_back, "its curve goes from iteration "),
        ("fit", other_iterations, "ran 750 iterations of 1500"),
        ("fit", idle_cores, "s of processor time in 25.7752 s of "),
        ("encode", other_processor, "has the cpu 'AMD EPYC', but fit-"),
        ("fit", ends_before_it_starts, "before it started at"),
        ("fit", longer_than_the_clock, "took 170.812 s, but 56.937 s lie between its start and its end"),
        ("encode", starts_amid_the_fit, "started at 2026-11-27T19:25:00.000+00:00, amid fit-"),
        ("fit", local_time, "no times"),
        ("fit", no_machine, "is a success without a machine"),
        ("fit", no_result, "is a success without a fit"),
        ("fit", failed, "which ended as failed"),
    ],
)  # fmt: skip
def test_what_contradicts_itself_is_refused_by_name(store, kind, forge, words):
    name = change(store, kind, forge)
    problems = problems_of(store).problems
    assert any(words in problem for problem in problems), problems
    assert not [problem for problem in problems if problem.startswith("tables/")]
    if forge is not failed:  # that is noticed in the jobs after it
        assert any(problem.startswith(f"{name}: ") for problem in problems)


def test_views_left_out_of_the_truth_too_are_fewer_than_were_asked_for(store):
    change(store, "measure", best_views)
    kept = json.loads(unsealed(record_file(store, "measure", "3dgs").read_text()))["measure"]["views"]

    def shorter(record):
        record["views"]["truth"]["test"] = [Path(view["truth_file"]).name for view in kept]

    change(store, "views", shorter)
    problems = problems_of(store).problems
    assert any(f"has 3 views, and {VIEWS} were asked for" in problem for problem in problems)


def test_without_the_views_job_measurements_of_its_views_are_compared_with_each_other(store):
    change(store, "measure", best_views)
    folder = record_file(store, "views", None).parent
    (folder / "record.json").unlink()
    folder.rmdir()
    found = problems_of(store)
    assert any(f"has 3 views, and its truth {VIEWS}" in p or "its truth 3" in p for p in found.problems)
    assert found.notes == [
        "2 fit jobs need views jobs that are not in the bundle: what both say is not compared",
        "2 measure jobs need views jobs that are not in the bundle: what both say is not compared",
        "1 partition jobs need views jobs that are not in the bundle: what both say is not compared",
    ]


def test_a_fit_that_was_resumed_may_exceed_its_last_attempt(store):
    def resumed(record):
        record["fit"]["resumed"] = 1
        record["wall_seconds"] = 20.0

    change(store, "fit", resumed)
    assert problems_of(store).problems == []


def test_a_machine_may_sleep_and_a_job_may_run_again(store):
    def asleep(record):
        record["wall_seconds"] -= 5.0
        record["fit"]["seconds"] -= 5.0
        record["fit"]["curve"] = []

    def again(record):
        record["started"] = "2026-11-28T19:00:00.000+00:00"
        record["finished"] = "2026-11-28T19:01:00.000+00:00"

    change(store, "fit", asleep)
    change(store, "views", again)
    assert problems_of(store).problems == []


def test_plugins_may_iterate_as_quickly_as_they_like(store):
    def other_method(record):
        record["job"]["method"] = "mine"
        no_time_in_all_clocks(record)

    change(store, "fit", other_method)
    assert not [line for line in problems_of(store).problems if "on any machine" in line]
    assert LEAST_ITERATION_SECONDS * 1500 > 0.01


def test_a_record_without_checksum_is_one_of_an_early_program(store):
    file = record_file(store, "fit", "3dgs")
    file.write_text(unsealed(file.read_text()))
    assert problems_of(store).problems == [
        f"{file.parent.name}: has no checksum, and ran when all records had one"
    ]
    record = json.loads(file.read_text())
    record["started"] = record["started"].replace("11-27", "11-25")
    record["finished"] = record["finished"].replace("11-27", "11-25")
    file.write_text(json.dumps(record))
    assert problems_of(store).problems == []


def test_environments_are_those_of_the_records(store, tmp_path):
    path, out = tmp_path / "honest.zip", tmp_path / "forged.zip"
    write_bundle(Store(store), path)
    with zipfile.ZipFile(path) as archive, zipfile.ZipFile(out, "w") as forged:
        for name in archive.namelist():
            text = archive.read(name)
            if name == MANIFEST:
                manifest = json.loads(text)
                manifest["environments"][0]["cpu"] = "Quantum"
                text = json.dumps(manifest).encode()
            forged.writestr(name, text)
    assert verify_bundle(out) == [f"{MANIFEST}: its environments are not those of the records"]


def test_one_step_in_a_large_picture_is_capped_and_not_identical(store):
    def one_step(record):
        for view in record["measure"]["views"]:
            view["metrics"].update(psnr=min(100.0, psnr_of(1)), ssim=1.0)
        renewed_means(record)

    assert psnr_of(1) > 100.0
    change(store, "measure", one_step)
    assert problems_of(store).problems == []


# ------------------------------------------------------------------------------- the least SSIM


def pair(truth, render):
    eight = [np.rint(np.clip(one, 0.0, 1.0) * 255.0).astype(np.uint8) for one in (truth, render)]
    return Pair(eight[0], eight[1], None)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    width=st.integers(11, 40),
    height=st.integers(11, 40),
    kind=st.sampled_from(["noise", "shift", "spots", "flat", "waves", "checks"]),
    strength=st.floats(0.002, 1.0),
    dark=st.booleans(),
)
def test_no_pair_of_pictures_has_less_ssim_than_its_psnr_allows(seed, width, height, kind, strength, dark):
    rng = np.random.default_rng(seed)
    shape = (height, width, 3)
    truth = np.zeros(shape) if dark else rng.random(shape) ** 2
    y, x = np.mgrid[:height, :width]
    change_of = {
        "noise": rng.normal(size=shape),
        "shift": np.ones(shape),
        "spots": (rng.random(shape) < 0.02) * rng.normal(size=shape) * 4.0,
        "flat": 0.5 - truth,
        "waves": np.sin(0.7 * x + 0.3 * y)[..., None] * np.ones(3),
        "checks": np.where((x + y) % 2, 1.0, -1.0)[..., None] * np.ones(3),
    }
    both = pair(truth, truth + strength * change_of[kind])
    assert ssim(both) >= least_ssim(psnr(both), width, height) - 1e-9


@pytest.mark.parametrize("step", [1, 3])
def test_a_flat_difference_of_black_pictures_nearly_has_the_least_ssim(step):
    """SSIM of 0 and d is C1 / (d² + C1), and the bound's windows are fewer than its pixels."""
    both = pair(np.zeros((256, 256, 3)), np.full((256, 256, 3), step / 255.0))
    energy = (step / 255.0) ** 2
    assert ssim(both) == pytest.approx(1e-4 / (energy + 1e-4), rel=1e-6)
    least = least_ssim(psnr(both), 256, 256)
    assert ssim(both) - 0.05 < least <= ssim(both)


def test_small_pictures_have_no_ssim_and_no_bound():
    assert least_ssim(99.0, 10, 400) == -1.0
    assert least_ssim(0.0, 400, 400) == -1.0
