"""The metrics on any two folders of images."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.bench.metrics import METRICS
from econgs_bench.bench.metrics.image import FOREGROUND, Pair, scores, to_8bit
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.pictures import SUFFIXES
from econgs_bench.datasets.png import open_picture, read_png
from econgs_bench.datasets.views import over

if TYPE_CHECKING:
    import pandas as pd


def score(renders: Path, truth: Path, background: Sequence[float] = (1.0, 1.0, 1.0)) -> pd.DataFrame:
    """Compare images of the same file name (its ending may differ).

    Args:
        renders: folder of 8-bit images, RGB or RGBA with straight alpha.
        truth: the same.
        background: RGB in [0, 1] under images with alpha.

    Returns:
        One row per image and a last row "mean" (missing if any image's value is), with columns
        ``file``, the metrics, ``identical`` and ``reason``. Reasons that all images share are in the
        last row alone.

    Raises:
        DataError: a folder without images, a file without partner, sizes that differ, an unreadable file.
    """
    import pandas as pd

    ours, theirs = _images(renders), _images(truth)
    for images, partners, folder in ((ours, theirs, truth), (theirs, ours, renders)):
        alone = sorted(set(images) - set(partners))
        if alone:
            raise DataError(
                images[alone[0]],
                f"has no partner in {folder} ({len(alone)} of {len(images)} images without)",
                "Give the images of both folders the same names",
            )
    rows: list[dict[str, Any]] = []
    omissions = []
    for name, path in ours.items():
        pair = _pair(path, theirs[name], background)
        values, missing = scores(pair, METRICS)
        omissions.append(missing)
        rows.append({"file": path.name, **values, "identical": pair.identical})
    common = set.intersection(*(set(missing.items()) for missing in omissions))
    for row, missing in zip(rows, omissions, strict=True):
        row["reason"] = _reasons(missing.items() - common)
    table = pd.DataFrame(rows)
    table[list(METRICS)] = table[list(METRICS)].astype("Float64")
    total: dict[str, Any] = {
        "file": "mean",
        **{metric: table[metric].mean(skipna=False) for metric in METRICS},
        "identical": bool(table["identical"].all()),
        "reason": _reasons(dict.fromkeys(item for missing in omissions for item in missing.items())),
    }
    return pd.concat([table, pd.DataFrame([total]).astype(table.dtypes)], ignore_index=True)


def _reasons(missing: Iterable[tuple[str, str]]) -> str:
    """Each reason once, after the metrics that it concerns, in their order."""
    metrics: dict[str, list[str]] = {}
    for metric, why in sorted(missing, key=lambda item: list(METRICS).index(item[0])):
        metrics.setdefault(why, []).append(metric)
    return "; ".join(f"{', '.join(names)}: {why}" for why, names in metrics.items())


def _images(folder: Path) -> dict[str, Path]:
    """Stem -> file, sorted."""
    if not folder.is_dir():
        raise DataError(folder, "is no folder", "Give two folders of images")
    images: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in SUFFIXES or path.name.startswith("."):
            continue
        if path.stem in images:
            raise DataError(path, f"has the same name as {images[path.stem].name}", "Keep one of them")
        images[path.stem] = path
    if not images:
        raise DataError(folder, "holds no images", f"Known endings: {', '.join(sorted(SUFFIXES))}")
    return images


def _pair(render: Path, truth: Path, background: Sequence[float]) -> Pair:
    (a, a_has), (b, b_has) = _read(render), _read(truth)
    if a.shape != b.shape:
        raise DataError(
            render,
            f"is {a.shape[1]}x{a.shape[0]} pixels, but {truth} is {b.shape[1]}x{b.shape[0]}",
            "Render at the size of the ground truth: resizing would change the result",
        )
    colors = [to_8bit(over(image, (background[0], background[1], background[2]))) for image in (b, a)]
    # Alpha says where there is something; an image without it must not make everything foreground.
    covers = [image[..., 3] >= FOREGROUND for image, has in ((a, a_has), (b, b_has)) if has]
    foreground = np.logical_or.reduce(covers) if covers else None
    alphas = (to_8bit(b[..., 3]), to_8bit(a[..., 3])) if a_has and b_has else None
    return Pair(colors[0], colors[1], foreground, alphas)


def _read(path: Path) -> tuple[NDArray[np.float32], bool]:
    """Premultiplied RGBA, and whether the file has alpha."""
    with open_picture(path) as image:
        has_alpha = image.has_transparency_data
    return read_png(path), has_alpha
