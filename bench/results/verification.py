"""Whether records contradict themselves or each other: the checks of `bench verify` on what a bundle says.

A check is a function in :data:`CHECKS`: it takes a record and the records beside it, and yields a line for
each contradiction, with the figures. Each rests on arithmetic, or on what the program does on any machine;
none on what is usual. Who invents all figures consistently passes: against that, models are decoded and
measured anew (:mod:`.bench.run.redo`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from functools import cache, cached_property
from itertools import pairwise

from econgs_bench.bench.jobs.encode import EncodeResult
from econgs_bench.bench.jobs.fit import Fit, FitResult
from econgs_bench.bench.jobs.measure import Measure, MeasureResult
from econgs_bench.bench.jobs.scene_views import view_request
from econgs_bench.bench.jobs.views import ViewsResult
from econgs_bench.bench.machine.timing import BY_PROGRAM, MEASURE_FRAMES, MEASURE_SECONDS
from econgs_bench.bench.metrics import METRICS, mean
from econgs_bench.bench.metrics.image import IDENTICAL_DB, SSIM_WINDOW
from econgs_bench.bench.store.lineage import Lineage
from econgs_bench.bench.store.records import FrameTimes, Record, ViewResult
from econgs_bench.datasets.views import split_indices

_REL = 1e-9
"""Relative difference of two numbers that count as equal."""
_CLOCK_SECONDS = 1.0
_CLOCK_SHARE = 0.01
"""How far the system's clock may drift from a job's timer: the network sets the one, not the other."""
_CORE_SECONDS = 0.1
_CORE_SHARE = 0.01
"""How far processor time may exceed the cores' time: the system counts it in ticks."""
_TAIL_SHARE = 0.5
"""Part of the timed second that the slowest 5 % of frames may take, should the machine have stood still."""
LEAST_ITERATION_SECONDS = 1e-4
"""Seconds that no iteration of a built-in method falls below, on any machine.

It renders a picture, takes a loss and gradients, and updates parameters: more than a hundred operations that
a processor starts one after the other, at a microsecond each or more. The quickest committed fit takes
0.7 ms (pictures of 64 pixels a side, without primitives).
"""
_SSIM_CONSTANTS = (0.01**2, 0.03**2)
"""C1 and C2 of SSIM, for values in [0, 1]."""
_SAME_RUN_SECONDS = 2.0
"""A job that starts so soon after the one that it needs belongs to the same run."""


class Evidence(Lineage):
    """The records of a bundle."""

    @cached_property
    def truth_files(self) -> Mapping[tuple[str, str], list[str]]:
        """Views job and split -> paths of its pictures: its own list, else that of a measurement."""
        files: dict[tuple[str, str], list[str]] = {}
        for record in self:
            if (measured := record.of(MeasureResult)) is not None:
                views = _views_job(record)
                files.setdefault((views, record.job.split), [v.truth_file for v in measured.views])
        for record in self:
            stored = record.of(ViewsResult)
            for split, names in stored.truth.items() if stored is not None else ():
                files[record.job.id, split] = [f"jobs/{record.job.id}/truth/{name}" for name in names]
        return files


Check = Callable[[Record, Evidence], Iterator[str]]


def contradictions(record: Record, evidence: Evidence) -> list[str]:
    """A line for each contradiction of a record."""
    lines: list[str] = []
    for check in CHECKS:
        try:
            lines += (f"{record.job.id}: {line}" for line in check(record, evidence))
        except ArithmeticError as error:
            lines.append(f"{record.job.id}: has a figure beyond all that can be computed with ({error})")
    return lines


def absences(evidence: Evidence) -> list[str]:
    """What cannot be checked because a job is not in the bundle, one line per kind of job."""
    absent: Counter[tuple[str, str]] = Counter()
    for record in evidence:
        if record.ok:
            kinds = {name.partition("-")[0] for name in record.job.needs if name not in evidence.by_id}
            absent.update((record.job.kind, kind) for kind in kinds)
    return [
        f"{count} {kind} jobs need {need} jobs that are not in the bundle: what both say is not compared"
        for (kind, need), count in sorted(absent.items())
    ]


# --------------------------------------------------------------------------- the outcome and its clock


def outcome(record: Record, evidence: Evidence) -> Iterator[str]:
    """A success has the result of its kind and a machine, and builds on successes."""
    if not record.ok:
        return
    if record.result is None or record.provenance is None:
        yield f"is a success without {'a machine' if record.result is not None else f'a {record.job.kind}'}"
    for name in record.job.needs:
        if (need := evidence.by_id.get(name)) is not None and not need.ok:
            yield f"is a success on {name}, which ended as {need.status}"


def clock(record: Record, evidence: Evidence) -> Iterator[str]:
    """A job ends after it started and takes no longer than that, and none of its parts longer than the whole.

    More time may lie between start and end: the timer stops while a machine sleeps.
    """
    started, finished = _time(record.started), _time(record.finished)
    if started is None or finished is None:
        yield f"started {record.started!r} and finished {record.finished!r}: no times"
        return
    between = (finished - started).total_seconds()
    if between < 0.0:
        yield f"finished at {record.finished}, before it started at {record.started}"
    # The record of a process that died is made by another, after the job.
    elif record.provenance and record.wall_seconds > _CLOCK_SECONDS + (1.0 + _CLOCK_SHARE) * between:
        yield f"took {record.wall_seconds:.6g} s, but {between:.6g} s lie between its start and its end"
    parts = {} if record.result is None else record.result.parts()
    for name, seconds in parts.items():
        if not 0.0 <= seconds <= record.wall_seconds * (1.0 + _REL):
            yield f"{name} is {seconds:.6g} s of a job of {record.wall_seconds:.6g} s"


def order(record: Record, evidence: Evidence) -> Iterator[str]:
    """No job starts while one that it needs is under way.

    One that it needs may have started later altogether: it ran again, as jobs from a bundle do whose files
    are needed.
    """
    for name in record.job.needs:
        need = evidence.by_id.get(name)
        times = [_time(t) for t in (record.started, need.started, need.finished)] if need is not None else []
        if len(known := [time for time in times if time is not None]) < 3:
            continue
        if known[1] < known[0] < known[2]:
            yield f"started at {record.started}, amid {name}, which it needs"


def processor(record: Record, evidence: Evidence) -> Iterator[str]:
    """A job that starts right after one that it needs, on the machine of that name, has its processor."""
    started, here = _time(record.started), record.provenance
    for name in record.job.needs:
        need = evidence.by_id.get(name)
        if need is None or here is None or (there := need.provenance) is None:
            continue
        finished = _time(need.finished)
        if started is None or finished is None or here.machine != there.machine:
            continue
        gap = (started - finished).total_seconds()
        for what in ("cpu", "cores", "system"):
            ours, theirs = getattr(here, what), getattr(there, what)
            if 0.0 <= gap <= _SAME_RUN_SECONDS and ours != theirs:
                yield (
                    f"has the {what} {ours!r}, but {name}, {gap:.3g} s before on {here.machine}, {theirs!r}"
                )


# --------------------------------------------------------------------------- pictures


def means(record: Record, evidence: Evidence) -> Iterator[str]:
    """The mean of each metric is that of the views; None, with a reason, if any view lacks it."""
    measure, job = record.of(MeasureResult), record.job
    if measure is None or not isinstance(job, Measure):
        return
    for name in job.metrics.keys() - measure.metrics.keys():
        yield f"{name} was asked for and is not there"
    for name, value in measure.metrics.items():
        values = [view.metrics.get(name) for view in measure.views]
        expected = mean(values)
        if (expected is None) != (value is None):
            yield f"{name} is {value}, but {values.count(None)} of {len(values)} views lack it"
        elif expected is not None and value is not None and not math.isclose(expected, value, rel_tol=_REL):
            yield f"{name} is {value:.10g}, but the mean of its {len(values)} views is {expected:.10g}"
        if (value is None) != (name in measure.missing):
            yield f"{name} is {value}, {'with' if name in measure.missing else 'without'} a reason"
    for view in measure.views:
        if view.metrics.keys() != measure.metrics.keys():
            yield f"view {view.view} has other metrics than the mean: {', '.join(view.metrics)}"


def bounds(record: Record, evidence: Evidence) -> Iterator[str]:
    """Every value lies between the least and greatest that its metric has."""
    for view in _view_results(record):
        for name, value in view.metrics.items():
            low, high = METRICS[name].bounds if name in METRICS else (-math.inf, math.inf)
            if value is not None and not low - _REL <= value <= high + _REL:
                yield f"view {view.view}: {name} is {value:.6g}, and it lies between {low:g} and {high:g}"


def views(record: Record, evidence: Evidence) -> Iterator[str]:
    """All views of the truth are measured, each once.

    Rendered truth has the number of views that was asked for, pre-rendered truth at most that.
    """
    if (measure := record.of(MeasureResult)) is None:
        return
    job = record.job
    names, number = [view.view for view in measure.views], len(measure.views)
    if len(set(names)) < number:
        yield f"{number} views have {len(set(names))} names"
    numbered = [f"jobs/{job.id}/renders/{index:04d}.png" for index in range(number)]
    if [view.render_file for view in measure.views] != numbered:
        yield "its rendered files are not numbered view by view"
    source = _views_job(record)
    truth = evidence.truth_files.get((source, job.split), [])
    if [view.truth_file for view in measure.views] != truth:
        known = set(truth)
        first = next((v.truth_file for v in measure.views if v.truth_file not in known), "")
        yield f"has {number} views, and its truth {len(truth)}" + (f", not {first}" if first else "")
    request = job.request
    asked = len(split_indices(request.test_views if job.split == "test" else request.train_views, job.split))
    stored = evidence.by_id.get(source)
    made = None if stored is None else stored.of(ViewsResult)
    rendered = made is not None and bool(made.cost)
    if number > asked or (rendered and number < asked) or number == 0:
        yield f"has {number} views, and {asked} were asked for"
    if stored is not None and stored.job.request != request:
        yield f"asks for other views than {source}"


def identical(record: Record, evidence: Evidence) -> Iterator[str]:
    """Identical pictures have the best value of each metric, others at most one 8-bit step in one value.

    Such a step in one of n values has PSNR 10 log10(255² n), which the cap of PSNR may hide.
    """
    best = {"psnr": IDENTICAL_DB, "psnr_fg": IDENTICAL_DB, "ssim": 1.0}
    alpha = ("missing", "excess")  # which the pictures do not show
    greatest = 10.0 * math.log10(255.0**2 * _values(record))
    for view in _view_results(record):
        if view.identical:
            for name, value in view.metrics.items():
                wanted = best.get(name, 0.0)
                if value is not None and name not in alpha and not math.isclose(value, wanted, abs_tol=1e-6):
                    yield f"view {view.view} is identical with its truth, but {name} is {value:.6g}"
        elif (value := view.metrics.get("psnr")) is not None and value > min(greatest, IDENTICAL_DB) + _REL:
            yield f"view {view.view} is not identical with its truth, but psnr is {value:.6g}"


def steps(record: Record, evidence: Evidence) -> Iterator[str]:
    """PSNR is that of 8-bit pictures: 255² n 10^(-PSNR/10), the sum of squares of n differences, is whole.

    A double of PSNR gives the sum to about 1e-14 of itself; where that is too coarse, nothing is checked.
    """
    if not isinstance(record.job, Measure) or record.job.metrics.get("psnr") != "1":
        return
    number = _values(record)
    for view in _view_results(record):
        value = view.metrics.get("psnr")
        if value is None or value >= IDENTICAL_DB:
            continue
        squares = 255.0**2 * number * 10.0 ** (-value / 10.0)
        tolerance = 1e-6 + 1e-13 * squares
        if tolerance < 0.1 and abs(squares - round(squares)) > tolerance:
            yield f"view {view.view}: no two 8-bit pictures of {number} values have a psnr of {value:.10g}"


def similarity(record: Record, evidence: Evidence) -> Iterator[str]:
    """SSIM is not below what PSNR allows (:func:`least_ssim`)."""
    width, height = _size(record)
    for view in _view_results(record):
        psnr, ssim = view.metrics.get("psnr"), view.metrics.get("ssim")
        if psnr is None or ssim is None:
            continue
        least = least_ssim(psnr, width, height)
        if ssim < least - 1e-6:
            yield f"view {view.view}: ssim is {ssim:.6g}, and {least:.6g} or more with a psnr of {psnr:.6g}"


def least_ssim(psnr: float, width: int, height: int) -> float:
    """The least mean SSIM of two pictures with values in [0, 1] and that PSNR; -1 for pictures without one.

    SSIM of a window is (1 - a)(1 - b) with a = (m_x - m_y)² / (m_x² + m_y² + C1) in [0, 1] of the weighted
    means m, and b = v / (s_x² + s_y² + C2) >= 0 of the weighted variances s², v being the variance of the
    difference x - y. So 1 - SSIM <= a + b. With d = |m_x - m_y| and means that are not negative,
    m_x² + m_y² >= d²; and s_x² + s_y² >= v / 2. So a <= d² / (d² + C1) and b <= v / (v/2 + C2), both concave
    in d² and v: by Jensen's inequality, their means over all windows are at most those functions of the
    means D of d² and V of v. D + V is the mean over windows of the weighted mean square of x - y. As no
    pixel's weights in all windows sum to more than 1, it is at most the mean square error of the picture,
    times its pixels over its windows. The sum of both functions is largest where their slopes agree, or at
    an end.

    PSNR is in dB, of all pixels and channels, the size in pixels.
    """
    if min(width, height) < SSIM_WINDOW:
        return -1.0
    windows = (width - SSIM_WINDOW + 1) * (height - SSIM_WINDOW + 1)
    energy: float = 10.0 ** (-psnr / 10.0) * width * height / windows
    c1, c2 = _SSIM_CONSTANTS
    # The slopes C1 / (D + C1)² and C2 / (V/2 + C2)² agree where sqrt(C1) (V/2 + C2) = sqrt(C2) (D + C1).
    r1, r2 = math.sqrt(c1), math.sqrt(c2)
    mean = min(energy, max(0.0, (r1 * (energy / 2.0 + c2) - r2 * c1) / (r2 + r1 / 2.0)))
    rest = energy - mean
    return max(-1.0, 1.0 - mean / (mean + c1) - rest / (rest / 2.0 + c2))


# --------------------------------------------------------------------------- bytes and times


def ledger(record: Record, evidence: Evidence) -> Iterator[str]:
    """The bytes of a model's parts are not negative, belong to its scenes and sum to those of its files."""
    if (encode := record.of(EncodeResult)) is None:
        return
    total = sum(sum(parts.values()) for parts in encode.ledger.values())
    if total != encode.total_bytes:
        yield f"{encode.total_bytes} bytes of model, but {total} in the ledger"
    if any(size < 0 for parts in encode.ledger.values() for size in parts.values()):
        yield "has negative bytes in the ledger"
    if foreign := encode.ledger.keys() - {"", *record.job.scenes}:
        yield f"has scenes in the ledger that it does not hold: {', '.join(sorted(foreign))}"


def fit(record: Record, evidence: Evidence) -> Iterator[str]:
    """A fit has its iterations, none quicker than any can be, and its curve and processor time fit in."""
    result, job = record.of(FitResult), record.job
    if result is None or not isinstance(job, Fit):
        return
    if result.iterations != job.iterations:
        yield f"ran {result.iterations} iterations of {job.iterations}"
    least = LEAST_ITERATION_SECONDS * result.iterations
    if job.method in _built_in() and result.seconds < least:
        spent = f"{result.iterations} iterations in {result.seconds:.6g} s"
        yield f"{spent}, {least:.6g} s or more on any machine"
    points = [(0, 0.0), *((point.iteration, point.train_seconds) for point in result.curve)]
    for (before, earlier), (after, later) in pairwise(points):
        if after <= before or later < earlier:
            yield f"its curve goes from iteration {before} at {earlier:.6g} s to {after} at {later:.6g} s"
    if points[-1][0] > result.iterations or points[-1][1] > result.seconds * (1.0 + _REL):
        yield (
            f"its curve ends at iteration {points[-1][0]} and {points[-1][1]:.6g} s, "
            f"the fit at {result.iterations} and {result.seconds:.6g} s"
        )
    where = record.provenance
    if where is not None and result.cpu_seconds is not None:
        cores = where.usable or where.cores
        most = result.seconds * cores * (1.0 + _CORE_SHARE) + _CORE_SECONDS
        if not 0.0 <= result.cpu_seconds <= most:
            yield f"{result.cpu_seconds:.6g} s of processor time in {result.seconds:.6g} s of {cores} cores"


def frames(record: Record, evidence: Evidence) -> Iterator[str]:
    """Percentiles of frame times are in order, and the frames fill the time that they were timed for.

    At least half of n frames take the median or more and nine tenths of the others the 5th percentile, so
    0.45 n (median + p05) is less than the whole job takes. Timing ends after a second or 500 frames: fewer
    frames take a second, of which those beyond the 95th percentile have a part alone.
    """
    times = record.of(FrameTimes)
    if times is None or times.ruler == BY_PROGRAM:
        return
    low, median, high = times.frame_seconds_p05, times.frame_seconds, times.frame_seconds_p95
    if low is None or median is None or high is None:
        yield "frames without times"
        return
    if not 0.0 < low <= median <= high:
        yield f"frames of {low:.6g} s (5th percentile), {median:.6g} s (median), {high:.6g} s (95th)"
    least = 0.45 * times.frames * (median + low)
    if least > record.wall_seconds:
        yield f"{times.frames} frames take {least:.6g} s or more, the whole job {record.wall_seconds:.6g} s"
    most = times.frames * high
    if times.frames < MEASURE_FRAMES and most < _TAIL_SHARE * MEASURE_SECONDS:
        yield f"{times.frames} frames of {high:.6g} s take {most:.6g} s, the timing {MEASURE_SECONDS:g} s"
    if isinstance(times, MeasureResult) and times.timing.get("frame") != median:
        yield f"a frame takes {median:.6g} s, but {times.timing.get('frame')} s in its timing"


CHECKS: tuple[Check, ...] = (
    outcome, clock, order, processor, means, bounds, views, identical, steps, similarity, ledger, fit, frames,
)  # fmt: skip


def _view_results(record: Record) -> list[ViewResult]:
    measured = record.of(MeasureResult)
    return [] if measured is None else measured.views


def _views_job(record: Record) -> str:
    return next((name for name in record.job.needs if name.startswith("views-")), "")


def _size(record: Record) -> tuple[int, int]:
    """Width and height of the measured views."""
    view = view_request(record.job.request, record.job.split, record.job.stress)
    return view.width, view.height


def _values(record: Record) -> int:
    width, height = _size(record)
    return 3 * width * height


def _time(text: str) -> datetime | None:
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        return None
    return time if time.tzinfo is not None else None


@cache
def _built_in() -> frozenset[str]:
    from econgs_bench.methods.registry import Registry

    return frozenset(Registry().built_in())
