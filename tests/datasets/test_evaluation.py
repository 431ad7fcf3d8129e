"""Sets for evaluation alone: whatever name or file leads to them, nothing is chosen on them."""

from __future__ import annotations

import gzip
import shutil
from pathlib import Path

import pytest

from econgs_bench.bench.__main__ import main
from econgs_bench.datasets.catalogue import entries, open_dataset
from econgs_bench.datasets.catalogue.evaluation import check_choice
from econgs_bench.datasets.errors import DataError

HELD = {
    "boston_teapot", "carotid_flow", "engine_ct", "hydrogen_atom", "isabel_wind", "mesh_disk_out_ref",
    "mesh_fire_ug", "nucleon", "stent_ct", "stroke_mri", "viscous_fingers",
}  # fmt: skip


def test_the_catalogue_marks_them() -> None:
    assert {name for name in entries.built_in() if entries.entry(name).get("evaluation")} == HELD


@pytest.mark.data
@pytest.mark.parametrize("name", sorted(HELD))
def test_each_is_known_by_its_files(data_folder, name) -> None:
    with pytest.raises(DataError, match=f"{name} of the catalogue, which is for evaluation alone"):
        check_choice(open_dataset(name, [data_folder]))


@pytest.mark.data
def test_a_set_of_development_and_a_formula_may_choose(data_folder) -> None:
    check_choice(open_dataset("vortices@16"))
    check_choice(open_dataset("fuel", [data_folder]))


@pytest.mark.data
def test_other_names_and_files_of_scenes_do_not_hide_one(data_folder, tmp_path: Path) -> None:
    raw = data_folder / "nucleon" / "nucleon_41x41x41_uint8.raw"
    renamed = tmp_path / "mine_41x41x41_uint8.raw"
    shutil.copy(raw, renamed)
    packed = tmp_path / "packed_41x41x41_uint8.raw.gz"
    packed.write_bytes(gzip.compress(raw.read_bytes()))
    scenes = tmp_path / "my.toml"
    scenes.write_text(
        f"""[[files]]
path = "{packed.name}"
variable = "v"
[[scenes]]
name = "a"
variable = "v"
[[scenes.bumps]]
name = "a"
range = [0.2, 0.3, 0.5, 0.6]
color = [1.0, 0.0, 0.0]
opacity = 0.5
"""
    )
    for source in (renamed, packed, scenes, "nucleon+fuel"):
        with pytest.raises(DataError, match="nucleon of the catalogue"):
            check_choice(open_dataset(str(source)))


@pytest.mark.data
@pytest.mark.parametrize(
    "command",
    [["run", "quick", "--split", "val"], ["plan", "quick", "--split", "val"], ["tune", "3dgs", "quick"]],
)
def test_commands_that_choose_refuse_them(data_folder, command, tmp_path, capsys) -> None:
    assert main([*command, "--dataset", "nucleon", "--out", str(tmp_path / "runs")]) == 2
    error = capsys.readouterr().err
    assert "nucleon: is nucleon of the catalogue, which is for evaluation alone" in error
    assert "--split test" in error


@pytest.mark.data
def test_a_plan_on_test_views_takes_them(data_folder, tmp_path) -> None:
    assert main(["plan", "quick", "--dataset", "nucleon", "--out", str(tmp_path / "runs")]) == 0
