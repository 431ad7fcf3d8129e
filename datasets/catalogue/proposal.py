"""The entry that ``bench scenes`` writes for a volume file: TOML with a comment for each key."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from threading import get_ident
from typing import Any

from econgs_bench.datasets.catalogue.files import FileField
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import BasicScene, Dataset
from econgs_bench.datasets.volume import Volume

_COLUMN = 46  # of the comments


def write_entry(dataset: Dataset, path: Path) -> None:
    """Write the automatic scenes of a volume file as an entry for people to edit.

    Args:
        dataset: dataset of a volume file (:func:`.datasets.catalogue.files.file_dataset`).
        path: TOML file; it must not exist.

    Raises:
        DataError: the file exists, or the entry cannot be written as text.
    """
    write_text("\n".join(_lines(dataset, path)) + "\n", path)


def write_text(text: str, path: Path, *, over: bool = False) -> None:
    """Write the text of an entry, whole or not at all, after a check of what it says.

    Args:
        text: TOML.
        path: the file.
        over: whether it may replace a file.

    Raises:
        DataError: the text is no entry, or the file exists or cannot be written.
    """
    from econgs_bench.datasets.catalogue.own import read_entry

    aside = path.with_name(f".{path.stem}.{os.getpid()}-{get_ident()}.toml")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        aside.write_text(text, encoding="utf-8")
        read_entry(aside)
        if over:
            os.replace(aside, path)
        else:
            os.link(aside, path)  # never over a file
    except FileExistsError as error:
        raise DataError(path, "exists already", "Name another file with --out") from error
    except UnicodeEncodeError as error:
        raise DataError(path, "cannot name its volume file, whose name is no text", "Rename it") from error
    except OSError as error:
        reason = f"cannot be written ({error.strerror})"
        raise DataError(path, reason, "Choose a folder that can be written") from error
    finally:
        aside.unlink(missing_ok=True)


def _lines(dataset: Dataset, path: Path) -> Iterator[str]:
    fields = [field for field in dataset.volumes.values() if isinstance(field, FileField)]
    frame = dataset.frame
    assert frame is not None
    yield f"# Scenes of {fields[0].request.path.name}, proposed by `bench scenes`."
    yield f"# Edit them, then look again:  bench scenes {path.name}"
    yield ""
    yield _line("title", quoted(f"scenes of {fields[0].request.path.name}"), "one line for reports")
    place = f"{{ centre = {_numbers(frame.centre)}, radius = {_number(frame.radius)} }}"
    yield "# Views show this sphere. The longest side of the volume is 1, its middle is 0."
    yield "# Without it the sphere follows what is visible, so that edits may move the cameras."
    yield _line("frame", place)
    for i, field in enumerate(fields):
        yield ""
        yield "[[files]]" if i else _comment("[[files]]", "one for each variable")
        yield from _file(field, path, first=not i)
    for i, scene in enumerate(dataset.scenes):
        yield ""
        yield from _scene(scene, dataset.volume(scene.variable), first=not i)
    compositions = {name: parts for name, parts in dataset.compositions.items() if name != "all"}
    yield ""
    yield "# Scenes shown together; `all` is there anyway."
    yield "[compositions]"
    for name, parts in compositions.items():
        yield f"{name} = {quoted(list(parts))}"
    if not compositions and len(dataset.scenes) > 1:
        yield f"# both = {quoted([scene.name for scene in dataset.scenes[:2]])}"


def _file(field: FileField, path: Path, *, first: bool) -> Iterator[str]:
    request = field.request
    file = Path(os.path.abspath(request.path))
    folder = Path(os.path.abspath(path.parent))
    beside = file.is_relative_to(folder)
    name = file.relative_to(folder).as_posix() if beside else str(file)
    yield _line(
        "path", quoted(name), "beside this file, absolute, or in a folder of BENCH_DATA" if first else ""
    )
    yield _line("variable", quoted(field.name), "its name in the scenes below" if first else "")
    if request.variable is not None:
        yield _line("array", quoted(request.variable), "its name in the file" if first else "")
    if request.step is not None:
        yield _line("step", str(request.step), "time step, from 0" if first else "")
    volume = field()
    if request.value_range is not None or volume.whole is not None:
        ends = request.value_range or volume.value_range
        words = 'least and greatest value: 0 and 1 below; or "all"' if first else ""
        yield _line("range", quoted(ends) if ends == "all" else f"[{ends[0]!r}, {ends[1]!r}]", words)
    if request.missing:
        text = ", ".join(map(repr, request.missing))
        yield _line("missing", f"[{text}]", "values that stand for missing data" if first else "")
    if request.resolution is not None:
        yield _line("resolution", str(request.resolution), "samples along the longest side" if first else "")


def _scene(scene: BasicScene, volume: Volume, *, first: bool) -> Iterator[str]:
    assert scene.transfer is not None

    def hint(words: str) -> str:
        return words if first else ""

    low, high = volume.value_range

    def unit(value: float) -> str:
        return f"{float(f'{low + value * (high - low):.4g}'):.10g}"

    yield _comment("[[scenes]]", hint("one transfer function"))
    yield _line("name", quoted(scene.name), hint("on command lines and in tables"))
    yield _line("variable", quoted(scene.variable), f"0 = {unit(0.0)}, 1 = {unit(1.0)}")
    if first:
        yield "# background = [1.0, 1.0, 1.0]               # white by default"
        yield "# light = { ambient = 0.4, diffuse = 0.7, specular = 0.2, shininess = 20.0 }   # default"
    for bump in scene.transfer.bumps:
        yield _comment("[[scenes.bumps]]", hint("values that are visible; add more for more colors"))
        yield _line("name", quoted(bump.name), hint("for people"))
        ends = (bump.start, bump.rise, bump.fall, bump.end)
        words = hint("opacity starts, is full, is full, ends: ") or "in units of the data: "
        yield _line("range", _numbers(ends), words + " ".join(unit(value) for value in ends))
        yield _line("color", _numbers(bump.color), hint("red, green, blue as displayed, 0 to 1"))
        yield _line("opacity", _number(bump.opacity), hint("over 1/100 of the longest side, below 1"))


def _line(key: str, value: str, comment: str = "") -> str:
    return _comment(f"{key} = {value}", comment)


def _comment(code: str, comment: str) -> str:
    return f"{code:<{_COLUMN}} # {comment}" if comment else code


def quoted(value: Any) -> str:
    """A string or a list of strings: what JSON writes is TOML too, but for one control character."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _number(value: float) -> str:
    return repr(round(float(value), 4))


def _numbers(values: tuple[float, ...]) -> str:
    return f"[{', '.join(map(_number, values))}]"
