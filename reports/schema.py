"""The tables of a run store: every table and every column, declared once.

All else follows from these declarations: types, columns of foreign tables, headers and formats for people,
titles of chart axes, the choices of ``bench results --table``, and the page ``docs/reference/tables.md``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from econgs_bench.reports.style import MIB, mib, seconds

if TYPE_CHECKING:
    import pandas as pd

DType = Literal["string", "Int64", "Float64", "boolean", "object"]

METRICS = ("psnr", "psnr_fg", "ssim", "lpips_vgg", "flip", "delta_e_uv")
"""Metrics of color that a run measures by default; every one is a column of `results` and of `views`."""
COVERAGE = ("missing", "excess")
"""Metrics of alpha alone, which every measurement takes; older records name no version of them."""

PRUNED = {"prunable_005": 0.05, "prunable_010": 0.1, "prunable_050": 0.5}
"""Column of `results` -> the loss of PSNR in dB that it allows."""


def _fixed(digits: int) -> Callable[[Any], str]:
    return lambda value: f"{value:.{digits}f}"


def significant(value: float) -> str:
    """Five significant digits."""
    return f"{value:.5g}"


def _three(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:,.0f}"


def _fps(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}" if value >= 1 else f"{value:.3f}"


def rays(samples: int) -> str:
    """Rays a pixel, for people."""
    return "as needed" if samples == 0 else f"{samples}"


@dataclass(frozen=True)
class Column:
    """A column, in whichever tables it occurs.

    Attributes:
        name: identifier.
        dtype: pandas type; all types are nullable.
        doc: definition, in one sentence.
        title: name for people, without unit; "" if the name itself serves.
        unit: unit of the stored values.
        better: 1 if higher is better, -1 if lower is better, 0 if values are not ranked.
        write: value -> text for people, of a value that is present; `str` for names.
        axis: name on a chart's axis, where it differs from ``title``.
        default: value in a foreign table that lacks the column.
    """

    name: str
    dtype: DType
    doc: str = ""
    title: str = ""
    unit: str = ""
    better: int = 0
    write: Callable[[Any], str] | None = None
    axis: str = ""
    default: Any = None

    @property
    def display_unit(self) -> str:
        """Unit in tables and charts for people."""
        return "MiB" if self.unit == "bytes" else self.unit

    @property
    def scale(self) -> float:
        """Stored value / value in the display unit."""
        return MIB if self.unit == "bytes" else 1.0

    @property
    def header(self) -> str:
        """Title with unit, where cells do not contain the unit themselves."""
        name = self.title or self.name.replace("_", " ").capitalize()
        bare = self.write is seconds or self.display_unit in ("", name)
        return name if bare else f"{name} [{self.display_unit}]"

    @property
    def axis_title(self) -> str:
        """Title of a chart's axis, with unit."""
        unit = "" if self.display_unit == self.title else self.display_unit
        return (self.axis or self.title or self.name) + (f" [{unit}]" if unit else "")

    @property
    def numeric(self) -> bool:
        """Whether a table for people aligns it to the right."""
        return self.write is not None and self.write is not str

    def text(self, value: Any) -> str:
        """A value that is present, for people."""
        if self.write is not None:
            return self.write(value)
        return significant(value) if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        doc: definition of a row.
        axes: columns that the row's job determines.
        facts: columns that it does not determine.
    """

    doc: str
    axes: tuple[str, ...]
    facts: tuple[str, ...]

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Axes and facts, as readers get them: in the order of :data:`COLUMNS`."""
        return tuple(name for name in COLUMNS if name in self.axes or name in self.facts)


def _declare(*columns: Column) -> dict[str, Column]:
    assert len({column.name for column in columns}) == len(columns), "a column is declared twice"
    return {column.name: column for column in columns}


# Reports read texts one by one, which is slow in Arrow's storage.
_IN_MEMORY = {"string": "string[python]"}

_T: DType = "string"
_W: DType = "Int64"
_F: DType = "Float64"
_B: DType = "boolean"
COLUMNS: dict[str, Column] = _declare(
    # Axes: what a job is about.
    Column("dataset", _T, "name of the dataset", "Dataset", write=str, default=""),
    Column("procedural", _B, "the dataset's volume is made by a formula", default=False),
    Column("scene", _T, "scene, or composition; an edited scene is its name and the edit; of a group, its "
           "first", "Scene", write=str, default=""),
    Column("kind", _T, "`basic`: a scene; `edited`: a basic scene after a change, against the ground truth "
           "of the changed scene; `composed`: scenes of a composition rendered together, from the models of "
           "all groups that hold them. Kinds are never summed or averaged together", default="basic"),
    Column("edit", _T, "the change of an edited scene, as `opacity=0.5 light=1,0,0`; else empty", default=""),
    Column("recipe", _T, "JSON: the trained scenes whose models were rendered together for an edited scene, "
           "and the edit of each, where the method cannot make the edit; else empty", default=""),
    Column("distance", _F, "distance in [0, 1] of an edited scene's transfer functions from those before the "
           "edit; null where the edit changes none", "Distance"),
    Column("stress", _T, "harder conditions of the run, as `noise=8`; else empty", "Stress", write=str,
           default=""),
    Column("members", _T, "JSON: basic scenes that the job is about"),
    Column("group", _T, "label of the scenes that were fitted together; of a composition, of its groups"),
    Column("fitted_scenes", _T, "JSON: scenes of the fits that the job builds on"),
    Column("scenes_together", _W, "scenes that a joint method learned together, where others learned more of "
           "the dataset's scenes together; else null"),
    Column("method", _T, "name of the method", "Method", write=str, default=""),
    Column("method_version", _T, "version of the method that was fitted"),
    Column("variant", _T, "label of `options`; empty for the preset's own", "Options", default=""),
    Column("base", _T, "label of `options` without the rate knob: fits of one base are points of one curve"),
    Column("options", _T, "JSON: option, `iterations` or `configuration` -> value that differs from the "
           "preset's"),
    Column("knob", _T, "the rate knob among `options`, whose every value needs a fit of its own"),
    Column("knob_value", _F, "its value"),
    Column("rate", _F, "value of a rate knob at which a fit was saved; else null", write="{:g}".format),
    Column("preset", _T, "how long the method trains, and on which views", default=""),
    Column("split", _T, "measured views: `test`, or `val` for held-out training views", default=""),
    Column("seed", _W, "random seed", default=0),
    Column("requested_views", _W, "requested training views; of these, split `val` holds out a tenth"),
    Column("train_views", _W, "training views of the fit", "Training views"),
    Column("iterations", _W, "training iterations of the group", write="{:,}".format),
    Column("contents", _T, "JSON: scene -> hash of its definition and data, of all scenes that decide the "
           "row; null where not known"),
    Column("truth", _T, "identity of the pictures that the row is measured on (content, edit, split, number "
           "and size of views; the pictures where renderers disagree), and behind a `-` of the measured "
           "views; null where not known. Rows of one scene are compared if their truths are equal"),
    Column("test_views", _W, "measured views"),
    Column("metric_versions", _T, "JSON: metric -> its version"),
    Column("width", _W, "width of a view in pixels; in `features`, numbers in a row"),
    Column("height", _W, "height of a view in pixels"),
    Column("samples", _W, "rays a pixel of rendered views, 0: as many as each pixel needs; null for views "
           "that were rendered elsewhere", "Rays a pixel", write=rays),
    Column("device", _T, "device of the fit: `cpu`, `cuda`"),
    Column("machine", _T, "host name"),
    Column("processor", _T, "processor, cores and instruction set; `1 of 2 cores`: a share of the machine"),
    Column("fit_processor", _T, "the same of the fits behind the job, joined by `; `", "Trained on"),
    Column("threads", _W, "threads of the job"),
    Column("finished", _T, "when the job ended, UTC"),
    Column("commit", _T, "commit of this program; `+` means that files were changed"),
    Column("source", _T, "hash of the method's source code at the fit"),
    # A job's outcome.
    Column("job", _T, "identifier of the job"),
    Column("step", _T, "`views`, `dvr`, `complexity`, `partition`, `fit`, `encode` or `measure`"),
    Column("status", _T, "`ok`, `failed`, `oom`, `timeout`, `diverged` or `refused`", "Status", write=str,
           default="ok"),
    Column("reason", _T, "why the job has no result, why metrics are missing, or why a value is not compared",
           "Reason", write=str),
    Column("omissions", _T, "JSON: metric -> why a finished job lacks it"),
    Column("stage", _T, "stage in which the job failed"),
    Column("stale", _B, "method or settings are others today", default=False),
    Column("changes", _T, "what of them: `version 3 (today 6)`, `prune_loss_db 0.02 (today 0.01)`"),
    Column("differences", _T, "JSON: column -> why its value is not compared with those of other rows; the "
           "key `row` holds for all columns, `dataset` for a row that has a dataset of its own; else empty",
           default=""),
    Column("quantity", _T, "column that is not compared; `row`: all of them; `dataset`: the row is in a "
           "dataset of its own", "Not compared", write=str),
    # Quality.
    Column("psnr", _F, "10 log10(1 / MSE) per image, over all pixels and channels of the 8-bit composited "
           "picture; mean over views. Identical images count 100 dB, which is also the cap", "PSNR", "dB", 1,
           _fixed(2)),
    Column("psnr_fg", _F, "PSNR over the pixels where the alpha of truth or model is at least 1/255",
           "PSNR fg", "dB", 1, _fixed(2)),
    Column("ssim", _F, "SSIM of Wang et al. 2004 as in scikit-image: Gaussian window 11x11, sigma 1.5, "
           "population covariance, mean over the interior (5 pixels from the border) and three channels",
           "SSIM", "", 1, _fixed(4)),
    Column("lpips_vgg", _F, "LPIPS 0.1 with VGG-16, input in [-1, 1]", "LPIPS", "", -1, _fixed(4)),
    Column("lpips_vgg01", _F, "LPIPS 0.1 with VGG-16, input left in [0, 1]: the convention of splatting "
           "papers, which gives lower values", "LPIPS [0,1]", "", -1, _fixed(4)),
    Column("lpips_alex", _F, "LPIPS 0.1 with AlexNet, input in [-1, 1]", "LPIPS Alex", "", -1, _fixed(4)),
    Column("flip", _F, "mean LDR-FLIP (Andersson et al. 2020), 67 pixels a degree", "FLIP", "", -1,
           _fixed(4)),
    Column("delta_e_uv", _F, "mean color difference in CIE 1976 L*u*v*; sRGB decoded, white point D65",
           "ΔE*uv", "", -1, _fixed(2)),
    Column("missing", _F, "alpha of the truth that the model lacks, summed over pixels, as a share of the "
           "truth's: structures that it never found, and what has the color of the background"),
    Column("excess", _F, "alpha of the model beyond the truth's, summed over pixels, as a share of the "
           "truth's: what hides other things, and appears on another background"),
    Column("flicker", _F, "root mean square over pixels and channels of the change of the error (picture "
           "less truth) from one test view to the next; mean over pairs of views. Null where a view turns by "
           "more than 2 degrees against the one before", "Flicker", "steps of 1/255", -1, _fixed(2)),
    Column("identical_views", _W, "views that are identical to the truth"),
    Column("psnr_std", _F, "standard deviation of PSNR over seeds", "±", "dB", 0, _fixed(2)),
    Column("floor", _F, "noise floor: PSNR of the truth itself against the same views rendered with other, "
           "more rays, mean over two of the measured views. A difference between models that come near it is "
           "one of the truth's rays. Null for views that were rendered elsewhere and in older records",
           "Floor", "dB", 0, _fixed(2)),
    Column("one_ray", _F, "PSNR of one ray a pixel against these views", "One ray", "dB", 0, _fixed(2)),
    Column("picture", _T, "`truth`: the measured pictures; `one ray`: those of one ray a pixel", "Picture",
           write=str),
    # Size.
    Column("size_bytes", _W, "bytes of the files that load opens: the scene's own part and its share of the "
           "shared part, so that rows sum to the dataset's total", "Size", "bytes", -1, mib,
           "size per scene"),
    Column("group_bytes", _W, "bytes of the whole group", "Files of the group", unit="bytes", write=mib),
    Column("standalone_bytes", _W, "own part and the whole shared part; of a composition, the shared part of "
           "each group once", "Files for this scene alone", unit="bytes", write=mib),
    Column("primitives", _W, "primitives of the scene", "Primitives", write=lambda value: f"{int(value):,}"),
    Column("drawn", _F, "Gaussians that are splatted in a test view, mean over at most 8 views",
           "Drawn Gaussians", write=lambda value: f"{round(value):,}"),
    Column("start_points", _W, "points of the initial cloud that the method was given"),
    Column("gaussians", _W, "Gaussians that the model splats in any training view", "Gaussians",
           write=lambda value: f"{int(value):,}"),
    *(
        Column(name, _F, "share of these Gaussians that can be left out, those of the least blending weights "
               f"over the training views first, until PSNR is {drop:g} dB lower", f"Prunable at {drop:g} dB",
               write="{:.1%}".format)
        for name, drop in PRUNED.items()
    ),
    Column("part", _T, "name of a part; of a frame: `frame`, `decode`, `shade`, `rasterise`"),
    Column("bytes", _W, "bytes of the part", unit="bytes"),
    # Time and memory.
    Column("train_seconds", _F, "time of partition, fit and encode; the scene's share", "Training", "s", -1,
           seconds, "training time per scene"),
    Column("group_seconds", _F, "partition, fit and encode of the whole group", "Fit of the group", unit="s",
           write=seconds),
    Column("partition_seconds", _F, "time to find the groups of a joint method; null for others", unit="s"),
    Column("encode_seconds", _F, "time to write the compressed files", "Encoding", unit="s", write=seconds),
    Column("cpu_seconds", _F, "processor time of the fit over all threads, the scene's share; other work on "
           "the machine hardly changes it", "Processor time", unit="s", write=seconds),
    Column("load_seconds", _F, "time from files to a model that is ready to render; of a volume, to read it",
           "Load", "s", -1, seconds),
    Column("fps", _F, "1 / median frame time of the loaded model, from camera to image", "FPS", "FPS", 1,
           _fps, "frames per second"),
    Column("fps_p05", _F, "1 / 95th percentile of time", "Slowest 5 %", unit="FPS", write="{:.4g}".format),
    Column("fps_p95", _F, "1 / 5th percentile of time", "Fastest 5 %", unit="FPS", write="{:.4g}".format),
    Column("ruler", _W, "version of how frames are timed; FPS of several versions are not compared"),
    Column("parts_ruler", _W, "version of how the parts of a frame are timed"),
    Column("decoding", _T, "when the model's networks make what is drawn: `once`, as it is loaded, or "
           "`per frame`, as a part of it; empty without such networks; null where not known"),
    Column("fps_decoding", _F, "1 / median time of a frame in which networks run too that usually run once; "
           "null for others", unit="FPS", write=_fps),
    Column("reference_seconds", _F, "time of a fixed kernel next to the timed part: how fast the machine was "
           "then", "Reference kernel", unit="s", write=seconds),
    Column("fit_reference_seconds", _F, "the same next to the fit, largest of its groups", unit="s"),
    Column("reference_worst", _F, "the longest of the kernel's times before, amid and after the timed part",
           unit="s"),
    Column("fit_reference_worst", _F, "the longest of the kernel's times before, amid and after the fit, "
           "largest of its groups", unit="s"),
    Column("peak_host_bytes", _W, "peak host memory of fit and measurement", "Host mem.", "bytes", -1, mib,
           "peak host memory"),
    Column("peak_device_bytes", _W, "peak device memory of fit and measurement", "Device mem.", "bytes", -1,
           mib, "peak device memory"),
    Column("group_peak_host_bytes", _W, "peak host memory of the fit", "Memory of the fit", unit="bytes",
           write=mib),
    Column("load_host_bytes", _W, "peak host memory of loading and decoding alone, the program included",
           "Memory of loading", unit="bytes", write=mib),
    Column("render_host_bytes", _W, "peak host memory of loading and rendering alone, the program included",
           "Memory of rendering", unit="bytes", write=mib),
    Column("render_device_bytes", _W, "peak device memory of loading and rendering alone",
           "Device memory of rendering", unit="bytes", write=mib),
    Column("seconds", _F, "median time of the part", unit="s"),
    # Views.
    Column("view", _T, "name of the view"),
    Column("identical", _B, "the rendered picture equals the truth", "Identical",
           write=lambda value: "yes" if value else "no"),
    Column("truth_file", _T, "picture of the truth, relative to the store"),
    Column("render_file", _T, "rendered picture, relative to the store"),
    Column("alpha_file", _T, "picture of the rendered alpha, relative to the store"),
    Column("background", _T, "background color, as `#rrggbb`"),
    # Training.
    Column("iteration", _W, "training iteration; of a stretch, its last"),
    Column("first", _W, "first iteration of a stretch", "First", write=significant),
    Column("loss", _F, "training loss"),
    Column("loss_parts", _T, "JSON: part of the loss -> weighted value; with further figures of the method"),
    Column("losses", _T, "JSON: `loss`, its weighted parts and further figures -> mean over the stretch"),
    Column("bytes_estimate", _W, "the method's estimate of its size at this iteration", unit="bytes"),
    # Attributes of primitives, and transfer functions.
    Column("name", _T, "name of the attribute"),
    Column("values", "object", "values of a sample of primitives, row after row"),
    Column("transfer", _T, "JSON: part -> `transfer`, color and opacity in 128 bins of normalised values, "
           "and `levels`, value and color of isosurfaces"),
    Column("variable", _T, "variable of the volume that a basic scene shows"),
    Column("cloud_seconds", _F, "time from the volume in memory to the candidates of initial clouds, of a "
           "basic scene", "Initial cloud", unit="s", write=seconds),
    # Cost of rendering volumes.
    Column("nx", _W, "voxels along x"),
    Column("ny", _W, "voxels along y"),
    Column("nz", _W, "voxels along z"),
    Column("variables", _T, "variables of the volume, joined by `;`", "Variables", write=significant),
    Column("dtype", _T, "type of a voxel in memory"),
    Column("volume_bytes", _W, "size of all variables in memory", unit="bytes"),
    Column("voxels", _W, "voxels of the volume", "Voxels", write=lambda value: f"{int(value):,}"),
    Column("lossless_bytes", _W, "bytes of the volume as the transfer function shows it, coded without loss: "
           "8-bit color and opacity of the reference length, no color where that opacity is 0; null for "
           "isosurfaces", "Lossless volume", unit="bytes", write=mib),
    Column("coder", _T, "what coded it"),
    Column("ms_per_view", _F, "median time of a view per launch, after warm-up", "ms per view", write=_three),
    Column("ms_p05", _F, "5th percentile of the same", "5 %", write=_three),
    Column("ms_p95", _F, "95th percentile of the same", "95 %", write=_three),
    Column("setup_seconds", _F, "from the volume in memory to the first picture", "Set-up", "s", 0, seconds),
    Column("renderer", _T, "renderer of the volume, or of the pictures that a row is measured on; `files`: "
           "they were rendered elsewhere", "Renderer", write=str),
    Column("version", _T, "version of the renderer"),
    Column("backend", _T, "backend of the renderer"),
    # Ladders.
    Column("ladder", _T, "name of the ladder", "Ladder", write=str),
    Column("purpose", _T, "what gets harder on the ladder", "What gets harder", write=str),
    Column("place", _W, "place of the rung, 0 for the first", "Place", write=str),
    Column("rungs", _W, "rungs of the ladder", "Rungs", write=str),
    Column("rung", _T, "stress, scene or options of the rung", "Rung", write=str),
    Column("subject", _T, "scene on which the ladder is climbed, as `vortices/cores`; empty where the rungs "
           "are scenes", "Scene", write=str),
    Column("same_truth", _B, "the test pictures are those of the first rung"),
    Column("failed_step", _T, "step that failed: `partition`, `fit`, `encode`, `measure` or `views`"),
    Column("failure", _T, "kind of break; empty where the rung holds. A failed step: `diverged`, `memory`, "
           "`time`, `refusal`, `decode error` (encode or load) or `failure`. A result, against that of the "
           "first rung, means over seeds, the first that fits: `collapse` (missing above 0.5 and 0.2 more), "
           "`explosion` (same truth and more than 5 times the primitives), `vanishing parts` (missing 0.2 "
           "more), `floaters` (excess 0.2 more), `quality` (change of -3 dB or less)", "Break", write=str),
    Column("change", _F, "same test pictures: PSNR less that of the first rung. Other test pictures: the "
           "same of the distance to the best method on the rung, so that a rung that is hard for all methods "
           "is no break by this. PSNR above 48.13 dB, where errors are below one 8-bit step, counts as 48.13",
           "Change", "dB", 0, _fixed(2)),
    # Columns of tables for people alone.
    Column("scenes", _T, "scenes with a result", "Scenes", write=str),
    Column("seeds", _W, "seeds with a result", "Seeds", write=str),
    Column("resolution", _T, "voxels of the volume", "Resolution", write=str),
    Column("volume_gib", _F, "size of the volume in memory", "Volume", "GiB", write=_three),
    Column("cpu_gib", _F, "peak of the process that renders", "CPU mem.", "GiB", write=_three),
    Column("gpu_gib", _F, "peak device memory", "GPU mem.", "GiB", write=_three),
    Column("image", _T, "size of a view", "Image", write=str),
    Column("file", _T, "name of the picture", "Image", write=str),
    Column("views", _W, "paired views", "Views", write=significant),
    Column("second", _F, "mean of the second run", "Second", write=significant),
    Column("difference", _F, "second - first, mean over the paired views", "Difference", write=significant),
    Column("least", _F, "least difference of any view", "Least", write=significant),
    Column("greatest", _F, "greatest difference of any view", "Greatest", write=significant),
)  # fmt: skip

_SETTINGS = (
    "dataset", "scenes_together", "method", "variant", "base", "knob_value", "preset", "requested_views",
)  # fmt: skip
_FIT = (*_SETTINGS, "seed")
_SAVED = (*_FIT, "rate")
_MEASURED = (*_SAVED, "scene", "split", "truth", "renderer", "metric_versions")
_RESULT = (
    *_MEASURED, "kind", "edit", "group", "fitted_scenes", "method_version", "options", "knob", "iterations",
    "train_views", "contents", "test_views", "width", "height", "samples", "device", "machine", "threads",
    "finished", "commit", "source", "processor", "fit_processor", "procedural", "differences",
)  # fmt: skip
TABLES: dict[str, Table] = {
    "jobs": Table(
        "A finished job, and what decides it.",
        (),
        ("job", "step", "members", "stress", *(name for name in COLUMNS if name in _RESULT)),
    ),
    "results": Table(
        "A model of a scene or composition. `size_bytes`, `train_seconds` and `cpu_seconds` are shares of "
        "the group's, so that rows sum to the dataset's total. Bytes, seconds and primitives of a "
        "composition are sums over its scenes or groups; `load_seconds` and `fps` are measured; memory is "
        "the maximum. A method that cannot make an edit, or cannot render models of several groups together, "
        "has a row with status `refused`.", _RESULT,
        ("job", "status", "reason", "omissions", "stage", "stale", "changes", "recipe", "distance", *METRICS,
         *COVERAGE, "floor", "one_ray", "flicker", "identical_views", "size_bytes", "group_bytes",
         "standalone_bytes", "primitives", "drawn", "start_points", "train_seconds", "group_seconds",
         "partition_seconds", "encode_seconds", "cpu_seconds", "load_seconds", "fps", "fps_p05", "fps_p95",
         "ruler", "parts_ruler", "decoding", "fps_decoding", "reference_seconds", "reference_worst",
         "fit_reference_seconds", "fit_reference_worst", "peak_host_bytes", "peak_device_bytes",
         "group_peak_host_bytes", "load_host_bytes", "render_host_bytes", "render_device_bytes", "gaussians",
         *PRUNED),
    ),
    "views": Table(
        "A measured view of a model.", _MEASURED,
        ("job", "view", *METRICS, *COVERAGE, "identical", "truth_file", "render_file", "alpha_file",
         "background"),
    ),
    "floors": Table(
        "What the truth of a scene reaches against the same views rendered with other, more rays (its noise "
        "floor), and what one ray a pixel reaches: means over two of the measured views. Views that were "
        "rendered elsewhere have none.",
        ("dataset", "scene", "kind", "edit", "preset", "split", "requested_views", "width", "height",
         "samples"),
        ("job", "picture", *METRICS),
    ),
    "curve": Table(
        "An evaluation during a fit, per scene, on four of the views that are measured at the end; no method "
        "trains on them.", _FIT,
        ("job", "scene", "iteration", "train_seconds", "loss", "psnr", "primitives", "bytes_estimate",
         "loss_parts"),
    ),
    "losses": Table(
        "A stretch of a fit: a fiftieth of its iterations, or the rest of a stage. A group has one row per "
        "stretch.",
        (*_FIT, "scene"),
        ("job", "stage", "first", "iteration", "losses"),
    ),
    "ledger": Table(
        "A part of a saved model, per scene; `scene` is empty for what the group shares.", _SAVED,
        ("job", "scene", "part", "bytes"),
    ),
    "timing": Table(
        "A part of a frame of the loaded model.",
        (*_SAVED, "scene"),
        ("job", "part", "seconds"),
    ),
    "features": Table(
        "An attribute of a sample of a model's primitives (100, or as many as the suite requests): `values` "
        "holds rows of `width` numbers.",
        (*_SETTINGS, "scene"),
        ("job", "name", "values", "width"),
    ),
    "scenes": Table(
        "A scene whose views were rendered here.",
        ("dataset", "scene", "preset", "split", "requested_views"),
        ("job", "transfer", "variable", "cloud_seconds"),
    ),
    "dvr": Table(
        "Cost of direct rendering of a scene's volume, one view per launch, alone on the machine.",
        ("dataset", "scene", "kind", "preset", "width", "height", "machine", "processor", "threads",
         "commit"),
        ("job", "status", "reason", "nx", "ny", "nz", "variables", "dtype", "volume_bytes", "ms_per_view",
         "ms_p05", "ms_p95", "fps", "load_seconds", "setup_seconds", "peak_host_bytes", "peak_device_bytes",
         "renderer", "version", "backend", "reference_seconds"),
    ),
    "complexity": Table(
        "Bytes that a scene's classified volume takes without loss, in suites that ask for them.",
        ("dataset", "scene"),
        ("job", "voxels", "lossless_bytes", "coder"),
    ),
    "rungs": Table(
        "A measurement that is a rung of a ladder, ladders in the order of their suite; the first rung is "
        "the usual run. Runs under stress are in no table but this one and `rung_views`.",
        ("dataset", "scene", "method", "preset", "split", "requested_views", "seed", "stress"),
        ("job", "ladder", "purpose", "place", "rungs", "rung", "subject", "variant", "same_truth", "status",
         "failed_step", "reason", "stage", "stale", "psnr", "psnr_fg", "missing", "excess", "flicker",
         "primitives", "size_bytes", "train_seconds"),
    ),
    "rung_views": Table(
        "A measured view of a rung, the usual run included.",
        ("dataset", "scene", "method"),
        ("job", "view", "psnr", "missing", "excess", "truth_file", "render_file", "background"),
    ),
    "superseded": Table(
        "A result that the other tables leave out, because a newer one of the same model takes its place.",
        (*_MEASURED, "kind", "commit"),
        ("job", "status", "psnr", "size_bytes"),
    ),
    "differences": Table(
        "A value that conclusions, means and charts leave out, or a row that has a dataset of its own; with "
        "the reason.",
        ("dataset", "scene", "method", "variant", "seed", "rate", "preset", "split"),
        ("job", "quantity", "reason"),
    ),
}  # fmt: skip


def frame(name: str, rows: Iterable[Mapping[str, Any]] = (), *, stored: bool = False) -> pd.DataFrame:
    """A table with its columns and types; what a row lacks is null.

    Args:
        name: of the table.
        rows: column -> value.
        stored: leave out what `jobs` holds, as on disk.
    """
    import pandas as pd

    rows = list(rows)
    arrays: dict[str, Any] = {}
    for column in TABLES[name].facts if stored else TABLES[name].columns:
        dtype, values = COLUMNS[column].dtype, [row.get(column) for row in rows]
        if dtype == "object":
            arrays[column] = pd.Series(values, dtype=dtype)
        else:
            arrays[column] = pd.array(values, _IN_MEMORY.get(dtype, dtype))  # type: ignore[call-overload]
    return pd.DataFrame(arrays, index=pd.RangeIndex(len(rows)), copy=False)


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a table; on wide ones much faster than `iterrows` and `to_dict`."""
    import numpy as np

    columns = (
        column.tolist() if isinstance(column.dtype, np.dtype) else column.to_numpy(object, na_value=None)  # type: ignore[call-overload]
        for _, column in table.items()
    )
    names = table.columns.tolist()
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]


def joined(tables: Mapping[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """The tables as readers get them: every row with the axes of its job.

    Args:
        tables: as on disk, with `jobs` among them.
    """
    jobs = tables["jobs"]
    full = {}
    for name, table in tables.items():
        axes = jobs[["job", *TABLES[name].axes]]
        full[name] = table.merge(axes, on="job", how="left")[list(TABLES[name].columns)]
    return full


def read_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """The tables of a run store's folder ``tables``, as readers get them."""
    import pandas as pd

    return joined({name: pd.read_parquet(folder / f"{name}.parquet") for name in TABLES})


def by_name(name: str) -> Column:
    """A column, also one that is declared nowhere."""
    return COLUMNS.get(name) or Column(name, "object")
