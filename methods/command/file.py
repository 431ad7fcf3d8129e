"""The TOML file of a command plugin, checked when it is read, and the spec that it makes.

:func:`command_spec` is for packages too: an entry point may name ``SPEC = command_spec(FILE)``.
"""

from __future__ import annotations

import keyword
import re
from collections.abc import Mapping, Sequence
from dataclasses import make_dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.toml import read_toml
from econgs_bench.methods.interface import MethodSpec, OptionValue, RateKnob, option
from econgs_bench.methods.options import CONFIGURATION, DRAWN, ITERATIONS, SAMPLES

REMEDY = "Mend it: `bench new-method NAME --command` writes such a file, with a comment for each key"
GENERAL = ("python", "code", "device", "scene", "folder")
"""Placeholders of every command: those of ``[environment]``, the device, the scene, the file's own folder."""
OF_TRAIN = ("views", "out", "iterations", "seed", "background")
OF_RENDER = ("model", "cameras", "pictures", "background", "iterations", "seed")
OF_FILES = ("scene", "iterations", "seed")
_PLACEHOLDER = re.compile(r"\{([A-Za-z_]\w*)\}")
_UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}

Text = Annotated[str, Field(min_length=1)]


def _glob(text: str) -> str:
    path = PurePosixPath(text)
    if path.is_absolute() or ".." in path.parts or not path.parts or "\\" in text or "\0" in text:
        raise ValueError(f"{text!r} leads out of the folder; write a pattern below it, as point_cloud/**")
    return text


def _pattern(text: str) -> str:
    try:
        re.compile(text)
    except re.error as error:
        raise ValueError(f"{text!r} is no regular expression ({error})") from error
    return text


def _bytes(value: str | int) -> int:
    text = str(value).strip().upper().removesuffix("B").removesuffix("I")
    number, unit = text.rstrip("KMGT"), text.lstrip("0123456789.")
    try:
        size = int(float(number) * _UNITS[unit])
    except (ValueError, KeyError, OverflowError):
        size = 0
    if size < 1:
        raise ValueError(f"{value!r} is no size such as 500M or 2G")
    return size


Glob = Annotated[str, AfterValidator(_glob)]
Pattern = Annotated[str, AfterValidator(_pattern)]
Size = Annotated[str | int, AfterValidator(_bytes)]
Count = Annotated[int, Field(ge=1)]
Command = Annotated[list[str], Field(min_length=1)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Environment(_Part):
    """Where the commands run: interpreter, working folder, variables, and a command that must succeed."""

    python: Text = "python3"
    code: Text = "."
    variables: dict[str, str] = {}
    check: Command | None = None


class Views(_Part):
    """Files of the training views (:mod:`.datasets.view_folders`)."""

    format: Literal["blender", "colmap", "colmap-text"] = "blender"
    pictures: Literal["rgba", "composited"] | None = None


class Step(_Part):
    """A command with its limit of time in seconds."""

    run: Command
    timeout: Annotated[float, Field(gt=0.0)] | None = None


class Train(Step):
    """Training; groups of ``progress``: iteration, and loss and primitives, if the output has them."""

    progress: Pattern | None = None

    @model_validator(mode="after")
    def _names_the_iteration(self) -> Train:
        _check_groups("progress", self.progress, {"iteration"}, {"loss", "primitives"})
        return self


class Render(Step):
    """Drawing; ``frame`` finds the time of frames in the output: a group seconds, milliseconds or fps."""

    pictures: Text = "{pictures}/*.png"
    frame: Pattern | None = None

    @model_validator(mode="after")
    def _is_usable(self) -> Render:
        _check_groups("frame", self.frame, set(), {"seconds", "milliseconds", "fps"})
        if self.frame is not None and not re.compile(self.frame).groupindex:
            raise ValueError("frame has no group (?P<seconds>...), (?P<milliseconds>...) or (?P<fps>...)")
        root, _, rest = self.pictures.partition("/")
        if root not in ("{pictures}", "{model}") or not rest:
            raise ValueError("pictures begins with {pictures}/ or {model}/")
        _glob(rest)
        return self


class Model(_Part):
    """The files that the model consists of, which count: all else is gone when views are drawn.

    Patterns may hold options, {iterations}, {seed} and {scene}.
    """

    files: Annotated[list[Glob], Field(min_length=1)] = ["**"]
    limit: Size = 4 * 2**30
    gaussians: Glob | None = None


class OptionTable(_Part):
    """An option (:class:`.methods.interface.Option`)."""

    default: bool | int | float | str
    doc: Text
    minimum: float | None = None
    maximum: float | None = None
    choices: list[bool | int | float | str] = []


class Rate(_Part):
    """The option that draws the rate curve, with its values."""

    option: Text
    values: Annotated[list[float], Field(min_length=1)]


class Iterations(_Part):
    """Training iterations of the presets."""

    quick: Count
    standard: Count
    paper: Count


class CommandFile(_Part):
    """A method of commands."""

    name: Text
    title: str = ""
    version: Text
    reference: str = "none given"
    licence: str = ""
    source: str = ""
    commit: str = ""
    devices: Annotated[list[Literal["cpu", "cuda"]], Field(min_length=1)] = ["cpu"]
    hash: list[Glob] = []
    disk: Size = 64 * 2**30
    environment: Environment = Environment()
    views: Views = Views()
    iterations: Iterations
    options: dict[str, OptionTable] = {}
    presets: dict[Literal["quick", "standard", "paper"], dict[str, bool | int | float | str]] = {}
    rate: Rate | None = None
    train: Train
    model: Model = Model()
    load: Step | None = None
    render: Render | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> CommandFile:
        taken = {*GENERAL, *OF_TRAIN, *OF_RENDER, ITERATIONS, CONFIGURATION, SAMPLES, DRAWN}
        for name in self.options:
            if not name.isidentifier() or keyword.iskeyword(name) or name in taken:
                raise ValueError(f"the option name {name!r} is taken, or no name: letters, digits and _")
        if self.render is None and self.model.gaussians is None:
            raise ValueError("nothing draws the model: add [render], or gaussians in [model]")
        if self.rate is not None and self.rate.option not in self.options:
            raise ValueError(f"[rate] names the option {self.rate.option!r}, which [options] lacks")
        environment = self.environment.check or []
        for glob in (*self.model.files, self.model.gaussians or ""):
            known = [*OF_FILES, *self.options]
            if unknown := sorted(placeholders([glob]) - set(known)):
                raise ValueError(f"[model] has the placeholder {{{unknown[0]}}}; known: {', '.join(known)}")
        for what, run, own, needed in (
            ("environment", environment, (), ()),
            ("train", self.train.run, OF_TRAIN, ("views", "out")),
            ("load", self.load.run if self.load else [], ("model", "iterations", "seed"), ()),
            ("render", self.render.run if self.render else [], OF_RENDER, ("model", "cameras")),
        ):
            options = [] if what == "environment" else list(self.options)
            known = [*GENERAL, *own, *options]
            found = placeholders(run)
            if unknown := sorted(found - set(known)):
                raise ValueError(f"[{what}] has the placeholder {{{unknown[0]}}}; known: {', '.join(known)}")
            if run and (absent := sorted(set(needed) - found)):
                raise ValueError(f"the command of [{what}] lacks {{{absent[0]}}}")
        return self


def _check_groups(key: str, pattern: str | None, needed: set[str], known: set[str]) -> None:
    groups = set(re.compile(pattern).groupindex) if pattern is not None else needed
    if not needed <= groups or groups - needed - known:
        named = ", ".join(f"(?P<{name}>...)" for name in sorted(needed | known))
        raise ValueError(f"{key} has other groups than {named}")


def placeholders(run: list[str]) -> set[str]:
    """Names in braces of a command."""
    return {name for word in run for name in _PLACEHOLDER.findall(word)}


def filled(run: Sequence[str], values: Mapping[str, str]) -> list[str]:
    """A command with values in the place of its placeholders; other braces stay."""
    return [_PLACEHOLDER.sub(lambda match: values.get(match[1], match[0]), word) for word in run]


def read_file(path: Path) -> CommandFile:
    """The checked content of a file.

    Raises:
        DataError: as :func:`.datasets.toml.read_toml`.
    """
    parts: list[type[BaseModel]] = [*_Part.__subclasses__(), *Step.__subclasses__()]
    keys = {key for part in parts for key in part.model_fields}
    return read_toml(path, CommandFile, REMEDY, sorted(keys))


def command_spec(path: Path | str) -> MethodSpec:
    """The spec of a command plugin.

    Args:
        path: its TOML file.

    Raises:
        DataError: the file, an option or a file to hash is unusable.
    """
    path = Path(path).resolve()
    file = read_file(path)
    declared = [_option(path, name, table) for name, table in file.options.items()]
    drawn = file.render is not None and file.model.gaussians is not None
    return MethodSpec(
        name=file.name,
        title=file.title or file.name,
        reference=file.reference,
        version=file.version,
        implementation="econgs_bench.methods.command.method:CommandMethod",
        source=("econgs_bench.methods.command",),
        files=(path, *_hashed(path, file.hash)),
        uses_alpha=f"its own program decides; pictures are {_pictures(file.views)}",
        iterations=file.iterations.model_dump(),
        devices=tuple(file.devices),
        options=make_dataclass("Options", declared, frozen=True),
        presets={preset: _typed(path, file, values) for preset, values in file.presets.items()},
        rate_knobs=() if file.rate is None else (RateKnob(file.rate.option, tuple(file.rate.values), True),),
        resumable=False,
        drawn_here=drawn,
    )


def _pictures(views: Views) -> str:
    kind = views.pictures or ("rgba" if views.format == "blender" else "composited")
    return "RGBA" if kind == "rgba" else "composited on the background"


def _option(path: Path, name: str, table: OptionTable) -> tuple[str, Any, Any]:
    """Name, type and field of an option."""
    default: Any = table.default
    kind: Any = type(default)
    if table.choices:
        if default not in table.choices or any(type(one) is not kind for one in table.choices):
            raise DataError(path, f"options.{name}: the default is none of its choices", REMEDY)
        kind = Literal[tuple(table.choices)]
    return name, kind, option(default, table.doc, minimum=table.minimum, maximum=table.maximum)


def _typed(path: Path, file: CommandFile, values: dict[str, Any]) -> dict[str, OptionValue]:
    """Values of a preset; whole numbers do for floats."""
    return {
        name: float(value) if name in file.options and type(file.options[name].default) is float else value
        for name, value in values.items()
    }


def _hashed(path: Path, patterns: list[str]) -> list[Path]:
    """The files that count for the hash of the method."""
    found: list[Path] = []
    for pattern in patterns:
        matches = sorted(one for one in path.parent.glob(pattern) if one.is_file())
        if not matches:
            raise DataError(path, f"hash: no file {pattern} beside it", "Correct the pattern")
        found += matches
    return list(dict.fromkeys(found))
