"""SOG of PlayCanvas, version 2: images without loss and a table of contents, in one ZIP archive.

A pixel is a Gaussian. Positions have 16 bits after a logarithm, rotations three times 8, opacities 8; scales
and constant colors are words of codebooks of 256 numbers; the other coefficients one word of a palette, whose
numbers are words of a codebook of 256 again. Axes are those of a PLY.

Written from the published specification; the tests read it with the programs of others.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import torch
from numpy.typing import NDArray

from econgs_bench.datasets.bounded import json_of, opened, room
from econgs_bench.econgs.codebooks import nearest, quantise, quantise_scalars
from econgs_bench.econgs.codec.positions import PositionGrid, morton_order
from econgs_bench.methods.formats.gaussians import (
    COEFFICIENTS,
    SHAPES,
    Contents,
    Tables,
    checked,
    degree_of,
    tables,
)
from econgs_bench.methods.gaussian_splatting.model import SceneGaussians
from econgs_bench.methods.shared.decoders import check_count, decoded

SUFFIX = ".sog"
WORDS = 256
_PALETTE_WIDTH = 64  # words in a row of the palette's image
_PALETTE_LIMIT = 1 << 16
_PARTS = {"means": 2, "quats": 1, "scales": 1, "sh0": 1}
_LEAST = 1e-6  # opacities lie within this of 0 and 1
_CONTENTS = "meta.json"
_TIME = (1980, 1, 1, 0, 0, 0)
_ANTIALIASED = {"antialias": True, "model": "antialiased"}
"""That viewers shall compensate for their filter: as version 2 was published, and as viewers read it now."""

Bytes = NDArray[np.uint8]


def write(
    file: Path, scene: SceneGaussians, seed: int = 0, *, antialiased: bool = False
) -> Mapping[str, int]:
    """Write a scene, in Morton order; bytes by part.

    Args:
        file: where to.
        scene: its Gaussians.
        seed: of the palette's first words.
        antialiased: whether to say that viewers shall compensate for their filter.
    """
    values, degree = tables(scene), degree_of(scene)
    if len(scene):
        means = values["means"]
        order = morton_order(PositionGrid.box(means.min(0), means.max(0)).codes(means))
        values = {name: one[order] for name, one in values.items()}
    images: dict[str, Bytes] = {}
    about: dict[str, Any] = {"version": 2, "asset": {"generator": "econgs-bench"}, "count": len(scene)}
    about |= _ANTIALIASED if antialiased else {}

    logs = np.sign(values["means"]) * np.log1p(np.abs(values["means"].astype(np.float64)))
    low, high = (_rows(logs, bound) for bound in (np.min, np.max))
    whole = np.rint((logs - low) / np.where(high > low, high - low, 1.0) * 65535.0).astype(np.int64)
    images["means_l"], images["means_u"] = _image(whole & 255), _image(whole >> 8)
    about["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}

    words, ids = _codebook(values["log_scales"])
    images["scales"] = _image(ids)
    about["scales"] = {"codebook": words, "files": ["scales.webp"]}

    images["quats"] = _image(_pack(values["quats"]))
    about["quats"] = {"files": ["quats.webp"]}

    words, ids = _codebook(values["sh_dc"][:, 0])
    opacities = 1.0 / (1.0 + np.exp(-values["logits"].astype(np.float64)))
    images["sh0"] = _image(np.column_stack([ids, np.rint(255.0 * opacities)]))
    about["sh0"] = {"codebook": words, "files": ["sh0.webp"]}

    if degree and len(scene):
        rest = values["sh_rest"][:, : COEFFICIENTS[degree]].reshape(len(scene), -1)
        (palette,) = quantise(torch.from_numpy(rest), _palette_size(len(scene)), seed)
        words, ids = _codebook(palette.words.numpy())
        labels = palette.ids.numpy()
        images["shN_centroids"] = _palette_image(ids.reshape(len(ids), -1, 3))
        images["shN_labels"] = _image(np.column_stack([labels & 255, labels >> 8, 0 * labels]))
        about["shN"] = {
            "count": len(ids), "bands": degree, "codebook": words,
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }  # fmt: skip

    sizes: dict[str, int] = {}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:

        def add(name: str, data: bytes, method: int) -> int:
            entry = zipfile.ZipInfo(name, _TIME)
            entry.compress_type = method
            archive.writestr(entry, data)
            return archive.getinfo(name).compress_size

        for name, image in images.items():
            data = bytes(imagecodecs.webp_encode(image, lossless=True, level=6))
            sizes[name] = add(f"{name}.webp", data, zipfile.ZIP_STORED)
        text = json.dumps(about, separators=(",", ":")).encode()
        sizes["contents"] = add(_CONTENTS, text, zipfile.ZIP_DEFLATED)
    total = file.write_bytes(buffer.getvalue())
    return sizes | {"archive": total - sum(sizes.values())}


def read(file: Path) -> Contents:
    """Read a scene.

    Raises:
        DataError: the file is missing, damaged or of another kind.
    """

    def parsed() -> Contents:
        with zipfile.ZipFile(file) as archive:
            about = json_of(_member(archive, _CONTENTS))
            if about.get("version") != 2:
                raise ValueError(f"version {about.get('version')!r} instead of 2")
            check_count(int(about["count"]), file.stat().st_size)
            # Programs write one entry or the other; `model` is the newer, and can say more.
            model = about.get("model", "antialiased" if about.get("antialias") is True else "")
            return Contents(_tables(_images(archive, about), about), model == _ANTIALIASED["model"])

    return checked(file, "SOG", parsed)


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    """A member of an archive, unless it is far larger than what is stored of it."""
    info = archive.getinfo(name)
    if info.file_size > room(info.compress_size):
        raise ValueError(f"{name} of {info.file_size} bytes")
    with opened(archive, name) as member:
        return member.read()


def _images(archive: zipfile.ZipFile, about: Mapping[str, Any]) -> dict[tuple[str, int], Bytes]:
    """Part of the contents and place among its files -> pixels (height, width, 4)."""
    many = 8 * int(about["count"]) + (1 << 16)  # programs that write textures round their sides up
    names = {(part, place): many for part, files in _PARTS.items() for place in range(files)}
    if "shN" in about:
        names |= {("shN", 0): _PALETTE_LIMIT * COEFFICIENTS[int(about["shN"]["bands"])], ("shN", 1): many}
    files = [_member(archive, about[part]["files"][place]) for part, place in names]
    lengths, most = [len(data) for data in files], list(names.values())
    found = decoded("webp", b"".join(files), lengths=lengths, most=most)
    return {name: _with_alpha(found[str(place)]) for place, name in enumerate(names)}


def _tables(images: Mapping[tuple[str, int], Bytes], about: Mapping[str, Any]) -> Tables:
    count = int(about["count"])

    def pixels(part: str, number: int = 0, channels: int = 3) -> NDArray[np.int64]:
        image = images[part, number]
        flat = image.reshape(-1, image.shape[2])
        if count > len(flat):
            raise ValueError(f"{part} of {len(flat)} pixels for {count} Gaussians")
        return flat[:count, :channels].astype(np.int64)

    low, high = (np.asarray(about["means"][name], np.float64).reshape(3) for name in ("mins", "maxs"))
    whole = pixels("means") | pixels("means", 1) << 8
    logs = low + (high - low) * whole / 65535.0
    color = pixels("sh0", channels=4)
    opacities = np.clip(color[:, 3] / 255.0, _LEAST, 1.0 - _LEAST)
    rest = np.zeros((count, *SHAPES["sh_rest"]), np.float32)
    if "shN" in about:
        many = COEFFICIENTS[int(about["shN"]["bands"])]
        centroids = images["shN", 0]
        if centroids.shape[1] != _PALETTE_WIDTH * many:
            raise ValueError(f"a palette of {centroids.shape[1]} columns for {many} coefficients")
        palette = centroids[:, :, :3].reshape(-1, many, 3)
        labels = pixels("shN", 1)
        rest[:, :many] = _words(about["shN"])[palette[labels[:, 0] | labels[:, 1] << 8]]
    return {
        "means": (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32),
        "log_scales": _words(about["scales"])[pixels("scales")],
        "quats": _unpack(pixels("quats", channels=4)),
        "logits": np.log(opacities / (1.0 - opacities)).astype(np.float32),
        "sh_dc": _words(about["sh0"])[color[:, :3]].reshape(count, 1, 3),
        "sh_rest": rest,
    }


def _rows(values: NDArray[np.float64], bound: Any) -> NDArray[np.float64]:
    return np.asarray(bound(values, axis=0), np.float64) if len(values) else np.zeros(3)


def _words(part: Mapping[str, Any]) -> NDArray[np.float32]:
    words = np.asarray(part["codebook"], np.float32)
    if words.shape != (WORDS,):
        raise ValueError(f"a codebook of shape {words.shape}")
    return words


def _codebook(values: NDArray[np.float32]) -> tuple[list[float], NDArray[np.int64]]:
    """256 ascending words for all numbers of a table, and the word of each."""
    if not values.size:
        return [0.0] * WORDS, np.zeros(values.shape, np.int64)
    numbers = torch.from_numpy(values.reshape(-1, 1).copy())
    words = quantise_scalars(numbers, WORDS, seed=0).words[:, 0].sort().values
    ids = nearest(numbers, words[:, None]).reshape(values.shape)
    padded = torch.cat([words, words[-1:].expand(WORDS - len(words))])
    return padded.tolist(), ids.numpy()


def _palette_size(count: int) -> int:
    """Words of the palette: 1,024 times the largest power of 2 that the Gaussians fill, at most 65,536."""
    return int(min(_PALETTE_LIMIT, 1024 << max(0, (count // 1024).bit_length() - 1)))


def _image(values: NDArray[Any]) -> Bytes:
    """(height, width, 3 or 4) pixels of (N, 3 or 4) bytes; both sides are multiples of 4."""
    side = max(4, 4 * -(-int(np.ceil(np.sqrt(len(values)))) // 4))
    height = max(4, 4 * -(-len(values) // (4 * side)))
    image = np.zeros((height * side, values.shape[1]), np.uint8)
    image[:, 3:] = 255  # of pixels beyond the last Gaussian
    image[: len(values)] = values
    return image.reshape(height, side, -1)


def _palette_image(ids: NDArray[np.int64]) -> Bytes:
    """(height, 64 · coefficients, 3) pixels of (K, coefficients, 3) bytes."""
    words, many, _ = ids.shape
    height = -(-words // _PALETTE_WIDTH)
    image = np.zeros((height * _PALETTE_WIDTH, many, 3), np.uint8)
    image[:words] = ids
    return image.reshape(height, _PALETTE_WIDTH * many, 3)


def _with_alpha(image: Bytes) -> Bytes:
    if image.shape[2] == 3:
        image = np.concatenate([image, np.full((*image.shape[:2], 1), 255, np.uint8)], axis=2)
    return image


def _pack(quats: NDArray[np.float32]) -> NDArray[np.int64]:
    """(N, 4) bytes of unit quaternions: three times √2 in ±1, and 252 plus the place of the largest."""
    places = np.abs(quats).argmax(1)
    largest = np.take_along_axis(quats, places[:, None], 1)
    others = _others(places)
    three = np.take_along_axis(quats * np.where(largest < 0, -1.0, 1.0), others, 1) * np.sqrt(2.0)
    return np.column_stack([np.rint(np.clip(127.5 * three + 127.5, 0.0, 255.0)), 252 + places]).astype(
        np.int64
    )


def _unpack(pixels: NDArray[np.int64]) -> NDArray[np.float32]:
    """Inverse of :func:`_pack`."""
    places = pixels[:, 3] - 252
    if len(places) and places.min() < 0:
        raise ValueError("a rotation without the place of its largest number")
    three = (pixels[:, :3] / 127.5 - 1.0) / np.sqrt(2.0)
    quats = np.zeros((len(pixels), 4))
    np.put_along_axis(quats, _others(places), three, 1)
    rest = np.sqrt(np.maximum(0.0, 1.0 - np.square(three).sum(1)))
    np.put_along_axis(quats, places[:, None], rest[:, None], 1)
    return quats.astype(np.float32)


def _others(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N, 3) places among four other than one."""
    three = np.arange(3)[None]
    return three + (three >= places[:, None])
