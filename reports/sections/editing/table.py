"""Edited scenes beside the scenes that they were."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd


def with_bases(results: pd.DataFrame) -> pd.DataFrame:
    """Rows with two more columns.

    ``base``: the scene or composition without its edit; ``joint``: whether it is a composition.
    """
    pairs = zip(results["scene"], results["edit"].fillna(""), strict=True)
    base = [scene.removesuffix(f" {edit}") if edit else scene for scene, edit in pairs]
    composed = results[results["kind"] == "composed"]
    known = set(zip(composed["dataset"], composed["scene"], strict=True))
    joint = [pair in known for pair in zip(results["dataset"], base, strict=True)]
    return results.assign(base=base, joint=joint)
