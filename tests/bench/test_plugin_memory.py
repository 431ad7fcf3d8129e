"""Plugin folders of a store: remembered for its user alone, wherever it goes, and never brought by it."""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path

import pytest

from econgs_bench.bench.run.plugins import ID, plugin_folders, remember
from econgs_bench.bench.store.store import Store

PLUGIN = """
from econgs_bench.methods.interface import MethodSpec
from pathlib import Path

Path(__file__).with_name("imported").touch()
SPEC = MethodSpec(
    name={name!r}, title="t", reference="r", version="1", implementation="{module}:Method", uses_alpha="no",
    iterations={{"quick": 1, "standard": 1, "paper": 1}},
)
"""


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A user's folder of state; what plugins add to the process is taken back."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith("own_"):
            del sys.modules[name]


def _plugin(folder: Path, name: str, module: str) -> str:
    folder.mkdir()
    (folder / f"{module}.py").write_text(PLUGIN.format(name=name, module=module))
    return str(folder)


def _state(home: Path) -> list[Path]:
    return list((home / "home").rglob("*.json"))


def test_folders_stay_with_a_store_that_moves_and_the_command_line_wins(home, capsys) -> None:
    one, two = _plugin(home / "one", "own-one", "own_one"), _plugin(home / "two", "own-two", "own_two")
    store = Store(home / "runs", create=True)
    assert plugin_folders([], store.root) == ()
    remember(store, [one])
    remember(store, [two])
    moved = (home / "runs").rename(home / "elsewhere")
    assert plugin_folders([], moved) == (two, one)
    assert plugin_folders([one], moved) == (one,)
    shutil.rmtree(one)
    assert capsys.readouterr().err == ""
    assert plugin_folders([], moved) == (two,)
    assert f"the plugin folder {one}, remembered from an earlier run, is left out: it is gone" in (
        capsys.readouterr().err
    )
    remember(Store(moved), [two])
    assert plugin_folders([], moved) == (two,)
    assert capsys.readouterr().err == ""


def test_a_plugin_that_moved_takes_the_place_of_its_former_folder(home, capsys) -> None:
    old, new = _plugin(home / "old", "own-same", "own_same"), _plugin(home / "new", "own-same", "own_again")
    store = Store(home / "runs", create=True)
    remember(store, [old])
    remember(store, [new])
    assert plugin_folders([], store.root) == (new,)
    assert capsys.readouterr().err == ""


def test_a_store_from_somebody_else_imports_nothing(home) -> None:
    """Whatever files it brings: the sender knows neither this user's state nor can write it."""
    evil = _plugin(home / "evil", "own-evil", "own_evil")
    mine = Store(home / "mine", create=True)
    remember(mine, [_plugin(home / "good", "own-good", "own_good")])
    (state,) = _state(home)
    text = state.read_text().replace(str(home / "good"), evil)
    theirs = Store(home / "theirs", create=True)
    for name in ("id", "plugins.json", f"plugins/{state.name}", state.name):
        (theirs.root / name).parent.mkdir(exist_ok=True)
        (theirs.root / name).write_text(text)
    (theirs.root / "store.json").write_text(json.dumps({"schema_version": 3, "plugins": [evil]}))
    assert plugin_folders([], theirs.root) == ()
    # Not even by an id that leads elsewhere.
    for identity in ("../" * 8 + str(theirs.root / "plugins.json"), "0" * 32, ""):
        (theirs.root / ID).write_text(identity)
        assert plugin_folders([], theirs.root) == ()
    # With the id of a store of this user it gets what this user gave, and no more.
    (theirs.root / ID).write_text((mine.root / ID).read_text())
    assert plugin_folders([], theirs.root) == (str(home / "good"),)
    assert not (home / "evil" / "imported").exists()


def test_a_folder_with_another_owner_is_left_out(home, capsys) -> None:
    folder = _plugin(home / "one", "own-one", "own_one")
    store = Store(home / "runs", create=True)
    remember(store, [folder])
    (state,) = _state(home)
    state.write_text(state.read_text().replace(f'"owner": {os.getuid()}', '"owner": 4242'))
    assert plugin_folders([], store.root) == ()
    assert "another owner" in capsys.readouterr().err


@pytest.mark.slow
def test_commands_on_a_store_need_no_plugins_again_and_bundles_and_merges_bring_none(bench, tmp_path) -> None:
    bench.run()
    measure, store = bench.of_kind("measure")[0].job.id, ("--runs", bench.store)
    picture = ("render", bench.dataset, "--scene", "a", "--size", "8", "--views", "1", "--model", measure)
    bench(*picture, *store, "--out", tmp_path / "pictures")
    assert "4 finished" in bench(
        "plan", "quick", "--dataset", bench.dataset, "--method", "fake", "--scene", "a", "--out", bench.store
    ).stdout  # fmt: skip
    assert json.loads(bench("results", *store, "--format", "json").stdout)[0]["status"] == "ok"
    bench("bundle", *store, "--out", tmp_path / "all.zip", "--models")
    for source, name in ((tmp_path / "all.zip", "from-bundle"), (bench.store, "from-store")):
        bench("merge", source, "--out", tmp_path / name)
        done = bench(*picture, "--runs", tmp_path / name, "--out", tmp_path / "pictures", code=2)
        assert (
            "is a model of the method fake, which is not there. Give the folder of its plugin" in done.stderr
        )
    # Another user, here by another folder of state, who was given the whole store.
    bench.environment["XDG_STATE_HOME"] = str(tmp_path / "another home")
    assert "which is not there" in bench(*picture, *store, "--out", tmp_path / "pictures", code=2).stderr
