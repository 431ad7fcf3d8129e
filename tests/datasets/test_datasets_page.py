"""docs/guide/data.md describes the catalogue, and its examples of entries are some."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType

import pytest

from econgs_bench.datasets.catalogue import entries, list_datasets
from econgs_bench.datasets.catalogue.opening import _scenes
from econgs_bench.datasets.catalogue.own import read_entry

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "guide" / "data.md").read_text(encoding="utf-8")
ROWS = {
    name: (samples, int(scenes))
    for name, samples, scenes in re.findall(r"^\| `(\w+)` \| (\S+) \| (\d+) \|", PAGE, re.M)
}


def test_every_entry_is_described(derived: ModuleType) -> None:
    assert not set(entries.names()) - {*ROWS, *re.findall(r"`(\w+)`", derived.procedural())}


@pytest.mark.parametrize("name", ROWS)
def test_rows_agree_with_the_catalogue(name: str) -> None:
    (info,) = [info for info in list_datasets([]) if info.name == name]
    samples, scenes = ROWS[name]
    expected = {"procedural": "any", "views": "views"}.get(
        info.kind, "\N{MULTIPLICATION SIGN}".join(map(str, info.dims or ()))
    )
    assert (samples, scenes) == (expected, len(info.scenes))


def test_the_examples_are_entries(tmp_path: Path) -> None:
    blocks = re.findall(r"```toml\n(.*?)```", PAGE, re.S)
    for i, block in enumerate(blocks):
        (tmp_path / f"{i}.toml").write_text(block, encoding="utf-8")
    least, whole, mapped = (read_entry(tmp_path / f"{i}.toml") for i in range(len(blocks)))
    assert [scene.name for scene in _scenes(least)] == ["metal"]
    assert [scene["transfer"] for scene in mapped["scenes"]] == ["map.json"]
    bone, surface = _scenes(whole)
    assert bone.transfer is not None
    assert bone.light is not None
    assert [level.value for level in surface.isosurfaces] == [0.15]
    # The defaults that it states are the defaults.
    assert (bone.light, bone.background, bone.depth_enhancement) == (
        surface.light, surface.background, surface.depth_enhancement,
    )  # fmt: skip
