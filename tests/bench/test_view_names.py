"""Views of the same file name in different folders: paired, kept and drawn one by one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from econgs_bench.bench.gate.cells import cells_of
from econgs_bench.bench.results.comparison import compared
from econgs_bench.bench.results.tables import build_tables
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.seals import sealed, unsealed
from econgs_bench.reports.sections.ladders.strips import views_of_jobs
from tests.bench.conftest import Bench, plan, suite_file, write_dataset


@pytest.fixture(scope="module")
def doubled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of a scene whose four test pictures are left/0000, right/0000, left/0001, right/0001."""
    folder = tmp_path_factory.mktemp("doubled")
    dataset = write_dataset(folder / "data")
    scene = dataset / "a"
    fields = json.loads((scene / "transforms_test.json").read_text())
    for i, frame in enumerate(fields["frames"]):
        name = f"test/{('left', 'right')[i % 2]}/{i // 2:04d}.png"
        (scene / name).parent.mkdir(exist_ok=True)
        (scene / frame["file_path"]).rename(scene / name)
        frame["file_path"] = name
    (scene / "transforms_test.json").write_text(json.dumps(fields))
    bench = Bench(folder, dataset)
    bench.run()
    return bench.store


def check(store: Path, names: list[str]) -> None:
    tables = build_tables(Store(store), write=False)
    views = tables["views"]
    assert views["view"].tolist() == names
    table = compared(views, views)
    assert table.attrs["views"] == 4
    assert set(table["views"]) <= {4}
    assert table[["difference", "least", "greatest"]].to_numpy().any() == 0
    (cell,) = cells_of(Store(store), tables).values()
    assert list(cell.views[0]) == names
    (own,) = views_of_jobs(views).values()
    assert list(own) == names
    assert [row["psnr"] for row in own.values()] == views["psnr"].tolist()


def test_a_view_is_its_path(doubled: Path) -> None:
    check(doubled, ["left/0000", "right/0000", "left/0001", "right/0001"])


def test_views_of_older_records_are_told_apart_by_their_order(doubled: Path) -> None:
    """Those of version 0.2 hold the stems."""
    (path,) = doubled.glob("jobs/measure-*/record.json")
    record = json.loads(unsealed(path.read_text()))
    before = path.read_text()
    for view in record["measure"]["views"]:
        view["view"] = view["view"].rpartition("/")[2]
    path.write_text(sealed(json.dumps(record)))
    try:
        check(doubled, ["0000 (1)", "0000 (2)", "0001 (1)", "0001 (2)"])
    finally:
        path.write_text(before)


@pytest.mark.parametrize("number", [1, 2, 13])
def test_a_number_of_views_that_no_cameras_have_ends_before_the_run(tmp_path: Path, number: int) -> None:
    sizes = "test_views = 2\nwidth = 8\nheight = 8\nprerendered_limit = 8"
    suite = suite_file(tmp_path, f'"shells@16" = ["core"]\n[presets.quick]\ntrain_views = {number}\n{sizes}')
    with pytest.raises(DataError, match=f"{number} training views.*nearest numbers"):
        plan(suite)
