"""Transfer functions under the mouse: what is dragged is seen, undone, saved and opened again."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from econgs_bench.bench.view.server import Server, Viewer
from econgs_bench.bench.view.sources import Source, camera_json, found
from econgs_bench.datasets.catalogue import open_dataset
from tests.bench.view.conftest import CAMERAS, HOSTILE, serving
from tests.bench.view.test_page import LEAST, SOFTWARE, WHITE, Page, psnr
from tests.bench.view.test_server import ask
from tests.reports.page.browser import executable

BUMP = {"name": "shell", "range": [0.3, 0.4, 0.5, 0.6], "color": [0.8, 0.2, 0.1], "opacity": 0.3}
TABLES = [{"name": "ball", "variable": "density", "bumps": [BUMP]}]


@pytest.fixture(scope="module")
def server(entry: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """The entry, saved elsewhere than it is; a formula; and the volume by itself."""
    names = [str(entry), "vortices@16", str(entry.parent / "data/ball_24x24x24_uint8.raw")]
    sources: list[Source] = found(names, entry.parent, (), "cpu")
    with serving(*sources) as running:
        running.viewer.folder = tmp_path_factory.mktemp("start").resolve() / "folder"
        running.viewer.folder.mkdir()
        yield running


def saved(server: Server, name: str, source: int = 0, tables=TABLES, **more):
    return ask(server, "save", source=source, tables=tables, name=name, **more)


def test_counts_are_those_of_the_samples(server: Server, entry: Path) -> None:
    status, answer = ask(server, "histogram", source=0, variable="density")
    values = open_dataset(str(entry)).volume("density").values.astype(float)
    assert (status, answer["range"]) == (200, [values.min(), values.max()])
    own = np.histogram(values, 256, (values.min(), values.max()))[0]
    assert np.abs(np.cumsum(own) - np.cumsum(answer["counts"])).max() <= own.max()
    assert answer["counts"].sum() == answer["density"].sum() == values.size
    columns = np.histogram(values, 128, (values.min(), values.max()))[0]
    assert np.abs(answer["density"].sum(axis=0) - columns).max() <= 0.01 * values.size


def test_a_saved_file_holds_the_scenes_and_finds_its_volume(server: Server, entry: Path) -> None:
    status, answer = saved(server, "one.toml", edits=["ball.palette=#00ff00"])
    assert (status, answer.get("command")) == (200, "bench run quick --dataset one.toml"), answer
    path = server.viewer.folder / "one.toml"
    assert path.read_text() == answer["text"]
    assert [one.name for one in path.parent.glob("*one*")] == ["one.toml"]
    old, new = open_dataset(str(entry)), open_dataset(str(path))
    (bump,) = new.scene("ball").transfer.bumps
    assert [bump.start, bump.rise, bump.fall, bump.end, bump.opacity] == [*BUMP["range"], 0.3]
    assert bump.color == pytest.approx((0.0, 1.0, 0.0), abs=1e-6)
    assert new.frame == old.frame
    assert new.volume("density").value_range == old.volume("density").value_range
    assert new.compositions == {}  # of scenes that are gone

    # The tables as they were opened make the same scenes; in units and places of the page.
    tables = ask(server, "open", source=0)[1]["tables"]
    assert saved(server, "same.toml", tables=tables)[0] == 200
    same = open_dataset(str(path.with_name("same.toml")))
    assert same.scenes == old.scenes
    assert same.compositions == old.compositions


def test_a_file_is_replaced_only_when_asked(server: Server) -> None:
    path = server.viewer.folder / "kept.toml"
    path.write_text("mine")
    assert saved(server, "kept.toml")[1] == {"exists": True}
    assert path.read_text() == "mine"
    assert saved(server, "kept.toml", over=True)[0] == 200
    assert "shell" in path.read_text()


@pytest.mark.parametrize(
    "name",
    [
        "../out.toml",
        "/tmp/T-out.toml",
        "a/b.toml",
        "a\\b.toml",
        ".x.toml",
        "x.toml\n",
        "x",
        "",
        HOSTILE,
        "\0.toml",
    ],
)
def test_names_that_lead_out_are_refused(server: Server, name: str) -> None:
    before = sorted(server.viewer.folder.parent.rglob("*"))
    status, answer = saved(server, name)
    assert (status, "is no name of a file" in answer["error"]) == (400, True)
    assert sorted(server.viewer.folder.parent.rglob("*")) == before


def test_bad_scenes_get_one_sentence(server: Server) -> None:
    for tables, words in (
        ([{**TABLES[0], "name": HOSTILE}], "name"),
        ([{**TABLES[0], "bumps": []}], "neither bumps nor isosurfaces"),
        ([{**TABLES[0], "bumps": [{**BUMP, "range": [0.5, 0.4, 0.6, 0.7]}]}], "does not ascend"),
        ([{**TABLES[0], "bumps": [{**BUMP, "opacity": 1.5}]}], "opacity"),
        ([{**TABLES[0], "variable": "pressure"}], "no file has"),
        (TABLES * 2, "occurs twice"),
        ([{"name": "m", "variable": "density", "transfer": "/etc/passwd"}], "leads out"),
        ([{"name": "m", "variable": "density", "transfer": "../m.json"}], "leads out"),
        ("x", "list"),
        ([7], "scenes"),
    ):
        request = {"source": 0, "tables": tables, "camera": camera_json(CAMERAS[0]), "background": WHITE}
        for status, answer in (ask(server, "picture", **request), saved(server, "bad.toml", tables=tables)):
            assert (status, words in answer["error"], "\n" in answer["error"]) == (400, True, False), answer
    assert not (server.viewer.folder / "bad.toml").exists()


def test_scenes_of_a_formula_are_saved_with_its_name(server: Server) -> None:
    tables = ask(server, "open", source=1)[1]["tables"]
    tables[0]["bumps"][0]["opacity"] = 0.25
    assert saved(server, "formula.toml", 1, tables)[0] == 200
    old, new = open_dataset("vortices@16"), open_dataset(str(server.viewer.folder / "formula.toml"))
    assert new.volume("vortices").source == old.volume("vortices").source
    assert (new.frame, new.scenes[1:], new.compositions) == (None, old.scenes[1:], old.compositions)
    assert new.scenes[0].transfer.bumps[0].opacity == 0.25


def test_proposals_of_a_bare_volume_are_saved(server: Server) -> None:
    variable = ask(server, "open", source=2)[1]["variables"][0]
    tables = ask(server, "propose", source=2, variable=variable)[1]["tables"]
    assert saved(server, "bare.toml", 2, tables)[0] == 200
    opened, again = server.viewer.sources[2].open(), open_dataset(str(server.viewer.folder / "bare.toml"))
    assert [one.name for one in again.scenes] == list(opened.scenes)
    for scene in again.scenes:
        for bump, own in zip(
            scene.transfer.bumps, opened.definitions[scene.name].transfer.bumps, strict=True
        ):
            assert [bump.start, bump.rise, bump.fall, bump.end] == pytest.approx(
                [own.start, own.rise, own.fall, own.end], abs=1e-6
            )


def test_maps_of_paraview_are_kept_by_name(server: Server, entry: Path) -> None:
    chart = {"Name": "m", "ColorSpace": "RGB", "RGBPoints": [0.0, 1.0, 0.0, 0.0, 199.0, 0.0, 0.0, 1.0]}
    (entry.parent / "map.json").write_text(json.dumps([chart]))
    tables = [*TABLES, {"name": "mapped", "variable": "density", "transfer": "map.json", "rescale": True}]
    opened = server.viewer.sources[0].open().defined(tables)
    assert saved(server, "mapped.toml", tables=tables)[0] == 200
    path = server.viewer.folder / "mapped.toml"
    assert open_dataset(str(path)).scene("mapped") == opened.definitions["mapped"]
    assert "bumps" not in found([str(path)], path.parent, (), "cpu")[0].open().editable.tables[1]
    tables[1]["transfer"] = "none.json"
    status, answer = saved(server, "unmapped.toml", tables=tables)
    assert (status, "was not found" in answer["error"]) == (400, True)


# --------------------------------------------------------------------------- in a browser


def pull(page: Page, corner: int, dx: int, dy: int) -> None:
    """Drag a corner of the first bump or isosurface, or with -1 the body of the bump."""
    page.run("document.getElementById('curve').scrollIntoView()")
    corners = page.run("bench.corners(0)")
    left, top = page.run(
        "(() => { const r = document.getElementById('curve').getBoundingClientRect();"
        "const e = document.getElementById('curve'); return [r.x + e.clientLeft, r.y + e.clientTop]; })()"
    )
    x, y = corners[corner] if corner >= 0 else np.mean(corners, axis=0).tolist()
    common = {"button": "left", "buttons": 1, "clickCount": 1}
    x, y = x + left, y + top
    page.call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **common)
    for n in range(1, 5):
        page.call("Input.dispatchMouseEvent", type="mouseMoved", x=x + dx * n / 4, y=y + dy * n / 4, **common)
    page.call("Input.dispatchMouseEvent", type="mouseReleased", x=x + dx, y=y + dy, **common)


def control_z(page: Page, *, shift: bool = False) -> None:
    common = {"key": "z", "windowsVirtualKeyCode": 90, "modifiers": 10 if shift else 2}
    page.call("Input.dispatchKeyEvent", type="rawKeyDown", **common)
    page.call("Input.dispatchKeyEvent", type="keyUp", **common)


@pytest.mark.skipif(executable() is None, reason="no Chromium here")
def test_dragged_seen_undone_and_saved(tmp_path: Path, server: Server) -> None:
    with Page(tmp_path / "profile", *SOFTWARE) as page:
        page.emulate(1000, 800)
        page.open(server.address)
        page.settled()
        page.until("document.getElementById('low').textContent === '0'")
        plain, first = page.canvas().astype(int), page.run("bench.tables()[0].bumps[0]")
        assert first == BUMP
        pull(page, 2, 60, -40)
        page.settled()
        bump = page.run("bench.tables()[0].bumps[0]")
        assert bump["range"][:2] == BUMP["range"][:2]
        assert bump["range"][2] > 0.55
        assert bump["opacity"] > 0.5
        dragged = page.canvas().astype(int)
        assert np.abs(dragged - plain).max() > 30
        pull(page, -1, -40, 0)
        page.settled()
        moved = page.run("bench.tables()[0].bumps[0]")
        shift = np.subtract(moved["range"], bump["range"])
        assert shift.max() < -0.02
        assert np.ptp(shift) < 2e-6
        control_z(page)
        page.settled()
        assert page.run("bench.tables()[0].bumps[0]") == bump
        assert np.abs(page.canvas() - dragged).max() <= 1
        control_z(page)
        page.settled()
        assert page.run("bench.tables()[0].bumps[0]") == BUMP
        assert np.abs(page.canvas() - plain).max() <= 1
        control_z(page, shift=True)
        assert page.run("bench.tables()[0].bumps[0]") == bump

        page.set("#sceneName", HOSTILE, "change")  # is refused in words, and undone
        page.until("document.getElementById('message').textContent.includes('name')")
        assert page.run("document.title") == "bench view"
        control_z(page)
        page.set("#bump .end", 40, "change")  # in units of the data
        page.set("#bumpColor", "#00ff80")
        page.settled()
        page.set("#saveName", "dragged.toml")
        page.click("#saveScenes")
        page.until("document.getElementById('command').textContent.startsWith('bench run')")
        bump, camera, pixels = page.run("bench.tables()[0].bumps[0]"), page.camera(), page.pixels()
        assert page.run("document.getElementById('command').textContent") == (
            "bench run quick --dataset dragged.toml"
        )
        assert all("400" in one for one in page.problems)  # the refused name
    file = server.viewer.folder / "dragged.toml"
    (own,) = open_dataset(str(file)).scene("ball").transfer.bumps
    assert [own.start, own.rise, own.fall, own.end] == bump["range"]
    assert own.start == pytest.approx(40 / open_dataset(str(file)).volume("density").value_range[1], abs=1e-6)
    assert own.color == pytest.approx((0, 1, 128 / 255), abs=1e-6)
    again = found([str(file)], tmp_path, (), "cpu")[0].open()
    assert psnr(pixels, again.picture(camera, ["ball"], {}, WHITE, None)[0]) > LEAST
    command = [
        sys.executable,
        "-m",
        "econgs_bench.bench",
        "plan",
        "quick",
        "--dataset",
        file.name,
        "--out",
        "runs",
    ]
    planned = subprocess.run(
        command, cwd=file.parent, capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONSAFEPATH": "1"},
    )  # fmt: skip
    assert planned.returncode == 0, planned.stderr
    assert "dragged" in planned.stdout + planned.stderr


@pytest.mark.skipif(executable() is None, reason="no Chromium here")
def test_isosurfaces_are_dragged_and_saved(tmp_path: Path) -> None:
    (source,) = found(["jet_flame_iso@16"], tmp_path, (), "cpu")
    with serving(source) as server, Page(tmp_path / "profile", *SOFTWARE) as page:
        server.viewer.folder = tmp_path
        page.emulate(1000, 800)
        page.open(server.address)
        page.settled()
        page.until("document.getElementById('low').textContent === '0'")
        plain, (first,) = page.canvas().astype(int), page.run("bench.tables()[0].isosurfaces")
        assert page.run("[...document.querySelectorAll('#bump label')].filter((l) => !l.hidden).length") == 2
        pull(page, 0, 60, 30)
        page.settled()
        (moved,) = page.run("bench.tables()[0].isosurfaces")
        assert moved["value"] > first["value"] + 0.05
        assert 0.0 < moved["opacity"] < first["opacity"]
        assert np.abs(page.canvas() - plain).max() > 30
        page.set("#value", 65535, "change")  # beyond the last value that a surface can have
        page.set("#opacity", 0, "change")
        page.settled()
        (surface,) = page.run("bench.tables()[0].isosurfaces")
        assert (surface["value"], surface["opacity"]) == (0.999999, 1e-6)
        for _ in range(3):
            control_z(page)
        page.settled()
        assert page.run("bench.tables()[0].isosurfaces") == [first]
        assert np.abs(page.canvas() - plain).max() <= 1

        page.click("#addSurface")
        page.settled()
        assert [one["name"] for one in page.run("bench.tables()[0].isosurfaces")] == ["low", "surface2"]
        page.click("#addBump")  # in their place
        page.settled()
        assert "isosurfaces" not in page.run("bench.tables()[0]")
        assert len(page.run("bench.tables()[0].bumps")) == 1
        control_z(page)
        page.set("#saveName", "iso.toml")
        page.click("#saveScenes")
        page.until("document.getElementById('command').textContent.startsWith('bench run')")
        assert page.problems == []
    written = open_dataset(str(tmp_path / "iso.toml"))
    assert [one.value for one in written.scenes[0].isosurfaces] == [first["value"], 0.5]
    assert written.scenes[1:] == open_dataset("jet_flame_iso@16").scenes[1:]


def test_the_viewer_saves_where_it_was_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert Viewer([]).folder == tmp_path.resolve()
