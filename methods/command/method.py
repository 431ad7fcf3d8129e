"""A method whose training and drawing are commands of another program."""

from __future__ import annotations

import fnmatch
import os
import re
import shutil
import stat
import tempfile
import uuid
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError, printable
from econgs_bench.datasets.names import unknown
from econgs_bench.datasets.png import open_picture, read_png
from econgs_bench.datasets.scene import RGB
from econgs_bench.datasets.view_folders import write_cameras, write_training
from econgs_bench.datasets.views import over
from econgs_bench.methods.command import process
from econgs_bench.methods.command.file import CommandFile, Step, filled, read_file
from econgs_bench.methods.gaussian_splatting.model import SceneGaussians, SplatModel
from econgs_bench.methods.gaussian_splatting.ply import read_any
from econgs_bench.methods.interface import (
    Budget,
    Checkpoint,
    Edit,
    Model,
    Monitor,
    Refused,
    SceneInput,
    edits_by_scene,
)
from econgs_bench.methods.options import BEYOND
from econgs_bench.methods.shared.edits import triple
from econgs_bench.methods.shared.sealed import read_facts, write_facts

FORMAT = "econgs-bench commands 1"
MOST_MODEL_FILES = 10_000
_FACTS, _FILES = "scene.json", "files"
_PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")


class Work:
    """A folder for files under way: one in a job's folder, or a temporary one.

    Attributes:
        path: the folder, which is removed by :meth:`close`, or with this object.
    """

    def __init__(self, scratch: Path | None) -> None:
        if scratch is None:
            self.path = Path(tempfile.mkdtemp(prefix="bench-command-"))
        else:
            scratch.mkdir(exist_ok=True)
            self.path = scratch / uuid.uuid4().hex[:8]
            self.path.mkdir()

    def close(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.path, ignore_errors=True)

    __del__ = close


class Programs:
    """The commands of a file, run with the right environment.

    Args:
        path: the TOML file.
        file: its content.
    """

    def __init__(self, path: Path, file: CommandFile) -> None:
        self.path, self.file = path, file
        self.scratch: Path | None = None
        self.last: process.Usage | None = None

    def run(
        self, name: str, step: Step, values: Mapping[str, str], device: str, work: Work, heard: Any = None
    ) -> process.Usage:
        """Run a step whose placeholders have values.

        Raises:
            DataError, MemoryError: as :func:`.process.run`.
        """
        self._check_places(device)
        command = filled(step.run, {**self._general(device), **values})
        usage = process.run(
            command,
            what=f"[{name}] of {self.path}",
            cwd=self._code(),
            variables=self._variables(device),
            timeout=step.timeout,
            folder=work.path,
            most_bytes=int(self.file.disk),
            device=device,
            heard=heard or (lambda line: None),
            logged=self.scratch is not None,
        )
        self.last = usage
        return usage

    def check(self, device: str) -> None:
        """Check that the environment is there.

        Raises:
            DataError: interpreter, folder or what its ``check`` looks for is missing.
        """
        self._check_places(device)
        if self.file.environment.check:
            process.run(
                filled(self.file.environment.check, self._general(device)),
                what=f"check of [environment] of {self.path}",
                cwd=self._code(),
                variables=self._variables(device),
                timeout=600.0,
                logged=self.scratch is not None,
            )

    def _check_places(self, device: str) -> None:
        what, code, python = f"[environment] of {self.path}", self._code(), self._general(device)["python"]
        if not code.is_dir():
            reason = f"the folder {code} is not there"
            raise DataError(what, reason, "Clone the program there, or correct `code`")
        if shutil.which(python, path=self._variables(device).get("PATH")) is None:
            reason = f"the interpreter {python} is not there"
            raise DataError(what, reason, "Make the environment, or correct `python`")

    def _code(self) -> Path:
        return (self.path.parent / Path(self.file.environment.code).expanduser()).resolve()

    def _variables(self, device: str) -> dict[str, str]:
        return process.environment(device, self.file.environment.variables)

    def _general(self, device: str) -> dict[str, str]:
        python = self.file.environment.python
        if os.sep in python:  # links of virtual environments must stay what they are
            python = os.path.normpath(self.path.parent / Path(python).expanduser())
        place = {"folder": str(self.path.parent), "code": str(self._code())}
        return {"python": python, "device": device.split(":")[0], **place}


@dataclass(frozen=True, eq=False)
class Frozen:
    """The files of a trained model, and what drawing needs beside them.

    Attributes:
        scene: its name.
        background: its recorded background.
        files: path below the model's folder -> content.
        options: of the placeholders that training had, and drawing has too: name -> value.
        count: primitives that its program told; 0 where it told none.
    """

    scene: str
    background: RGB
    files: Mapping[str, NDArray[np.uint8]]
    options: Mapping[str, str]
    count: int

    def facts(self) -> dict[str, Any]:
        """All but the files, as JSON values."""
        return {
            "format": FORMAT,
            "scene": self.scene,
            "background": list(self.background),
            "options": dict(self.options),
            "primitives": self.count,
            "files": self._sum(),
        }

    def save(self, folder: Path, rate: float | None) -> Mapping[str, Mapping[str, int]]:
        """Write the files, and a record of the rest; bytes by suffix.

        Raises:
            Refused: a rate is given.
        """
        if rate is not None:
            raise Refused("a model of another program has no rate knob for saving")
        ledger = {"metadata": write_facts(folder / _FACTS, self.facts())}
        self.write(folder / _FILES)
        for name, content in self.files.items():
            part = Path(name).suffix.lstrip(".") or "files"
            ledger[part] = ledger.get(part, 0) + len(content)
        return {self.scene: ledger}

    def write(self, folder: Path) -> None:
        """Write the files into a new folder."""
        folder.mkdir()
        for name, content in self.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            content.tofile(folder / name)

    @classmethod
    def read(cls, folder: Path) -> Frozen:
        """What :meth:`save` wrote.

        Raises:
            DataError: a file is missing or damaged.
        """
        try:
            about = read_facts(folder / _FACTS, FORMAT)
            background, count = triple(about["background"]), int(about["primitives"])
            files = {
                path.relative_to(folder / _FILES).as_posix(): np.fromfile(path, np.uint8)
                for path in sorted((folder / _FILES).rglob("*"))
                if path.is_file()
            }
            found = cls(str(about["scene"]), background, files, _texts(about["options"]), count)
            if found._sum() != about["files"]:
                raise ValueError("the checksum of its files differs")
        except (OSError, ValueError, KeyError, TypeError) as error:
            reason = f"no model of commands, or a damaged one ({error})"
            raise DataError(folder / _FACTS, reason, "Save the model again") from error
        return found

    def _sum(self) -> str:
        total = 0
        for name, content in sorted(self.files.items()):
            total = zlib.crc32(content.data, zlib.crc32(f"{name} {len(content)}\n".encode(), total))
        return f"{total:08x}"


class Pictures:
    """Views that a command drew (:class:`.methods.interface.DrawnViews`); read as they are asked for."""

    def __init__(self, files: Sequence[Path], background: RGB, work: Work) -> None:
        self._files, self._background, self._work = files, background, work
        self.frame_seconds: tuple[float, ...] = ()
        self.load_seconds: float | None = None
        self.peak_host_bytes: int | None = None
        self.peak_device_bytes: int | None = None

    def __getitem__(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        file = self._files[index]
        with open_picture(file) as image:
            has_alpha = image.has_transparency_data
        pixels = read_png(file)
        return over(pixels, self._background), pixels[..., 3] if has_alpha else None


class CommandModel:
    """A :class:`.methods.interface.Model` that a command draws, in a new folder with its files alone."""

    def __init__(self, frozen: Frozen, programs: Programs, device: str) -> None:
        self.frozen, self._programs, self._device = frozen, programs, device

    @property
    def scenes(self) -> tuple[str, ...]:
        """The only scene."""
        return (self.frozen.scene,)

    def primitives(self, scene: str | None = None) -> int:
        """As its program told; 0 where it told none."""
        self._check([scene] if scene is not None else None, None)
        return self.frozen.count

    def save(self, folder: Path, rate: float | None = None) -> Mapping[str, Mapping[str, int]]:
        """Write the model; see :meth:`Frozen.save`."""
        return self.frozen.save(folder, rate)

    def render(
        self,
        camera: Camera,
        scenes: Sequence[str] | None = None,
        edit: Mapping[str, Edit] | None = None,
        background: RGB | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """One view, by a process of its own; alpha is 1 where the picture has none."""
        rgb, alpha = self.draw_all([camera], scenes, edit, background)[0]
        alpha = np.ones(rgb.shape[:2], np.float32) if alpha is None else alpha
        return torch.from_numpy(rgb), torch.from_numpy(np.ascontiguousarray(alpha))

    def timings(self, camera: Camera, scenes: Sequence[str] | None = None) -> Mapping[str, float]:
        """None: the frames of another program are not timed here."""
        return {}

    def draw_all(
        self,
        cameras: Sequence[Camera],
        scenes: Sequence[str] | None = None,
        edit: Mapping[str, Edit] | None = None,
        background: RGB | None = None,
    ) -> Pictures:
        """Views by one process; see :class:`.methods.interface.DrawsTogether`.

        A frame that it times is one that its output tells by the pattern ``frame``.
        """
        self._check(scenes, edit)
        background = self.frozen.background if background is None else background
        with ExitStack() as stack:
            work = stack.enter_context(closing(Work(self._programs.scratch)))
            drawn = self._drawn(cameras, background, work)
            stack.pop_all()  # they are read from there
        return drawn

    def _drawn(self, cameras: Sequence[Camera], background: RGB, work: Work) -> Pictures:
        """Run the commands in a folder."""
        file, frozen, programs = self._programs.file, self.frozen, self._programs
        assert file.render is not None
        folders = {name: work.path / name for name in ("model", "cameras", "pictures")}
        frozen.write(folders["model"])
        for name in ("cameras", "pictures"):
            folders[name].mkdir()
        values = {name: str(folder) for name, folder in folders.items()}
        values |= dict(frozen.options)
        values |= {"background": _color(background)}
        loaded: process.Usage | None = None
        if file.load is not None:
            loaded = programs.run("load", file.load, values, self._device, work)
        write_cameras(folders["cameras"], file.views.format, cameras, None)
        times: list[float] = []
        pattern = re.compile(file.render.frame) if file.render.frame is not None else None

        def heard(line: str) -> None:
            if pattern is not None and (match := pattern.search(line)) is not None:
                times.append(_frame_seconds(match))

        usage = programs.run("render", file.render, values, self._device, work, heard)
        root, _, glob = file.render.pictures.partition("/")
        found = _pictures(folders[root.strip("{}")], glob, cameras, f"[render] of {programs.path}")
        drawn = Pictures(found, background, work)
        drawn.frame_seconds, drawn.load_seconds = tuple(times), loaded.seconds if loaded else None
        drawn.peak_host_bytes, drawn.peak_device_bytes = usage.host_bytes, usage.device_bytes
        return drawn

    def drawn_here(self) -> Model:
        """Its Gaussians, drawn by this program."""
        return GaussiansHere.of(self.frozen, self._programs, self._device)

    def _check(self, scenes: Sequence[str] | None, edit: Mapping[str, Edit] | None) -> None:
        for name in scenes or ():
            if name != self.frozen.scene:
                raise unknown("scene", name, self.scenes, of="this model")
        if any(one != Edit() for one in edits_by_scene(edit, self.scenes).values()):
            raise Refused("a model that another program draws cannot be edited")


class GaussiansHere(SplatModel):
    """The Gaussians that a program wrote as a PLY, drawn here as 3DGS draws them."""

    method = "gaussians of another program"
    frozen: Frozen

    @classmethod
    def of(cls, frozen: Frozen, programs: Programs, device: str) -> GaussiansHere:
        """The Gaussians among the files of a model.

        Raises:
            DataError: there are none, several, or they cannot be read.
        """
        what = f"gaussians of {programs.path}"
        (pattern,) = filled([programs.file.model.gaussians or ""], frozen.options)
        names = [name for name in frozen.files if pattern and _regex(pattern).fullmatch(name)]
        if len(names) != 1:
            reason = f"{len(names)} files of the model match {pattern}, not one"
            raise DataError(what, reason, "Name one file, which `files` of [model] has too")
        with closing(Work(programs.scratch)) as work:
            file = work.path / Path(names[0]).name
            frozen.files[names[0]].tofile(file)
            rows, degree, _ = read_any(file)
        model = cls([SceneGaussians.from_rows(frozen.scene, frozen.background, degree, rows, device)])
        model.frozen = frozen
        return model

    def save(self, folder: Path, rate: float | None = None) -> Mapping[str, Mapping[str, int]]:
        """Write the model; see :meth:`Frozen.save`."""
        return self.frozen.save(folder, rate)

    def gaussians(self, scene: SceneGaussians, camera: Camera, edit: Edit) -> Any:
        """Those of a scene; no edit can be made, as its own program makes none."""
        if edit != Edit():
            raise Refused("a model of another program cannot be edited")
        return super().gaussians(scene, camera, edit)


class CommandMethod:
    """The :class:`.methods.interface.Method` of a TOML file.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self._programs = Programs(path, read_file(path))
        self._views: dict[str, Work] = {}

    @property
    def scratch(self) -> Path | None:
        """Folder for files under way; None: temporary ones."""
        return self._programs.scratch

    @scratch.setter
    def scratch(self, folder: Path | None) -> None:
        self._programs.scratch = folder

    @property
    def peak_host_bytes(self) -> int | None:
        """Of the last program."""
        return self._programs.last.host_bytes if self._programs.last else None

    @property
    def peak_device_bytes(self) -> int | None:
        """Of the last program."""
        return self._programs.last.device_bytes if self._programs.last else None

    def partition(self, scenes: Sequence[SceneInput], options: Any) -> list[list[SceneInput]]:
        """Each scene on its own."""
        return [[scene] for scene in scenes]

    def prepare(self, group: Sequence[SceneInput], device: str) -> None:
        """Check the environment, and write the training views of a fit; nothing of test views.

        Raises:
            DataError: what the commands need is missing.
        """
        self._programs.check(device)
        for scene in group:
            work = Work(self.scratch)
            (work.path / "views").mkdir()
            views = self._programs.file.views
            definition = replace(scene.scene, background=scene.train.background)
            write_training(
                work.path / "views", views.format, scene.train, scene.cloud, definition, views.pictures
            )
            self._views[scene.name] = work

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
        """Run the command of training and keep the files of its model; an interrupted one begins anew.

        Raises:
            Refused: more than one scene, or no training views.
            DataError: the environment is missing, the command failed, or its files are missing or unusable.
        """
        if len(group) != 1:
            raise Refused("commands train each scene on its own")
        (scene,) = group
        if not len(scene.train):
            raise Refused("there are no training views")
        if scene.name not in self._views:
            self.prepare(group, device)
        with closing(self._views.pop(scene.name)) as work:
            frozen = self._trained(scene, asdict(options), budget, seed, device, monitor, work)
        model = self._model(frozen, device)

        def checkpoint() -> Checkpoint:
            facts = {name: value for name, value in frozen.facts().items() if name != "files"}
            arrays = {name: torch.from_numpy(content) for name, content in frozen.files.items()}
            return Checkpoint(budget.iterations, arrays, facts)

        monitor.progress(budget.iterations, {}, frozen.count)
        if monitor.due(budget.iterations):
            monitor.pause(budget.iterations, lambda: model, checkpoint)
        return model

    def _trained(
        self,
        scene: SceneInput,
        chosen: Mapping[str, Any],
        budget: Budget,
        seed: int,
        device: str,
        monitor: Monitor,
        work: Work,
    ) -> Frozen:
        """Run the command of training in a folder with views; the model's files."""
        programs, file = self._programs, self._programs.file
        out = work.path / "out"
        out.mkdir()
        background = scene.train.background
        kept = {"iterations": str(budget.iterations), "seed": str(seed), "scene": scene.name}
        kept |= {name: _written(value) for name, value in chosen.items()}
        values = {"views": str(work.path / "views"), "out": str(out), **kept}
        values |= {"background": _color(background)}
        pattern = re.compile(file.train.progress) if file.train.progress is not None else None
        count = 0

        def heard(line: str) -> None:
            nonlocal count
            if pattern is None or (match := pattern.search(line)) is None:
                return
            groups = match.groupdict()
            try:
                iteration = min(int(groups["iteration"]), budget.iterations)
                losses = {"loss": float(groups["loss"])} if groups.get("loss") else {}
                primitives = int(groups["primitives"]) if groups.get("primitives") else count
                if not 0 <= primitives < BEYOND:
                    return
                count = primitives
            except (ValueError, TypeError):  # a line that looks alike
                return
            monitor.progress(max(1, iteration), losses, count)

        monitor.stage("train")
        programs.run("train", file.train, values, device, work, heard)
        patterns = filled(file.model.files, kept)
        files = frozen_files(out, patterns, int(file.model.limit), f"[model] of {programs.path}")
        frozen = Frozen(scene.name, background, files, kept, count)
        if file.model.gaussians is not None:  # an unusable one is a fault of the fit
            gaussians = GaussiansHere.of(frozen, programs, "cpu")
            frozen = replace(frozen, count=gaussians.primitives())
        return frozen

    def restore(self, checkpoint: Checkpoint, options: Any, device: str) -> Model:
        """The model whose files a checkpoint holds."""
        facts = checkpoint.scalars
        files = {name: content.numpy() for name, content in checkpoint.arrays.items()}
        background = triple(facts["background"])
        frozen = Frozen(
            str(facts["scene"]), background, files, _texts(facts["options"]), int(facts["primitives"])
        )
        return self._model(frozen, device)

    def load(self, folder: Path, device: str) -> Model:
        """The model of a folder, drawn by its program, or here where it has none.

        Raises:
            DataError: a file is missing or damaged.
        """
        return self._model(Frozen.read(folder), device)

    def compose(self, models: Sequence[Model]) -> Model:
        """Refused: programs draw one model at a time.

        Raises:
            Refused: always.
        """
        raise Refused("models of another program do not render together")

    def _model(self, frozen: Frozen, device: str) -> Model:
        if self._programs.file.render is None:
            return GaussiansHere.of(frozen, self._programs, device)
        return CommandModel(frozen, self._programs, device)


def _texts(values: Any) -> dict[str, str]:
    """A table of texts.

    Raises:
        ValueError: it is none.
    """
    if not isinstance(values, dict) or not all(isinstance(one, str) for one in values.values()):
        raise ValueError("options that are no texts")
    return values


def _written(value: Any) -> str:
    """An option's value in a command."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _color(background: RGB) -> str:
    """A background in a command."""
    return ",".join(f"{one:g}" for one in background)


def _frame_seconds(match: re.Match[str]) -> float:
    """Seconds of a frame from a line of the output; not finite or positive: none."""
    units = {"seconds": lambda x: x, "milliseconds": lambda x: x / 1e3, "fps": lambda x: 1.0 / x}
    for name, text in match.groupdict().items():
        if text is not None:
            try:
                return float(units[name](float(text)))
            except (ValueError, ZeroDivisionError):
                break
    return float("nan")


def _regex(pattern: str) -> re.Pattern[str]:
    """A glob of paths as an expression: ``*`` stays within a folder, ``**`` is any folders, or all files."""
    *folders, last = PurePosixPath(pattern).parts
    parts = ["(?:[^/]+/)*" if one == "**" else _within(one) + "/" for one in folders]
    return re.compile("".join([*parts, ".+" if last == "**" else _within(last)]), re.DOTALL)


def _within(part: str) -> str:
    """A glob of one name as an expression."""
    text = fnmatch.translate(part).replace(".*", "[^/]*").replace("(?s:.)", "[^/]")
    return text.removesuffix("\\Z").removesuffix("\\z")


def _matching(folder: Path, pattern: str) -> Iterator[Path]:
    """What a glob matches below a folder, without folders; links are not followed.

    A linked folder is one of them where something below it would match.
    """
    expression = _regex(pattern)
    for root, folders, files in os.walk(folder):
        for name in sorted([*files, *folders]):
            path = Path(root, name)
            text = path.relative_to(folder).as_posix()
            linked = path.is_symlink() and name in folders
            if (name in files and expression.fullmatch(text)) or (
                linked and (expression.fullmatch(text) or expression.fullmatch(f"{text}/x"))
            ):
                yield path


def frozen_files(
    folder: Path, patterns: Sequence[str], limit: int, what: str
) -> dict[str, NDArray[np.uint8]]:
    """The files of a model: path below ``folder`` -> content.

    Args:
        folder: that training wrote into.
        patterns: of the files that belong to the model.
        limit: bytes of all of them.
        what: names it in errors.

    Raises:
        DataError: a pattern matches no file, or a link or what is no file; or they are too many or too large.
    """
    remedy = "Correct `files` in its TOML file, or the program"
    names: dict[str, int] = {}
    for pattern in patterns:
        found = list(_matching(folder, pattern))
        if not found:
            raise DataError(what, f"training wrote no file {pattern}", remedy)
        for path in found:
            name, about = path.relative_to(folder).as_posix(), path.lstat()
            if stat.S_ISLNK(about.st_mode):
                raise DataError(what, f"{printable(name)} is a link", remedy)
            if not stat.S_ISREG(about.st_mode) or not name.isprintable():
                raise DataError(what, f"{name!r} is no file of a model", remedy)
            names[name] = about.st_size
    if len(names) > MOST_MODEL_FILES or sum(names.values()) > limit:
        total = sum(names.values()) / 2**20
        reason = (
            f"{len(names)} files of {total:.1f} MiB, at most {MOST_MODEL_FILES} of {limit / 2**20:.1f} MiB"
        )
        raise DataError(what, reason, "Narrow `files`, or raise `limit`")
    return {name: np.fromfile(folder / name, np.uint8) for name in sorted(names)}


def _pictures(folder: Path, glob: str, cameras: Sequence[Camera], what: str) -> list[Path]:
    """The pictures that a command drew, one for each camera, by order of the numbers in their names.

    Raises:
        DataError: there are more or fewer, or one is a link, no picture, of another size or depth.
    """
    found = [path for path in _matching(folder, glob) if path.suffix.lower() in _PICTURES]
    if len(found) != len(cameras):
        raise DataError(
            what, f"drew {len(found)} pictures of {len(cameras)} ({glob})",
            "Draw each camera once; `pictures` says where",
        )  # fmt: skip
    found.sort(
        key=lambda path: [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", str(path))]
    )
    for path, camera in zip(found, cameras, strict=True):
        name = path.relative_to(folder)
        if path.is_symlink() or not path.is_file():
            raise DataError(what, f"the picture {name} is a link, or no file", "Write pictures")
        try:
            with open_picture(path) as image:
                size = image.size
                frames = getattr(image, "n_frames", 1)
        except (DataError, Image.DecompressionBombError) as error:
            raise DataError(
                what, f"the picture {name} cannot be read ({error})", "Write 8-bit PNG"
            ) from error
        if size != (camera.width, camera.height) or frames != 1:
            wrong = f"the picture {name} has {size[0]}x{size[1]} pixels, not {camera.width}x{camera.height}"
            raise DataError(what, wrong, "Draw pictures of the cameras' size")
        try:
            read_png(path)
        except DataError as error:
            reason = f"the picture {name} {error.reason}"
            raise DataError(what, reason, "Write 8-bit RGB or RGBA") from error
    return found
