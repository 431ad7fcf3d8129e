"""What records say about where they come from."""

import ast
import re
from pathlib import Path

import pytest

from bench import provenance
from methods.registry import Registry

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="the tests are not in a clone")
def test_the_commit_is_known_where_the_package_was_installed_from_a_clone():
    assert re.fullmatch(r"[0-9a-f]{12}\+?", provenance._commit() or "")


def test_an_installed_package_tells_the_commit_that_it_was_built_from(tmp_path, monkeypatch):
    bench = tmp_path / "bench"
    bench.mkdir()
    monkeypatch.setattr(provenance, "__file__", str(bench / "provenance.py"))
    assert provenance._commit() is None
    (bench / "commit.txt").write_text("0123456789ab\n")
    assert provenance._commit() == "0123456789ab"


FRAME = {"methods", "methods.interface"}
"""What says how a method is called, not what it does."""
BUILT_IN = [name for name in Registry().names() if Registry().origin(name).startswith("built in")]


def _imported(module, found):
    """Modules under methods that a module imports, however deep."""
    path = ROOT.joinpath(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    if module in found or not file.is_file():
        return found
    found.add(module)
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("methods"):
            for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names)):
                _imported(name, found)
    return found


@pytest.mark.parametrize("method", BUILT_IN)
def test_what_decides_results_marks_rows_stale(method):
    """A module that a method imports and its ``source`` leaves out could change without anyone being told."""
    spec = Registry().spec(method)
    used = _imported(spec.implementation.partition(":")[0], set()) - FRAME
    covered = {m for m in used if any(m == one or m.startswith(f"{one}.") for one in spec.source)}
    packages = {m for m in used if (ROOT.joinpath(*m.split(".")) / "__init__.py").is_file()}
    assert used - covered - packages == set()
