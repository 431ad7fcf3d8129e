"""Initial point clouds: from a volume and its transfer function, from a ``.ply`` file, or random."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.camera import Camera, looked_at
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import BasicScene, Dataset
from econgs_bench.datasets.transfer import TransferFunction
from econgs_bench.datasets.volume import Volume

_BATCH, _DRAWS = 20_000, 100
"""Points of a draw, and most draws, of a random start."""
_log = logging.getLogger(__name__)
_GRID = 255
"""The paper draws from a volume subsampled to less than 256 samples along each axis."""
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_REMEDY = "Write it as a binary little-endian PLY whose vertices have x y z and red green blue"


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points with colors.

    Attributes:
        points: (n, 3) float32, scene space.
        colors: (n, 3) float32, displayed sRGB in [0, 1].
    """

    points: NDArray[np.float32]
    colors: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class CloudSource:
    """Candidates of a scene's initial clouds, of which each number of points and seed takes some at random.

    Attributes:
        values: (n,) float32 normalised values of the candidates; None where ``colors`` decide.
        points: (n, 3) float32 positions, scene space; None for samples of a grid.
        colors: (n, 3) float32 colors of a cloud from a file; None where ``values`` decide.
        inside: (nz, ny, nx) bool, True at the n candidates of a grid that was subsampled.
        placement: (4, 3) low corner and side lengths of the volume's box, its dimensions, and the strides
            of subsampling, all along x, y, z.
    """

    values: NDArray[np.float32] | None = None
    points: NDArray[np.float32] | None = None
    colors: NDArray[np.float32] | None = None
    inside: NDArray[np.bool_] | None = None
    placement: NDArray[np.float64] | None = None

    def draw(self, scene: BasicScene, max_points: int, seed: int) -> PointCloud:
        """A cloud of at most ``max_points`` candidates (from a file: and one more).

        Raises:
            DataError: no candidate is visible.
        """
        generator = np.random.default_rng(seed)
        if self.points is not None and self.colors is not None:
            if len(self.points) <= max_points + 1:  # published clouds have 10,001
                return PointCloud(self.points, self.colors)
            indices = np.sort(generator.choice(len(self.points), max_points, replace=False))
            return PointCloud(self.points[indices], self.colors[indices])
        assert self.values is not None
        order = generator.permutation(len(self.values))
        if scene.transfer is None:
            indices = order[:max_points]
            levels = np.array([surface.value for surface in scene.isosurfaces])
            nearest = np.abs(self.values[indices, None] - levels).argmin(axis=1)
            colors = np.array([surface.color for surface in scene.isosurfaces], dtype=np.float64)[nearest]
        else:
            indices = order[: 2 * max_points]
            classified = scene.transfer.classify(self.values[indices])
            visible = classified[:, 3] > 0.0
            indices, colors = indices[visible][:max_points], classified[visible, :3][:max_points]
        if not len(indices):
            raise DataError(
                f"scene {scene.name}",
                "no voxel has opacity under its transfer function"
                if scene.transfer
                else "no voxel lies at its isosurfaces",
                "Move its bumps or levels to values that occur in the volume",
            )
        if self.points is not None:
            return PointCloud(self.points[indices], colors.astype(np.float32))
        assert self.inside is not None
        assert self.placement is not None
        low, sides, dims, strides = self.placement
        places = np.flatnonzero(self.inside)[indices]
        grid = np.stack(np.unravel_index(places, self.inside.shape), axis=-1)[:, ::-1] * strides
        points = low + grid * sides / (dims - 1)
        return PointCloud(points.astype(np.float32), colors.astype(np.float32))

    def save(self, file: Path) -> None:
        """Write the source for :meth:`load`."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        np.savez_compressed(file, **{name: array for name, array in arrays.items() if array is not None})

    @classmethod
    def load(cls, file: Path) -> CloudSource:
        """Read what :meth:`save` wrote.

        Raises:
            OSError, ValueError, zipfile.BadZipFile: the file is missing or damaged.
        """
        with np.load(file, allow_pickle=False) as archive:
            return cls(**archive)


def initial_cloud(
    dataset: Dataset, scene: BasicScene | str, max_points: int = 10_000, seed: int = 0
) -> PointCloud:
    """The cloud that training starts from: drawn from the :func:`cloud_source`.

    Raises:
        DataError: no voxel is visible, or the file is missing or unusable.
    """
    scene = dataset.scene(scene) if isinstance(scene, str) else scene
    return cloud_source(dataset, scene).draw(scene, max_points, seed)


def cloud_source(dataset: Dataset, scene: BasicScene) -> CloudSource:
    """The candidates of a scene's initial clouds.

    Voxels of non-zero opacity, of the volume subsampled to fewer than 256 samples an axis (section 10.1 of
    the method sheet: the paper's initialisation); of meshes, their own vertices. Of isosurfaces, voxels with
    a neighbour on the other side. Of pre-rendered scenes those of :func:`.datasets.posed_images.points_file`,
    else of COLMAP's model, else :func:`random_start`.

    Raises:
        DataError: the scene shows nothing of a volume, or the file is missing or cannot be used.
    """
    if scene.views_folder is not None:
        cloud = _points_of_views(scene.views_folder)
        return CloudSource(points=cloud.points, colors=cloud.colors)
    if scene.transfer is None and not scene.isosurfaces:
        what = f"{dataset.name}/{scene.name}"
        raise DataError(what, "the scene has no transfer function", "Give it one in the catalogue")
    volume = dataset.volume(scene.variable)
    if volume.vertices is not None and volume.vertex_values is not None and scene.transfer is not None:
        values = volume.normalise(volume.vertex_values)
        visible = _visible(scene.transfer, values)
        if visible.any():  # a bump may lie between the values of a coarse mesh's vertices
            return CloudSource(values=values[visible], points=volume.vertices[visible])
    strides = [-(-n // _GRID) for n in volume.values.shape]
    steps = tuple(slice(None, None, stride) for stride in strides)
    coarse = Volume(volume.name, volume.values[steps], volume.spacing, volume.value_range, volume.source)
    normalised = coarse.normalised()
    if scene.transfer is None:
        from econgs_bench.datasets.ground_truth.occlusion import beside_level

        inside = np.zeros(normalised.shape, dtype=bool)
        for surface in scene.isosurfaces:
            inside |= beside_level(normalised, surface.value)
    else:
        inside = _visible(scene.transfer, normalised)
    if volume.mask is not None:
        inside &= volume.mask[steps]
    placement = np.array([volume.box[0], volume.extent, volume.dims, strides[::-1]], dtype=np.float64)
    return CloudSource(values=normalised[inside], inside=inside, placement=placement)


def _points_of_views(folder: Path) -> PointCloud:
    from econgs_bench.datasets import colmap
    from econgs_bench.datasets.posed_images import points_file, read_frames

    if (file := points_file(folder)) is not None:
        return read_ply(file)
    model = colmap.model_of(folder)
    points = None if model is None else colmap.read_points(model)
    if points is not None:
        return PointCloud(*points)
    warn_of_views(folder)
    return random_start([camera for camera, _ in read_frames(folder, "train")])


@cache
def warn_of_views(folder: Path) -> None:
    """Say once what a folder of pre-rendered views lacks or has in vain, a line each."""
    from econgs_bench.datasets import colmap
    from econgs_bench.datasets.posed_images import POINTS, points_file, remarks

    model = colmap.model_of(folder)
    if points_file(folder) is None and (model is None or colmap.read_points(model) is None):
        _log.warning(
            "%s: no %s: methods start from random points in what its cameras see together", folder, POINTS
        )
    for remark in remarks(folder):
        _log.warning("%s", remark)


def random_start(cameras: Sequence[Camera], n: int = 100_000, seed: int = 0) -> PointCloud:
    """Points of random colors, uniform in what cameras see together, as many as 3DGS takes without a cloud.

    Where the pictures have less than a thousandth of the space between the cameras in common, those points
    count that are in at least half as many pictures as the best one.

    Args:
        cameras: at least one.
        n: number of points; fewer where hardly any place is seen.
        seed: of the random numbers.
    """
    generator = np.random.default_rng(seed)
    centre = looked_at(cameras)
    reach = float(np.mean([np.linalg.norm(camera.position - centre) for camera in cameras])) or 1.0
    low, high = centre - reach, centre + reach

    def draw() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        points = generator.uniform(low, high, (_BATCH, 3))
        return points, np.sum([camera.sees(points) for camera in cameras], axis=0)

    points, seen = draw()
    common = int((seen == len(cameras)).sum()) * 1000 >= _BATCH
    least = len(cameras) if common else (int(seen.max()) + 1) // 2
    rough = points[seen >= least]
    # The region reaches beyond its samples by about their distance.
    margin = np.ptp(rough, axis=0) / len(rough) ** (1 / 3) + 2.0 * reach / _BATCH ** (1 / 3)
    low, high = np.maximum(low, rough.min(axis=0) - margin), np.minimum(high, rough.max(axis=0) + margin)
    chosen: list[NDArray[np.float64]] = []
    while sum(map(len, chosen)) < n and len(chosen) < _DRAWS:
        points, seen = draw()
        chosen.append(points[seen >= least])
    places = np.concatenate(chosen)[:n].astype(np.float32)
    return PointCloud(places, generator.random(places.shape).astype(np.float32))


def _visible(transfer: TransferFunction, normalised: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Where a transfer function may give opacity; decided by table, so never False where it gives some."""
    steps = 65536
    table = transfer.classify(np.arange(steps + 1) / steps)[:, 3] > 0.0
    table[:-1] |= table[1:]
    return np.asarray(table[(normalised * steps).astype(np.int32)])


def random_cloud(n: int, half_extent: float, seed: int = 0) -> PointCloud:
    """Cloud of n points with random colors, uniform in the cube [-half_extent, half_extent]^3."""
    generator = np.random.default_rng(seed)
    points = generator.uniform(-half_extent, half_extent, (n, 3)).astype(np.float32)
    return PointCloud(points, generator.random((n, 3)).astype(np.float32))


def read_ply(path: Path | str) -> PointCloud:
    """Points and colors of a PLY's vertices (binary of either byte order, or ASCII); grey without colors.

    Raises:
        DataError: the file is missing, truncated or no PLY, or a vertex lacks finite x y z.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            encoding, count, fields = _read_header(file, path)
            vertices = _read_vertices(file, path, encoding, count, fields)
    except FileNotFoundError as error:
        raise DataError(path, "no such point cloud", "Check the path") from error
    except OSError as error:
        raise DataError(path, f"cannot be read ({error})", "Check the file and its permissions") from error
    points = np.stack([vertices[name].astype(np.float32) for name in "xyz"], axis=-1)
    if not np.isfinite(points).all():
        raise DataError(path, "a coordinate is not finite", _REMEDY)
    colors = np.full((count, 3), 0.5, dtype=np.float32)
    for channel, name in enumerate(("red", "green", "blue")):
        if name in (vertices.dtype.names or ()):
            values = vertices[name].astype(np.float32)
            colors[:, channel] = values / 255.0 if vertices.dtype[name].kind in "iu" else values
    if not (np.isfinite(colors).all() and colors.min(initial=0.0) >= 0.0 and colors.max(initial=0.0) <= 1.0):
        raise DataError(path, "a color is out of range", _REMEDY)
    return PointCloud(points, colors)


def _read_header(file: BinaryIO, path: Path) -> tuple[str, int, list[tuple[str, str]]]:
    """Format, number of vertices, and name and NumPy type of each vertex property."""
    if file.readline(64).strip() != b"ply":
        raise DataError(path, "is not a PLY file", _REMEDY)
    encoding, count, element = "", -1, ""
    fields: list[tuple[str, str]] = []
    for _ in range(1000):
        words = file.readline(4096).decode("ascii", errors="replace").split()
        match words:
            case ["end_header"]:
                break
            case ["format", kind, _]:
                encoding = kind
            case ["element", name, number]:
                if count < 0 and name != "vertex":
                    raise DataError(path, f"its first element is {name!r}, not vertex", _REMEDY)
                element = name
                if name == "vertex":
                    count = int(number) if number.isascii() and number.isdigit() and len(number) < 12 else -2
            case ["property", kind, name] if element == "vertex":
                if kind not in _TYPES or name in dict(fields):
                    raise DataError(path, f"property {name!r} of type {kind!r} is not understood", _REMEDY)
                fields.append((name, _TYPES[kind]))
            case ["property", *_] if element != "vertex":
                pass
            case ["comment" | "obj_info", *_]:
                pass
            case _:
                raise DataError(path, f"header line {' '.join(words)[:60]!r} is not understood", _REMEDY)
    else:
        raise DataError(path, "its header does not end", _REMEDY)
    if encoding not in ("ascii", "binary_little_endian", "binary_big_endian") or count < 1:
        raise DataError(path, "its header names no known format or no vertices", _REMEDY)
    if not {"x", "y", "z"} <= set(dict(fields)):
        raise DataError(path, "its vertices have no x, y, z", _REMEDY)
    return encoding, count, fields


def _read_vertices(
    file: BinaryIO, path: Path, encoding: str, count: int, fields: list[tuple[str, str]]
) -> np.ndarray:
    order = ">" if encoding == "binary_big_endian" else "<"
    dtype = np.dtype([(name, order + kind) for name, kind in fields])
    available = path.stat().st_size - file.tell()
    if count * (dtype.itemsize if encoding != "ascii" else 2 * len(fields) - 1) > available:
        raise DataError(
            path, f"is truncated: {available} bytes do not hold {count} vertices", "Copy it again"
        )
    if encoding != "ascii":
        return np.frombuffer(file.read(count * dtype.itemsize), dtype)
    vertices = np.zeros(count, dtype)
    for i in range(count):
        words = file.readline(4096).split()
        try:
            if len(words) != len(fields):
                raise ValueError("number of values")
            vertices[i] = tuple(
                float(w) if k[0] == "f" else int(w) for w, (_, k) in zip(words, fields, strict=True)
            )
        except (ValueError, OverflowError) as error:
            raise DataError(path, f"vertex {i} is not understood ({error})", _REMEDY) from error
    return vertices
