"""From a name or a path to a dataset."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from econgs_bench.datasets.catalogue import entries
from econgs_bench.datasets.catalogue.entries import is_joined
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown

if TYPE_CHECKING:
    from econgs_bench.datasets.readers.limits import Limits
    from econgs_bench.datasets.scene import BasicScene, Dataset, Frame
    from econgs_bench.datasets.transfer import Bump, TransferFunction
    from econgs_bench.datasets.volume import Volume


def open_dataset(
    name_or_path: str | Path,
    data_dirs: Sequence[Path | str] | None = None,
    resolution: int | None = None,
) -> Dataset:
    """A dataset by its catalogue name, or from a volume file or a folder of pre-rendered views.

    Args:
        name_or_path: "vis_male"; "vortices" or "vortices@128"; a TOML file with scenes of your own; a volume
            file, which gets automatic transfer functions ("PATH:variable=T,step=3,resolution=256" selects a
            part of it); a folder of slices or DICOM files, or a Zarr store; or a folder of pre-rendered views
            (:mod:`.datasets.posed_images`), in itself or in one subfolder per scene.
            "beetle+argon_bubble" joins sets of the catalogue, so that one model can learn scenes of both.
        data_dirs: folders to search instead of ``BENCH_DATA`` and the user's data folder.
        resolution: samples per axis of a procedural volume (default 64).

    Raises:
        UnknownName: neither a name nor a path; the remedy lists near matches.
        DataError: its files are missing or unusable.
    """
    text = str(name_or_path)
    if not isinstance(name_or_path, Path) and is_joined(text):
        return _joined(text, [open_dataset(part, data_dirs) for part in text.split("+")])
    base, _, at = text.partition("@")
    if base in entries.names() and not isinstance(name_or_path, Path):
        table = entries.entry(base)
        if table["kind"] == "procedural":
            return _procedural(base, table, _resolution(text, at) if at else resolution)
        if resolution is not None or "@" in text:
            raise DataError(text, "only procedural volumes have a choice of resolution", f"Ask for {base}")
        return _from_catalogue(base, table, entries.folders_of(base, data_dirs), base)
    path = Path(text).expanduser()
    if path.suffix == ".toml":
        from econgs_bench.datasets.catalogue.own import read_entry

        name, table = entries.own_name(path.stem), read_entry(path)
        if table["kind"] == "procedural":
            return _procedural(name, table, resolution)
        folders = [path.resolve().parent, *entries.data_folders(data_dirs)]
        return _from_catalogue(name, table, folders, text)
    try:
        is_folder, exists = path.is_dir(), path.exists()
    except (OSError, ValueError):
        is_folder = exists = False
    from econgs_bench.datasets.catalogue.files import file_dataset
    from econgs_bench.datasets.readers import folder_kind, suffix_of
    from econgs_bench.datasets.readers.naming import split

    if is_folder and not folder_kind(path):
        return _views_folder(path)
    if exists or "/" in text or suffix_of(split(text)[0]) or path.suffix:
        return file_dataset(text)
    raise unknown("dataset", text, entries.names())


def _joined(name: str, members: Sequence[Dataset]) -> Dataset:
    """The scenes of several datasets as "DATASET.SCENE"; each keeps its own box and views."""
    from econgs_bench.datasets.scene import Dataset

    for member in members:
        if member.kind != "volume" or member.framing is not None:
            what = "was rendered elsewhere" if member.kind != "volume" else "has a frame of its own"
            raise DataError(name, f"{member.name} {what}", "Join volumes of `bench list datasets`")
    if len({member.name for member in members}) < len(members):
        raise DataError(name, "names a dataset twice", "Name each once")
    return Dataset(
        name,
        " + ".join(member.title for member in members),
        "volume",
        tuple(
            replace(scene, name=f"{member.name}.{scene.name}", variable=f"{member.name}.{scene.variable}")
            for member in members
            for scene in member.scenes
        ),
        {
            f"{member.name}.{composition}": tuple(f"{member.name}.{scene}" for scene in scenes)
            for member in members
            for composition, scenes in member.compositions.items()
        },
        {
            f"{member.name}.{variable}": volume
            for member in members
            for variable, volume in member.volumes.items()
        },
    )


def _resolution(text: str, at: str) -> int:
    if not re.fullmatch(r"[0-9]{1,6}", at):
        raise DataError(text, "no number follows the @", "Write vortices@128, say")
    return int(at)


def _procedural(name: str, table: dict[str, Any], resolution: int | None) -> Dataset:
    from econgs_bench.datasets import procedural
    from econgs_bench.datasets.ground_truth.sampling import samples_of
    from econgs_bench.datasets.scene import Dataset

    field = table.get("field", name)  # several entries may show one field
    usual = table.get("resolution") or procedural.default_resolution(field)
    n = procedural.check_resolution(field, resolution or usual)
    full = name if n == usual else f"{name}@{n}"

    @cache
    def together() -> dict[str, Volume]:  # variables share most of their computation
        return procedural.make_volumes(field, n)

    volumes: dict[str, Callable[[], Volume]] = {
        variable: partial(_one, together, variable) for variable in procedural.FIELDS[field]
    }
    samples = samples_of(table.get("samples", "auto"), f"dataset {name}")
    compositions = entries.compositions_of(table)
    framing = partial(_framing, table["frame"]) if "frame" in table else None
    return Dataset(full, table["title"], "volume", _scenes(table), compositions, volumes, framing, samples)


def _one(volumes: Callable[[], dict[str, Volume]], variable: str) -> Volume:
    return volumes()[variable]


def _from_catalogue(name: str, table: dict[str, Any], folders: Sequence[Path], request: str) -> Dataset:
    from econgs_bench.datasets.ground_truth.sampling import samples_of
    from econgs_bench.datasets.scene import BasicScene, Dataset

    paths: dict[str, Path] = {}
    for path in entries.paths_of(table):
        at = entries.locate(path, folders)
        if at is None:
            raise DataError(
                f"dataset {name}", f"{path} was not found", entries.remedy(request, table, folders)
            )
        paths[path] = at
    if table["kind"] == "views":
        scenes = tuple(
            BasicScene(Path(path).parent.name, views_folder=at.parent) for path, at in paths.items()
        )
        return Dataset(name, table["title"], "views", scenes)
    spacing = tuple(table["spacing"]) if "spacing" in table else None
    volumes = {f["variable"]: _reader(paths[f["path"]], f, spacing) for f in table["files"]}
    framing = None if name in entries.built_in() else partial(_framing, table.get("frame"))
    compositions = entries.compositions_of(table)
    samples = samples_of(table.get("samples", "auto"), f"dataset {name}")
    dataset = Dataset(name, table["title"], "volume", (), compositions, volumes, framing, samples)
    scenes = _scenes(table, partial(_mapped, dataset, folders))
    if name not in entries.built_in():
        for file in table["files"]:
            read = _reader(paths[file["path"]], file, spacing, None)
            scenes, volume = _without_outliers(scenes, file, read)
            if volume is not None:
                volumes[file["variable"]] = volume
    return replace(dataset, scenes=scenes)


def scenes_of(
    dataset: Dataset, tables: list[dict[str, Any]], folders: Sequence[Path]
) -> tuple[BasicScene, ...]:
    """Basic scenes, on a dataset's volumes, of tables from :func:`.datasets.catalogue.own.checked_scenes`.

    Raises:
        DataError: a map is not in one of the folders, or unusable.
    """
    return _scenes({"scenes": tables}, partial(_mapped, dataset, folders))


def _mapped(dataset: Dataset, folders: Sequence[Path], scene: dict[str, Any]) -> TransferFunction:
    """The transfer function of a scene that names a map of ParaView; its own values need the volume's."""
    from econgs_bench.datasets.transfer_maps import read_map, transfer_of

    path = entries.locate(scene["transfer"], folders)
    if path is None:
        where = ", ".join(map(str, folders))
        raise DataError(
            f"scene {scene['name']} of {dataset.name}",
            f"its map {scene['transfer']} was not found",
            f"Put it beside the TOML file, or into one of {where}",
        )
    values = None if scene.get("rescale") else dataset.volume(scene["variable"]).value_range
    chosen = read_map(path, scene.get("preset", ""))
    return transfer_of(chosen, scene["name"], values, scene.get("reference_length", 0.01))


def _framing(table: dict[str, Any] | None, dataset: Dataset) -> Frame:
    """The frame of an entry, else that of what its scenes show."""
    from econgs_bench.datasets.framing import visible_frame
    from econgs_bench.datasets.scene import Frame

    return Frame(tuple(table["centre"]), table["radius"]) if table else visible_frame(dataset)


def _limits(file: dict[str, Any], shown: Any) -> Limits:
    """Which values of a file an entry shows; ``shown`` where it does not say a range."""
    from econgs_bench.datasets.readers.limits import Limits

    ends, missing = file.get("range", shown), file.get("missing", [])
    given = (ends[0], ends[1]) if isinstance(ends, list | tuple) else ends
    return Limits(given, tuple(missing if isinstance(missing, list) else [missing]), "range" not in file)


_NARROW = 0.2
"""Share of a range within which all scenes of a volume lie if they mean what is left without outliers."""


def _without_outliers(
    scenes: tuple[BasicScene, ...], file: dict[str, Any], read: Callable[[], Volume]
) -> tuple[tuple[BasicScene, ...], Callable[[], Volume] | None]:
    """Scenes of a file without a ``range``, and the volume that they belong to if it is not the whole range.

    Without that key an entry's numbers are shares of the range of all values. Where outliers stretch it, the
    volume is read without them, and the numbers become shares of what is left.
    """
    mine = [scene for scene in scenes if scene.variable == file["variable"]]
    ends = [end for scene in mine for end in _ends(scene)]
    if "range" in file or not ends or max(ends) - min(ends) > _NARROW:
        return scenes, None
    volume = read()
    if volume.whole is None:
        return scenes, lambda: volume
    (low, high), (least, greatest) = volume.value_range, volume.whole

    def share(value: float) -> float:
        return (least - low + value * (greatest - least)) / (high - low)

    if all(share(max(_ends(scene))) < 0.0 or share(min(_ends(scene))) > 1.0 for scene in mine):
        return scenes, None  # the outliers are what the scenes show
    return tuple(_moved(scene, share) if scene in mine else scene for scene in scenes), lambda: volume


def _ends(scene: BasicScene) -> list[float]:
    bumps = scene.transfer.bumps if scene.transfer else ()
    return [end for b in bumps for end in (b.start, b.end)] + [s.value for s in scene.isosurfaces]


def _moved(scene: BasicScene, share: Callable[[float], float]) -> BasicScene:
    """A scene whose normalised values have become other shares."""
    surfaces = tuple(replace(surface, value=share(surface.value)) for surface in scene.isosurfaces)
    transfer = scene.transfer
    if transfer is not None:
        bumps = tuple(
            replace(b, start=share(b.start), rise=share(b.rise), fall=share(b.fall), end=share(b.end))
            for b in transfer.bumps
        )
        transfer = replace(transfer, bumps=bumps)
    return replace(scene, transfer=transfer, isosurfaces=surfaces)


def _reader(path: Path, file: dict[str, Any], spacing: Any, shown: Any = "all") -> Callable[[], Volume]:
    choice = {key: file.get(key) for key in ("array", "step", "resolution")}

    def read() -> Volume:
        from econgs_bench.datasets.readers import read_volume

        return read_volume(path, file["variable"], spacing=spacing, limits=_limits(file, shown), **choice)

    return read


def _scenes(
    table: dict[str, Any], mapped: Callable[[dict[str, Any]], TransferFunction] | None = None
) -> tuple[BasicScene, ...]:
    from econgs_bench.datasets.scene import WHITE, BasicScene, Isosurface, Light
    from econgs_bench.datasets.transfer import TransferFunction

    scenes = []
    for scene in table["scenes"]:
        transfer = None
        if "bumps" in scene:
            bumps = tuple(_bump(bump) for bump in scene["bumps"])
            transfer = TransferFunction(scene["name"], bumps, scene.get("reference_length", 0.01))
        elif "transfer" in scene and mapped is not None:
            transfer = mapped(scene)
        light = dict(scene.get("light", {}))
        if "direction" in light:
            light["direction"] = tuple(light["direction"])
        background = tuple(scene.get("background", WHITE))
        scenes.append(
            BasicScene(
                scene["name"],
                scene["variable"],
                transfer,
                Light(**light),
                background,
                isosurfaces=tuple(
                    Isosurface(**{**surface, "color": tuple(surface["color"])})
                    for surface in scene.get("isosurfaces", [])
                ),
                depth_enhancement=scene.get("depth_enhancement", 0.0),
            )
        )
    return tuple(scenes)


def _bump(table: dict[str, Any]) -> Bump:
    from econgs_bench.datasets.transfer import Bump

    start, rise, fall, end = table["range"]
    return Bump(table["name"], start, rise, fall, end, tuple(table["color"]), table["opacity"])


def _views_folder(path: Path) -> Dataset:
    from econgs_bench.datasets.catalogue.files import safe_name
    from econgs_bench.datasets.posed_images import NEEDED, holds_views
    from econgs_bench.datasets.scene import BasicScene, Dataset

    if holds_views(path):
        folders = [path]
    else:
        folders = sorted(f for f in path.iterdir() if f.is_dir() and holds_views(f))
    if not folders:
        raise DataError(
            path,
            "is a folder without pre-rendered views or a volume",
            f"It needs {NEEDED}, in itself or in each subfolder, or slices (.tif, .png)",
        )
    scenes = tuple(BasicScene(safe_name(f.resolve().name), views_folder=f.resolve()) for f in folders)
    name = path.resolve().name
    return Dataset(entries.own_name(safe_name(name)), f"pre-rendered views in {name}", "views", scenes)
