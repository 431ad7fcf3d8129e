"""What a method must offer: the contract between the harness and every plugin.

A method is declared by a :class:`MethodSpec` (import-light) and implemented by a class that
satisfies :class:`Method`, named in the spec as "module:attribute" and imported only when used.
Shapes are written as trailing comments; torch tensors are on the device of ``fit``, ``restore``, ``load``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar, cast, runtime_checkable

from econgs_bench.datasets.edits import Edit as Edit

if TYPE_CHECKING:
    import numpy as np
    import torch
    from numpy.typing import NDArray

    from econgs_bench.datasets.camera import Camera
    from econgs_bench.datasets.cloud import PointCloud
    from econgs_bench.datasets.scene import RGB, BasicScene
    from econgs_bench.datasets.views import ViewSet
    from econgs_bench.datasets.volume import Volume
    from econgs_bench.econgs.splat.splats import Splats

OptionValue = bool | int | float | str
OPTION = "option"  # where the metadata of a dataclass field hold its Option
CLOUD_POINTS = "cloud_points"
"""Name of an option that asks for an initial cloud of more points than the preset's."""
V = TypeVar("V", bound=OptionValue)


# --------------------------------------------------------------------------- declaration


PRESETS = ("quick", "standard", "paper")
"""How long a method trains: every method declares its iterations for these, at least."""


@dataclass(frozen=True)
class Option:
    """One setting of a method, as its dataclass of options declares it.

    Attributes:
        default: its type is the option's type.
        doc: one line for people, with the unit.
        minimum, maximum: inclusive range of numbers.
        choices: the only values allowed, if not empty.
        search: range of numbers that ``bench tune`` looks through; None: around the starting values.
        before: what fits had that are older than the option; None: its default.
        formerly: name by which older records and command lines have the option; "" if it never had another.
    """

    default: OptionValue
    doc: str
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[OptionValue, ...] = ()
    search: tuple[float, float] | None = None
    before: OptionValue | None = None
    formerly: str = ""


def option(
    default: V,
    doc: str,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    search: tuple[float, float] | None = None,
    before: V | None = None,
    formerly: str = "",
) -> V:
    """A field of a dataclass of options; the arguments are attributes of :class:`Option`.

    The field's annotation is the option's type: ``bool``, ``int``, ``float``, ``str``, or ``Literal[...]`` of
    the choices. Example: ``voxel: float = option(0.001, "lattice, scene units", minimum=1e-5)``
    """
    about = Option(default, doc, minimum, maximum, search=search, before=before, formerly=formerly)
    declared: Any = field(default=default, metadata={OPTION: about})
    return cast("V", declared)


def with_default(options: type, name: str, default: V) -> V:
    """A field as another dataclass of options declares it, with another default."""
    declared = next(one for one in fields(options) if one.name == name).metadata[OPTION]
    return field(default=default, metadata={OPTION: replace(declared, default=default)})


@dataclass(frozen=True)
class NoOptions:
    """Options of a method that has none."""


@dataclass(frozen=True)
class RateKnob:
    """A knob that trades bytes for quality.

    Attributes:
        name: "codebook size", "lambda".
        values: points of the method's rate curve.
        refit: True if each value needs its own fit (then ``name`` is an option); False if one fit
            can be saved at any value (``Model.save(rate=value)``).
    """

    name: str
    values: tuple[float, ...]
    refit: bool


@dataclass(frozen=True)
class Configuration:
    """A named way to run a method: the settings that its authors published, those of a fair comparison.

    Attributes:
        options: option values that differ; they come on top of a preset's.
        iterations: preset name -> training iterations that differ.
    """

    options: Mapping[str, OptionValue] = field(default_factory=dict)
    iterations: Mapping[str, int] = field(default_factory=dict)


def built_in(*folders: str) -> tuple[str, ...]:
    """The ``source`` of a built-in method.

    Args:
        folders: in ``methods/``: its own, and those of the methods that it builds on.
    """
    shared = ("econgs", "methods.interface", "methods.shared")
    return tuple(f"econgs_bench.{one}" for one in (*shared, *(f"methods.{folder}" for folder in folders)))


@dataclass(frozen=True, kw_only=True)
class MethodSpec:
    """A method's declaration; pure data, imports nothing heavy.

    Attributes:
        name: identifier on the command line ("3dgs").
        title: full name.
        reference: citation of its paper.
        version: raised when the same options may come to other results; part of the fit key. Rows of another
            version are stale.
        implementation: "module:attribute" of the :class:`Method`.
        source: packages or modules whose hash goes into records; default: the top-level package of the
            implementation.
        files: further files whose content goes into that hash. Where there are any, the implementation is
            made with the first one as its argument.
        joint: trains several scenes of a dataset as one group.
        composable: models of several groups render together.
        edits: which parts of :class:`Edit` it honours.
        needs_volume: reads the volume itself, not only views and cloud.
        volume_scenes: kinds of scenes that a method which reads the volume takes; it must refuse the others.
        point_sampled: draws what is at the centre of a pixel; ``--set name.samples=16`` draws the mean over
            16 points of it, the model being the same.
        drawn_here: another program draws its Gaussians, and ``--set name.drawn=here`` draws them here; both
            are rows of one fit.
        resumable: an interrupted fit continues at a checkpoint; otherwise it begins anew.
        uses_alpha: how it uses the alpha of training views, for people.
        devices: "cpu", "cuda".
        iterations: preset name -> training iterations of one scene; every one of :data:`PRESETS`, at least. A
            group has as many, or more by :data:`.methods.options.GROUP_BUDGET`.
        options: frozen dataclass whose fields are declared by :func:`option`.
        presets: preset name -> option values that differ from the defaults.
        rate_knobs: empty if the method has one size only.
        configurations: name -> settings, chosen like an option (``--set name.configuration=paper``).
        tunable: options that ``bench tune`` varies; default: all that declare choices or both bounds.
    """

    name: str
    title: str
    reference: str
    version: str
    implementation: str
    uses_alpha: str
    iterations: Mapping[str, int]
    source: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()
    joint: bool = False
    composable: bool = False
    edits: frozenset[Literal["palette", "opacity", "light", "shading", "transfer"]] = frozenset()
    needs_volume: bool = False
    volume_scenes: frozenset[Literal["transfer", "isosurfaces"]] = frozenset({"transfer", "isosurfaces"})
    point_sampled: bool = False
    drawn_here: bool = False
    resumable: bool = True
    devices: tuple[Literal["cpu", "cuda"], ...] = ("cpu", "cuda")
    options: type[Any] = NoOptions
    presets: Mapping[str, Mapping[str, OptionValue]] = field(default_factory=dict)
    rate_knobs: tuple[RateKnob, ...] = ()
    configurations: Mapping[str, Configuration] = field(default_factory=dict)
    tunable: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.source:
            object.__setattr__(self, "source", (re.split("[.:]", self.implementation)[0],))


class Refused(Exception):
    """The method declines what it cannot do, by name; recorded as a row with status "refused"."""


class Diverged(Exception):
    """Training produced NaN or infinite values; recorded as a row with status "diverged"."""


# --------------------------------------------------------------------------- input


@dataclass(frozen=True, eq=False)
class SceneInput:
    """All that a method may see of one basic scene. Test views are not among it.

    Attributes:
        scene: its definition.
        train: training views (validation views left out when validation leads the choices).
        validation: views for choices; never trained on. May be empty.
        cloud: initial points with colors, in scene space.
        extent: 1.1 x the greatest distance of a training camera from the mean camera centre.
        volume: reads the scene's volume; None for pre-rendered scenes.
        units: units of the volume's box / units of all coordinates: other than 1 where a fit has its own.
    """

    scene: BasicScene
    train: ViewSet
    validation: ViewSet
    cloud: PointCloud
    extent: float
    volume: Callable[[], Volume] | None = None
    units: float = 1.0

    @property
    def name(self) -> str:
        return self.scene.name


@dataclass(frozen=True)
class Budget:
    """How long a fit may take.

    Attributes:
        iterations: optimiser steps for the whole group; phase boundaries of a schedule are
            fractions of it.
    """

    iterations: int


# --------------------------------------------------------------------------- training


@dataclass
class Checkpoint:
    """All that is needed to continue a fit exactly where it was.

    Attributes:
        iteration: steps done. Equal to the budget's in the checkpoint of a finished fit.
        arrays: name -> tensor (parameters, optimiser moments, random states as uint8).
        scalars: JSON values.
    """

    iteration: int
    arrays: dict[str, torch.Tensor]
    scalars: dict[str, Any] = field(default_factory=dict)


class Monitor(Protocol):
    """Receives the reports of ``fit``. The training clock stops inside its calls."""

    def progress(self, iteration: int, losses: Mapping[str, float], primitives: int) -> None:
        """Report at every iteration: cheap, and throttled by the monitor.

        Args:
            iteration: just done, from 1.
            losses: "loss", which is minimised, and by other names its parts and further figures to show.
                Empty: they were not looked at, as on a GPU, where each look waits for it.
            primitives: number of primitives of the group.

        Raises:
            Diverged: a loss is not finite.
        """

    def due(self, iteration: int) -> bool:
        """Whether an anytime evaluation or a checkpoint is due after this iteration."""

    def pause(self, iteration: int, model: Callable[[], Model], checkpoint: Callable[[], Checkpoint]) -> None:
        """Evaluate and/or checkpoint, as due: calls the functions only if needed."""

    def stage(self, name: str) -> None:
        """Name the stage that begins ("warm-up", "context model")."""


class Model(Protocol):
    """A trained representation of the scenes of one group (or several, once composed)."""

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes it holds."""

    def primitives(self, scene: str | None = None) -> int:
        """Number of Gaussians, anchors, voxels of one scene or of all."""

    def save(self, folder: Path, rate: float | None = None) -> Mapping[str, Mapping[str, int]]:
        """Write every file that ``load`` needs into an empty folder.

        Returns:
            The byte ledger: scene name, or "" for what the group shares -> part name -> bytes.
            All entries sum to the size of the files.
        """

    def render(
        self,
        camera: Camera,
        scenes: Sequence[str] | None = None,
        edit: Mapping[str, Edit] | None = None,
        background: RGB | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:  # rgb [H, W, 3] in [0, 1], alpha [H, W]
        """Render scenes (default: all) together, composited on ``background``.

        Args:
            camera: the view.
            scenes: names of those to render.
            edit: scene -> changes; scenes without one are rendered as trained.
            background: default: the recorded background of the first scene.

        Raises:
            Refused: an edit or a composition that the method cannot do.
        """

    def timings(self, camera: Camera, scenes: Sequence[str] | None = None) -> Mapping[str, float]:
        """Seconds of one frame of scenes (default: all) by part ("decode", "shade", "rasterise")."""


@runtime_checkable
class EstimatesBytes(Protocol):
    """A model that can say what it would take on disk; for the curves of training."""

    def bytes_estimate(self) -> int:
        """Bytes that :meth:`Model.save` would write, at the default rate."""


@runtime_checkable
class HasAttributes(Protocol):
    """A model whose primitives carry attributes that are worth looking at: histograms, embeddings."""

    def attributes(self, scene: str, count: int) -> Mapping[str, torch.Tensor]:
        """Attribute -> (n, d) values of at most ``count`` primitives of a scene, spread evenly over them."""


@runtime_checkable
class HasGaussians(Protocol):
    """A model of Gaussians that are told apart, so that some can be left out."""

    def splats(self, scene: str, camera: Camera) -> tuple[Splats, torch.Tensor]:
        """What is splatted of a scene in a view, and (M,) the number of each, the same in every view."""


@runtime_checkable
class Splatted(Protocol):
    """A model whose pictures are Gaussians splatted once: another rasteriser can draw the same."""

    def splatted(
        self, camera: Camera, scenes: Sequence[str] | None = None, edit: Mapping[str, Edit] | None = None
    ) -> Splats:
        """What is splatted of scenes (default: all) in a view; arguments as of :meth:`Model.render`.

        Raises:
            Refused: an edit or a composition that the method cannot do.
        """


class DrawnViews(Protocol):
    """Views that another program drew, all in one process.

    Attributes:
        frame_seconds: time of each frame that its output tells; empty if it tells none.
        load_seconds: time of what it does before it draws, such as decoding; None without such a step.
        peak_host_bytes, peak_device_bytes: of its processes; None where unknown.
    """

    frame_seconds: tuple[float, ...]
    load_seconds: float | None
    peak_host_bytes: int | None
    peak_device_bytes: int | None

    def __getitem__(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Colors (H, W, 3), composited on the background, and alpha (H, W); None if its picture has none."""


@runtime_checkable
class DrawsTogether(Protocol):
    """A model that another program draws: its frames cannot be timed here, and a process draws many."""

    def draw_all(
        self,
        cameras: Sequence[Camera],
        scenes: Sequence[str] | None = None,
        edit: Mapping[str, Edit] | None = None,
        background: RGB | None = None,
    ) -> DrawnViews:
        """Draw views as :meth:`Model.render` does.

        Raises:
            Refused: an edit or a composition that the method cannot do.
            DataError: the program failed, or a picture is missing or wrong.
        """


@runtime_checkable
class DrawnHere(Protocol):
    """A model whose Gaussians can be drawn by this program, too."""

    def drawn_here(self) -> Model:
        """The same model, drawn here.

        Raises:
            DataError: its Gaussians cannot be read.
        """


@runtime_checkable
class RunsPrograms(Protocol):
    """A method whose work other programs do.

    Attributes:
        scratch: folder for files under way, which is removed after the job; None: a temporary folder.
        peak_host_bytes, peak_device_bytes: of the processes of the last program that ran; None before.
    """

    scratch: Path | None
    peak_host_bytes: int | None
    peak_device_bytes: int | None

    def prepare(self, group: Sequence[SceneInput], device: str) -> None:
        """Write what the program of the next fit reads; no training clock runs meanwhile.

        Raises:
            DataError: what the program needs is missing.
        """


Decoding = Literal["once", "per frame"]
"""When networks make what is drawn: as the model is loaded, or again for each frame."""


@runtime_checkable
class HasDecoders(Protocol):
    """A model whose networks make what is drawn, as those that decode anchors to Gaussians."""

    def decoding(self, scenes: Sequence[str]) -> Decoding:
        """When the networks of scenes run; "per frame" if those of any of them do."""

    def decoding_each_frame(self) -> Model:
        """The same scenes in a model that runs their networks for each frame, with the same pictures.

        It times what decoding once saves.
        """


class Method(Protocol):
    """The implementation behind a spec."""

    def partition(self, scenes: Sequence[SceneInput], options: Any) -> list[list[SceneInput]]:
        """Split the scenes of a dataset into groups that are fitted together."""

    def fit(
        self,
        group: Sequence[SceneInput],
        options: Any,
        budget: Budget,
        seed: int,
        device: str,
        monitor: Monitor,
        resume: Checkpoint | None = None,
    ) -> Model:
        """Train one group.

        Args:
            group: the scenes to train together.
            options: an instance of the spec's dataclass of options, resolved and validated.
            budget: how long.
            seed: the only source of randomness.
            device: "cpu" or "cuda".
            monitor: takes reports at every iteration.
            resume: continue from here.

        Raises:
            Refused: the group or an option combination cannot be fitted.
            Diverged: parameters or losses are no longer finite.
        """

    def restore(self, checkpoint: Checkpoint, options: Any, device: str) -> Model:
        """The model that a fit returned, from the checkpoint of its last iteration alone.

        Args:
            checkpoint: holds all that the model needs; neither scenes nor views are at hand.
            options: as given to the fit.
            device: "cpu" or "cuda".
        """

    def load(self, folder: Path, device: str) -> Model:
        """Read what ``Model.save`` wrote, in a process that knows nothing else."""

    def compose(self, models: Sequence[Model]) -> Model:
        """Join models so that any subset of their scenes renders together.

        Raises:
            Refused: the method cannot compose.
        """


def check_ledger(ledger: Mapping[str, Mapping[str, int]], total: int, scenes: Sequence[str]) -> None:
    """Check the byte ledger of a saved model (:meth:`Model.save`).

    Raises:
        RuntimeError: it names other scenes, has negative entries, or does not sum to the files' ``total``.
    """
    foreign = [name for name in ledger if name and name not in scenes]
    if foreign:
        raise RuntimeError(f"byte ledger names scenes that are not in the group: {', '.join(foreign)}")
    negative = [f"{s}/{p}" for s, parts in ledger.items() for p, n in parts.items() if n < 0]
    if negative:
        raise RuntimeError(f"byte ledger has negative entries: {', '.join(negative)}")
    claimed = sum(sum(parts.values()) for parts in ledger.values())
    if claimed != total:
        raise RuntimeError(f"byte ledger sums to {claimed} bytes, the saved files have {total}")


def edits_by_scene(edit: Mapping[str, Edit] | None, scenes: Sequence[str]) -> dict[str, Edit]:
    """Resolve ``edit`` for the scenes rendered, refusing names that are not among them."""
    resolved = dict(edit or {})
    for name in resolved:
        if name not in scenes:
            raise Refused(f"edit names scene {name!r}, which is not rendered ({', '.join(scenes)})")
    return resolved
