"""Files of meshes: a JSON file per scene, and a Draco or PLY file per isosurface that viewers open."""

from __future__ import annotations

import json
import math
import re
import zlib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args
from urllib.parse import quote

import numpy as np

from econgs_bench.datasets.bounded import json_of
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import BasicScene, Isosurface, Light
from econgs_bench.methods.interface import Refused
from econgs_bench.methods.mesh.geometry import INSTALL, Mesh
from econgs_bench.methods.mesh.spec import Coding
from econgs_bench.methods.shared.decoders import decoded as decode
from econgs_bench.methods.shared.edits import triple
from econgs_bench.methods.shared.files import saved_files

FORMAT = "econgs-bench mesh 1"
SUFFIX = ".json"
_SUFFIXES: Mapping[Coding, str] = {"draco": ".drc", "ply": ".ply"}
_MOST_BITS = 30
_BEST = 10  # of Draco's levels of compression
_FACE = np.dtype([("count", "u1"), ("points", "<i4", 3)])
_HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\n"
    "property float z\nelement face {}\nproperty list uchar int vertex_indices\nend_header\n"
)
_HEADER_PATTERN = re.compile(_HEADER.replace("{}", r"(\d+)").encode())


def encoded(mesh: Mesh, coding: Coding, step: float) -> bytes:
    """The bytes of a mesh; none without triangles.

    Args:
        mesh: to be stored.
        coding: how.
        step: largest step of quantised positions, scene units.

    Raises:
        Refused: the package is missing.
    """
    if len(mesh) == 0:
        return b""
    if coding == "ply":
        faces = np.empty(len(mesh), _FACE)
        faces["count"], faces["points"] = 3, mesh.faces
        header = _HEADER.format(len(mesh.points), len(mesh)).encode()
        return header + mesh.points.astype("<f4").tobytes() + faces.tobytes()
    side = float(np.ptp(mesh.points, axis=0).max())
    bits = min(max(math.ceil(math.log2(side / step + 1.0)), 1), _MOST_BITS)
    data: bytes = _draco().encode(
        mesh.points, mesh.faces.astype(np.uint32), quantization_bits=bits, compression_level=_BEST
    )
    return data


def decoded(data: bytes, coding: Coding) -> Mesh:
    """The mesh of bytes that :func:`encoded` wrote.

    Raises:
        ValueError: they are none.
        Refused: the package is missing.
    """
    if not data:
        return Mesh.of(np.empty((0, 3)), np.empty((0, 3)))
    if coding == "ply":
        header = _HEADER_PATTERN.match(data)
        if header is None:
            raise ValueError("its header is not that of a stored mesh")
        points, faces = (int(count) for count in header.groups())
        if len(data) != header.end() + 12 * points + _FACE.itemsize * faces:
            raise ValueError(f"it has {len(data)} bytes, which are not {points} points and {faces} triangles")
        places = np.frombuffer(data, "<f4", 3 * points, header.end())
        mesh = Mesh.of(places, np.frombuffer(data, _FACE, faces, header.end() + 12 * points)["points"])
    else:
        arrays = decode("draco", data)
        mesh = Mesh.of(arrays["points"], arrays["faces"])
    if not np.isfinite(mesh.points).all():
        raise ValueError("its positions are not finite")
    if len(mesh) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.points):
        raise ValueError("its triangles name points that are not there")
    return mesh


def write_scene(folder: Path, scene: BasicScene, coding: Coding, surfaces: list[bytes]) -> dict[str, int]:
    """Write a scene; bytes by part.

    Args:
        folder: where to.
        scene: its definition; of it name, background, light and isosurfaces are stored.
        coding: of the surfaces.
        surfaces: encoded meshes of its isosurfaces, in order.
    """
    about = {
        "format": FORMAT,
        "scene": scene.name,
        "background": scene.background,
        "light": None if scene.light is None else asdict(scene.light),
        "coding": coding,
        "surfaces": [
            {**asdict(surface), "bytes": len(data), "crc32": zlib.crc32(data)}
            for surface, data in zip(scene.isosurfaces, surfaces, strict=True)
        ],
    }
    stem = quote(scene.name, safe=" ")
    size = (folder / f"{stem}{SUFFIX}").write_bytes(json.dumps(about, separators=(",", ":")).encode())
    triangles = 0
    for number, data in enumerate(surfaces):
        if data:
            triangles += _file(folder, stem, number, coding).write_bytes(data)
    return {"triangles": triangles, "metadata": size}


def read_folder(folder: Path) -> list[tuple[BasicScene, Coding, list[tuple[bytes, Mesh]]]]:
    """The scenes of a folder: definition, coding, and the stored and decoded mesh of each isosurface.

    Raises:
        DataError: no scene is there, or a file is missing, damaged or of another kind.
        Refused: a package is missing.
    """
    return [_read(file) for file in saved_files(folder, SUFFIX, "mesh")]


def _read(file: Path) -> tuple[BasicScene, Coding, list[tuple[bytes, Mesh]]]:
    try:
        about = json_of(file.read_bytes())
        if about["format"] != FORMAT:
            raise ValueError(f"format {about['format']!r} instead of {FORMAT!r}")
        coding: Coding = about["coding"]
        if coding not in get_args(Coding):
            raise ValueError(f"coding {coding!r}")
        light = None if about["light"] is None else _light(about["light"])
        surfaces = tuple(
            Isosurface(str(one["name"]), float(one["value"]), triple(one["color"]), float(one["opacity"]))
            for one in about["surfaces"]
        )
        background = triple(about["background"])
        scene = BasicScene(str(about["scene"]), light=light, background=background, isosurfaces=surfaces)
        sizes = [(int(one["bytes"]), int(one["crc32"])) for one in about["surfaces"]]
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise DataError(file, f"not a scene of meshes ({error})", "Save the model again") from error
    stored = []
    for number, (size, check) in enumerate(sizes):
        path = _file(file.parent, file.stem, number, coding)
        try:
            data = path.read_bytes() if size else b""
            if len(data) != size or zlib.crc32(data) != check:
                raise ValueError(f"its {len(data)} bytes are not the {size} that were stored")
            stored.append((data, decoded(data, coding)))
        except (OSError, ValueError) as error:
            raise DataError(path, f"not a stored mesh ({error})", "Save the model again") from error
    return scene, coding, stored


def _file(folder: Path, stem: str, number: int, coding: Coding) -> Path:
    return folder / f"{stem}.{number}{_SUFFIXES[coding]}"


def _light(about: Mapping[str, Any]) -> Light:
    numbers = {name: float(about[name]) for name in ("ambient", "diffuse", "specular", "shininess")}
    if about["model"] not in ("blinn-phong", "phong"):
        raise ValueError(f"light model {about['model']!r}")
    direction = None if about["direction"] is None else triple(about["direction"])
    return Light(direction, **numbers, model=about["model"])


def _draco() -> Any:
    try:
        import DracoPy
    except ImportError as error:
        raise Refused(f"DracoPy cannot be imported ({error}); {INSTALL}") from error
    return DracoPy
