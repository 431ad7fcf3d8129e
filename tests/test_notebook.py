"""The notebook of the guide runs as it is printed, and its outputs are there."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import pytest

NOTEBOOK = Path(__file__).parents[1] / "docs" / "guide" / "python.ipynb"
SHORT = """title = "In place of quick, which CI runs by itself"
methods = ["3dgs", "econgs"]
preset = "short"
[datasets]
vortices = ["cores"]
[presets.short]
like = "quick"
budget = 0.25
train_views = 42
test_views = 4
width = 64
height = 64
prerendered_limit = 64
"""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Executes a cell as a notebook does; returns the value of its last line."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    names: dict[str, Any] = {}

    def execute(source: str) -> Any:
        lines = ast.parse(source)
        last = lines.body.pop() if isinstance(lines.body[-1], ast.Expr) else None
        exec(compile(lines, "cell", "exec"), names)
        return eval(compile(ast.Expression(last.value), "cell", "eval"), names) if last else None

    return execute, names


@pytest.mark.slow
def test_the_notebook_runs_and_shows_what_it_shows(run, capsys) -> None:
    execute, names = run
    Path("short.toml").write_text(SHORT, encoding="utf-8")
    cells = [c for c in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"] if c["cell_type"] == "code"]
    values = []
    for cell in cells:
        values.append(execute("".join(cell["source"]).replace('"quick"', '"short.toml"')))
        printed = capsys.readouterr().out
        shown = [output["output_type"] for output in cell["outputs"]]
        assert ("execute_result" in shown) == (values[-1] is not None)
        assert ("stream" in shown) == bool(printed)
        assert "error" not in shown
    assert names["results"]["psnr"].min() > 20.0
    assert values[-1] > 20.0, "PSNR of the edited model against the edited truth"
    assert {"Smallest", "Best picture", "Can be edited"} <= set(names["runs"].answers)
