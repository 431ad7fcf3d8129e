"""What records say about where they come from."""

import importlib
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from econgs_bench.bench.machine import provenance

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="the tests are not in a clone")
def test_the_commit_is_known_where_the_package_was_installed_from_a_clone():
    assert re.fullmatch(r"[0-9a-f]{12}\+?", provenance.commit_here() or "")


def test_an_installed_package_tells_the_commit_that_it_was_built_from(tmp_path, monkeypatch):
    bench = tmp_path / "bench"
    (bench / "machine").mkdir(parents=True)
    monkeypatch.setattr(provenance, "__file__", str(bench / "machine" / "provenance.py"))
    assert provenance.commit_here() is None
    (bench / "commit.txt").write_text("0123456789ab\n")
    assert provenance.commit_here() == "0123456789ab"


def test_the_source_of_a_plugin_that_deleted_itself_is_unknown(tmp_path, monkeypatch):
    (tmp_path / "own_gone.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("own_gone")
    (tmp_path / "own_gone.py").unlink()
    assert provenance.provenance(1, SimpleNamespace(source=("own_gone",)), "cpu").source is None
    del sys.modules["own_gone"]
