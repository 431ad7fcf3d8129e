"""glTF 2.0 in one binary file, with Gaussians as the extension KHR_gaussian_splatting has them; write only.

Numbers are float32: positions, unit quaternions (x, y, z, w), standard deviations, opacities, coefficients of
spherical harmonics; colors of points stand in where the extension is not known. glTF's axes point left, up
and to the front.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.methods.formats.gaussians import COEFFICIENTS, LEFT_UP_FRONT, degree_of, tables
from econgs_bench.methods.gaussian_splatting.initialise import SH_C0
from econgs_bench.methods.gaussian_splatting.model import SceneGaussians

SUFFIX = ".glb"
EXTENSION = "KHR_gaussian_splatting"
_POINTS, _FLOAT, _BYTE, _ARRAY_BUFFER = 0, 5126, 5121, 34962
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write(file: Path, scene: SceneGaussians, *, antialiased: bool = False) -> Mapping[str, int]:
    """Write a scene; bytes by part. The format has no mark for ``antialiased``."""
    values, degree = tables(scene, LEFT_UP_FRONT), degree_of(scene)
    opacities = 1.0 / (1.0 + np.exp(-values["logits"]))
    shown = np.column_stack([0.5 + SH_C0 * values["sh_dc"][:, 0], opacities])
    attributes: dict[str, NDArray[Any]] = {
        "POSITION": values["means"],
        "COLOR_0": np.rint(255.0 * np.clip(shown, 0.0, 1.0)).astype(np.uint8),
        f"{EXTENSION}:ROTATION": np.roll(values["quats"], -1, axis=1),
        f"{EXTENSION}:SCALE": np.exp(values["log_scales"]),
        f"{EXTENSION}:OPACITY": opacities[:, None],
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": values["sh_dc"][:, 0],
    }
    for one in range(1, degree + 1):
        for place in range(2 * one + 1):
            coefficient = values["sh_rest"][:, COEFFICIENTS[one - 1] + place]
            attributes[f"{EXTENSION}:SH_DEGREE_{one}_COEF_{place}"] = coefficient
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    chunks: list[bytes] = []
    start = 0
    for name, table in attributes.items():
        colors = table.dtype == np.uint8
        data = np.ascontiguousarray(table if colors else table.astype("<f4")).tobytes()
        accessor: dict[str, Any] = {
            "bufferView": len(views), "componentType": _BYTE if colors else _FLOAT,
            "count": len(scene), "type": _TYPES[table.shape[1]],
        }  # fmt: skip
        if colors:
            accessor["normalized"] = True
        if name == "POSITION" and len(scene):
            accessor |= {"min": table.min(0).tolist(), "max": table.max(0).tolist()}
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(data), "target": _ARRAY_BUFFER})
        accessors.append(accessor)
        chunks.append(data)
        start += len(data)
    about = {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance", "projection": "perspective",
    }  # fmt: skip
    places = {name: place for place, name in enumerate(attributes)}
    primitive = {"attributes": places, "mode": _POINTS, "extensions": {EXTENSION: about}}
    contents = {
        "asset": {"version": "2.0", "generator": "econgs-bench"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": scene.name}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": start}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(contents, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(chunks)
    head = struct.pack("<III", 0x46546C67, 2, 12 + 8 + len(text) + 8 + len(binary))
    parts = [
        head,
        struct.pack("<II", len(text), 0x4E4F534A),
        text,
        struct.pack("<II", len(binary), 0x004E4942),
    ]
    total = file.write_bytes(b"".join([*parts, binary]))
    return {"tables": len(binary), "contents": total - len(binary)}
