"""Training clock, anytime evaluations and checkpoints."""

from __future__ import annotations

import itertools
import json
import time

import numpy as np
import pytest

from econgs_bench.bench.jobs.checkpoints import VERSION, Damaged, read_checkpoint, write_checkpoint
from econgs_bench.bench.jobs.measure import _decoding
from econgs_bench.bench.jobs.monitor import FitMonitor, Stop, Stopped
from econgs_bench.bench.machine.timing import AMID_SECONDS, RULERS, median_timings, time_frames
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.camera_paths import look_at_origin
from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.interface import Checkpoint, Diverged


class _Model:
    def primitives(self, scene=None) -> int:
        return 5


def _monitor(tmp_path, iterations=100, every=1e9, **more) -> FitMonitor:
    tmp_path.mkdir(exist_ok=True)
    return FitMonitor(tmp_path / "checkpoint", iterations, {}, lambda **state: None, Stop(), every, **more)


def _drive(monitor: FitMonitor, first: int, last: int, slow_evaluation: float = 0.0) -> None:
    def model() -> _Model:
        time.sleep(slow_evaluation)
        return _Model()

    monitor.start()
    for i in range(first, last + 1):
        monitor.progress(i, {"loss": 1.0 / i}, 3)
        if monitor.due(i):
            monitor.pause(i, model, lambda i=i: Checkpoint(i, {}, {"i": i}))
    monitor.stop()


def test_evaluations_are_log_spaced_and_the_last_iteration_is_stored(tmp_path) -> None:
    monitor = _monitor(tmp_path)
    _drive(monitor, 1, 100)
    at = [point.iteration for point in monitor.curve]
    assert 6 <= len(at) <= 10
    assert at[0] == 2
    assert at[-1] == 100
    ratios = np.diff(np.log(at))
    assert ratios.max() < 2.0 * ratios.mean()
    assert monitor.final
    checkpoint, _ = read_checkpoint(tmp_path / "checkpoint")
    assert (checkpoint.iteration, checkpoint.scalars) == (100, {"i": 100})


def test_the_clock_stands_still_while_it_evaluates(tmp_path) -> None:
    monitor = _monitor(tmp_path, iterations=20)
    start = time.perf_counter()
    _drive(monitor, 1, 20, slow_evaluation=0.05)
    wall = time.perf_counter() - start
    assert len(monitor.curve) >= 6
    assert monitor.seconds <= wall - 0.05 * len(monitor.curve)
    assert monitor.cpu_seconds > 0.0


def test_a_resumed_fit_continues_clock_and_curve(tmp_path) -> None:
    first = _monitor(tmp_path)
    _drive(first, 1, 49)
    first._stop.requested.set()
    with pytest.raises(Stopped):
        _drive(first, 50, 60)
    first.stop()
    second = _monitor(tmp_path)
    checkpoint = second.resume()
    assert checkpoint.iteration == 50
    assert second.resumed == 1
    assert [p.iteration for p in second.curve] == [p.iteration for p in first.curve]
    assert 0.0 < second.seconds <= first.seconds
    assert 0.0 < second.cpu_seconds <= first.cpu_seconds
    _drive(second, 51, 100)
    whole = _monitor(tmp_path / "whole")
    _drive(whole, 1, 100)
    assert [p.iteration for p in second.curve] == [p.iteration for p in whole.curve]


def test_losses_are_means_over_stretches_that_stages_cut(tmp_path) -> None:
    def drive(monitor, first, last):
        for i in range(first, last + 1):
            if i in (1, 101):
                monitor.stage("growth" if i == 1 else "noise")
            monitor.progress(i, {"loss": float(i), **({"rate": 2.0} if i % 2 else {})}, 3)
            if monitor.due(i):
                monitor.pause(i, _Model, lambda i=i: Checkpoint(i, {}, {}))

    monitor = _monitor(tmp_path, iterations=200)
    drive(monitor, 1, 200)
    points = monitor.losses.points
    assert len(points) == 50
    assert [(p.first, p.iteration) for p in points] == [(i, i + 3) for i in range(1, 200, 4)]
    assert points[1].losses == {"loss": 6.5, "rate": 1.0}
    assert [p.stage for p in points] == ["growth"] * 25 + ["noise"] * 25
    uneven = _monitor(tmp_path / "uneven", iterations=400)
    drive(uneven, 1, 103)
    assert [(p.first, p.iteration) for p in uneven.losses.points[-3:]] == [(89, 96), (97, 100), (101, 103)]
    # Stopped within a stretch, it goes on as if it had not been.
    stopped = _monitor(tmp_path / "stopped", iterations=200)
    drive(stopped, 1, 49)
    stopped._stop.requested.set()
    with pytest.raises(Stopped):
        drive(stopped, 50, 50)
    again = _monitor(tmp_path / "stopped", iterations=200)
    again.resume()
    again.stage("growth")
    drive(again, 51, 200)
    assert again.losses.points == points


def test_a_stop_at_the_last_iteration_is_too_late(tmp_path) -> None:
    monitor = _monitor(tmp_path, iterations=5)
    _drive(monitor, 1, 4)
    monitor._stop.requested.set()
    _drive(monitor, 5, 5)
    assert monitor.final


def test_a_loss_that_is_not_finite_diverges(tmp_path) -> None:
    with pytest.raises(Diverged, match="iteration 3: loss = nan"):
        _monitor(tmp_path).progress(3, {"loss": float("nan")}, 1)


def test_checkpoints_keep_every_bit_and_only_the_newest(tmp_path) -> None:
    import torch

    generator = torch.Generator().manual_seed(3)
    arrays = {
        "x": torch.randn(5, 3, generator=generator),
        "half": torch.randn(4, generator=generator).half()[::2],
        "state": generator.get_state(),
        "empty": torch.zeros(0, 3),
        "count": torch.tensor([2**60]),
    }
    for iteration in (1, 2):
        write_checkpoint(tmp_path, Checkpoint(iteration, arrays, {"f": 0.1}), {"seconds": 1.5})
    assert [p.name for p in tmp_path.iterdir()] == ["000000002"]
    checkpoint, harness = read_checkpoint(tmp_path)
    assert checkpoint.scalars == {"f": 0.1}
    assert harness == {"seconds": 1.5}
    for name, array in arrays.items():
        assert checkpoint.arrays[name].dtype == array.dtype
        assert torch.equal(checkpoint.arrays[name], array)


def test_a_half_written_checkpoint_is_not_read(tmp_path) -> None:
    write_checkpoint(tmp_path, Checkpoint(7, {}, {"good": True}), {})
    (tmp_path / ".000000009").mkdir()
    (tmp_path / ".000000009" / "checkpoint.json").write_text("{")
    checkpoint, _ = read_checkpoint(tmp_path)
    assert checkpoint.iteration == 7
    write_checkpoint(tmp_path, Checkpoint(9, {}, {"good": True}), {})
    assert read_checkpoint(tmp_path)[0].iteration == 9


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("checkpoint.json", b"0.25", b"0.75"),
        ("checkpoint.json", b'"iteration": 7', b'"iteration": 8'),
        ("arrays.safetensors", b"\0\0\x80\x3f", b"\0\0\x80\x40"),
        ("arrays.safetensors", None, None),
    ],
)
def test_after_a_damaged_checkpoint_a_fit_begins_anew_and_no_model_is_made_of_it(
    tmp_path, capsys, name, old, new
) -> None:
    import torch

    folder = tmp_path / "checkpoint"
    write_checkpoint(folder, Checkpoint(7, {"a": torch.ones(3)}, {"loss": 0.25}), {})
    (file,) = folder.glob(f"*/{name}")
    if old is None:
        file.unlink()
    else:
        assert old in file.read_bytes()
        file.write_bytes(file.read_bytes().replace(old, new, 1))
    with pytest.raises(Damaged, match=f"{file.parent}: .* damaged .* Delete {tmp_path}, and bench run"):
        read_checkpoint(folder)
    assert _monitor(tmp_path).resume() is None
    assert "the fit begins anew" in capsys.readouterr().out
    assert not folder.exists()


def test_a_checkpoint_from_before_the_checksum_is_read(tmp_path) -> None:
    import torch

    write_checkpoint(tmp_path, Checkpoint(7, {"a": torch.ones(3)}, {}), {"seconds": 1.5})
    (file,) = tmp_path.glob("*/checkpoint.json")
    meta = json.loads(file.read_text())
    del meta["crc32"], meta["arrays"]
    file.write_text(json.dumps(meta))
    checkpoint, harness = read_checkpoint(tmp_path)
    assert (checkpoint.arrays["a"].tolist(), harness) == ([1.0] * 3, {"seconds": 1.5})


@pytest.mark.parametrize("version", [None, VERSION - 1])
def test_a_checkpoint_of_an_earlier_version_is_refused(tmp_path, version) -> None:
    write_checkpoint(tmp_path / "checkpoint", Checkpoint(7, {}, {}), {})
    (file,) = tmp_path.glob("checkpoint/*/checkpoint.json")
    meta = json.loads(file.read_text())
    assert meta.pop("version") == VERSION
    meta.pop("crc32")
    file.write_text(json.dumps(meta if version is None else {**meta, "version": version}))
    with pytest.raises(DataError, match="an earlier version wrote this checkpoint"):
        _monitor(tmp_path).resume()


PATH = [
    Camera.with_fov(look_at_origin(np.array(place)), 0.6, 4, 4, f"r_{number}")
    for number, place in enumerate(((3.0, 0.0, 0.5), (0.0, 2.5, -1.0), (-1.0, -2.0, 2.0), (0.1, 0.1, 4.0)))
]


def _of_path(camera: Camera) -> int:
    """The camera of the path that was turned by at most two degrees, its distance from the origin kept."""
    angles = []
    for one in PATH:
        a, b = camera.position, one.position
        angles.append(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
    nearest = int(np.argmin(angles))
    one = PATH[nearest]
    assert angles[nearest] <= 2.0
    assert np.linalg.norm(camera.position) == pytest.approx(np.linalg.norm(one.position), rel=1e-12)
    rotation = camera.camera_to_world[:3, :3]
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    # The origin, and whatever lies on the axis, is seen where it was.
    for point in (np.zeros(3), 0.3 * one.camera_to_world[:3, 1]):
        seen, before = (c.world_to_camera @ [*point, 1.0] for c in (camera, one))
        assert seen == pytest.approx(before, abs=1e-12)
    assert (camera.fx, camera.cx, camera.width, camera.near) == (one.fx, one.cx, one.width, one.near)
    return nearest


class _Clock:
    """A clock that stands, and a reference kernel whose laps take what they are given."""

    def __init__(self, monkeypatch, laps=(1.0,)) -> None:
        self.time, self.laps = 0.0, itertools.chain(laps, itertools.repeat(laps[-1]))
        self.at: list[float] = []
        monkeypatch.setattr("econgs_bench.bench.machine.timing.time.perf_counter", lambda: self.time)
        monkeypatch.setattr("econgs_bench.bench.machine.timing.lap_seconds", self.lap)

    def lap(self) -> float:
        self.at.append(self.time)
        seconds = next(self.laps)
        self.time += seconds
        return seconds


def test_frame_times_cover_the_whole_path_alike(monkeypatch) -> None:
    clock = _Clock(monkeypatch)
    calls: list[Camera] = []

    def render(camera: Camera) -> None:
        calls.append(camera)
        clock.time += 0.004 if _of_path(camera) == 2 else 0.001

    times = time_frames(render, PATH, "cpu")
    assert times.frames % len(PATH) == 0
    timed = [_of_path(camera) for camera in calls[times.warmup_frames :]]
    counts = [timed.count(index) for index in range(len(PATH))]
    assert all(count >= times.frames // len(PATH) for count in counts)
    untimed = len(timed) - times.frames  # one after each run of the kernel
    assert 0 < untimed == (len(clock.at) - 6) / 2 <= 1.0 / AMID_SECONDS
    assert times.frame_seconds == pytest.approx(0.001)
    assert times.frame_seconds_p95 == pytest.approx(0.004)
    assert times.ruler == RULERS["frame"]


def test_the_kernel_runs_amid_the_frames_and_its_longest_time_is_kept(monkeypatch) -> None:
    """Frames of 30 ms; amid them the machine is busy for one run of the kernel, and one lap of another."""
    clock = _Clock(monkeypatch, [*[1.0, 1.1, 1.0], *[1.0, 5.0], *[2.0, 2.2], 1.0])
    times = time_frames(lambda camera: setattr(clock, "time", clock.time + 0.03), PATH, "cpu")
    assert times.reference_seconds == pytest.approx(1.0)
    assert times.reference_worst == pytest.approx(2.0)
    assert times.frame_seconds_p95 == pytest.approx(0.03), "laps are no part of frames"
    assert times.frames * 0.03 >= 1.0
    amid = clock.at[3:-3:2]
    assert len(amid) >= 3
    # Between two runs of two laps: the untimed frame, and a quarter of a second of timed ones.
    assert np.diff(amid)[2:] == pytest.approx(2.0 + 0.03 + 0.27, abs=1e-6)


def test_no_native_core_no_reference(monkeypatch) -> None:
    clock = _Clock(monkeypatch)
    monkeypatch.setattr("econgs_bench.bench.machine.timing.lap_seconds", lambda: None)
    times = time_frames(lambda camera: setattr(clock, "time", clock.time + 0.03), PATH, "cpu")
    assert times.reference_seconds is times.reference_worst is None


@pytest.mark.parametrize("decimals", [16, 6])
def test_a_cache_of_finished_pictures_gains_nothing(monkeypatch, decimals) -> None:
    """Warm-up, timed frames and parts show no camera twice, whatever a model keys its pictures by."""
    clock = _Clock(monkeypatch)
    pictures: set[bytes | str] = set()
    drawn, kept = [0], [0]

    def draw(camera: Camera) -> dict[str, float]:
        key = np.round(camera.camera_to_world, decimals).tobytes()
        if key in pictures or camera.name in pictures:
            kept[0] += 1
            return {"rasterise": 0.0}
        pictures.update((key, camera.name))
        drawn[0] += 1
        clock.time += 0.002
        return {"rasterise": 0.002}

    twice = [*PATH, PATH[0]]  # a path that shows a view twice
    times = time_frames(draw, twice, "cpu")
    assert kept == [0]
    assert drawn[0] >= times.frames + times.warmup_frames >= 500
    assert times.frame_seconds == pytest.approx(0.002)
    pictures.clear()
    assert median_timings(draw, twice) == {"rasterise": 0.002}
    assert kept == [0]


def test_an_interruption_is_no_part_of_a_frame(monkeypatch) -> None:
    """A frame takes 2 ms, and 4 ms for ten frames in a row, in which the machine does something else too."""
    clock, frames = [0.0], [0]
    monkeypatch.setattr("econgs_bench.bench.machine.timing.time.perf_counter", lambda: clock[0])

    def timings(camera: Camera) -> dict[str, float]:
        frames[0] += 1
        seconds = 0.004 if 2 <= frames[0] < 12 else 0.002
        clock[0] += seconds
        return {"shade": 0.25 * seconds, "rasterise": 0.75 * seconds}

    assert median_timings(timings, PATH * 11) == {"shade": 0.0005, "rasterise": 0.0015}


class _Decoded(_Model):
    """A model with networks that run once."""

    def __init__(self, answer: str = "once") -> None:
        self.answer = answer

    def decoding(self, scenes) -> str:
        assert scenes == ["a"]
        return self.answer

    def decoding_each_frame(self) -> _Decoded:
        return _Decoded("per frame")


def test_a_model_that_is_decoded_once_is_timed_with_decoding_in_each_frame_too() -> None:
    def frame_seconds(model) -> float:
        assert model.answer == "per frame"
        return 0.004

    assert _decoding(_Decoded(), ["a"], frame_seconds) == ("once", 0.004)
    assert _decoding(_Decoded("per frame"), ["a"], frame_seconds) == ("per frame", None)
    assert _decoding(_Model(), ["a"], frame_seconds) == ("", None)
    with pytest.raises(RuntimeError, match="'twice', not one of once, per frame"):
        _decoding(_Decoded("twice"), ["a"], frame_seconds)


def test_the_kernel_runs_while_the_clock_of_a_fit_stands(tmp_path, monkeypatch) -> None:
    """At stops at least two seconds apart; the longest time outlives an interruption."""
    now = [0.0]
    monkeypatch.setattr("econgs_bench.bench.jobs.monitor.time.monotonic", lambda: now[0])
    monkeypatch.setattr("econgs_bench.bench.jobs.monitor.time.perf_counter", lambda: now[0])
    laps = iter([0.1, 0.3, 0.2])

    def kernel() -> float:
        now[0] += 50.0
        return next(laps)

    def drive(monitor: FitMonitor, moments: list[int]) -> None:
        monitor.start()
        for iteration in moments:
            now[0] += 1.0
            monitor.pause(iteration, _Model, lambda iteration=iteration: Checkpoint(iteration, {}, {}))
        monitor.stop()

    monitor = _monitor(tmp_path, kernel=kernel, every=0.0)
    drive(monitor, [1, 2, 3, 4])
    assert monitor.seconds == pytest.approx(4.0)
    assert monitor.reference_worst == 0.3
    again = _monitor(tmp_path, kernel=kernel)
    assert again.resume().iteration == 4
    assert again.reference_worst == 0.3
    drive(again, [5, 6])
    assert again.reference_worst == 0.3
    assert next(laps, None) is None


class _Picture(_Model):
    def __init__(self, rgb) -> None:
        self.rgb = rgb

    def render(self, camera, scenes=None, edit=None, background=None):
        return self.rgb, np.ones(self.rgb.shape[:2], dtype=np.float32)


@pytest.mark.parametrize(("shift", "psnr"), [(0.0, 100.0), (0.1, 20 * np.log10(255 / 25)), (np.nan, None)])
def test_the_curve_holds_the_psnr_of_held_out_views(tmp_path, shift: float, psnr: float | None) -> None:
    from econgs_bench.datasets.views import ViewSet

    camera = Camera.with_fov(np.eye(4), 0.6, 4, 4, "v")
    image = np.full((4, 4, 4), 0.5, dtype=np.float32)
    image[..., 3] = 1.0
    views = ViewSet((camera,), image[None], (1.0, 1.0, 1.0), "k")
    monitor = FitMonitor(tmp_path, 1, {"s": views}, lambda **state: None, Stop())
    monitor.progress(1, {"loss": 1.0}, 5)
    model = _Picture(image[..., :3] + np.float32(shift))
    monitor.pause(1, lambda: model, lambda: Checkpoint(1, {}, {}))
    (point,) = monitor.curve
    stored = point.model_validate_json(point.model_dump_json())
    assert stored.psnr == {"s": None if psnr is None else pytest.approx(psnr)}
