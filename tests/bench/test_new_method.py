"""``bench new-method``: names, and that nothing is written over."""

from __future__ import annotations

import ast
import sys
import tomllib

import pytest

from econgs_bench.bench.__main__ import main
from econgs_bench.methods.registry import Registry


def test_the_files_bear_the_name_of_the_method(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert main(["new-method", "my-splats", "--out", str(tmp_path / "new")]) == 0
    folder = tmp_path / "new" / "my_splats"
    assert f"--plugins {folder}" in capsys.readouterr().out
    paths = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert paths == {
        "pyproject.toml", "README.md", "test_my_splats.py",
        "my_splats/__init__.py", "my_splats/spec.py", "my_splats/method.py",
    }  # fmt: skip
    texts = {path: (folder / path).read_text(encoding="utf-8") for path in paths}
    assert not [path for path, text in texts.items() if "toy" in text]
    project = tomllib.loads(texts["pyproject.toml"])["project"]
    assert project["entry-points"]["econgs_bench.methods"] == {"my-splats": "my_splats.spec:SPEC"}
    for path, text in texts.items():
        if path.endswith(".py"):
            ast.parse(text)
    assert Registry([folder]).spec("my-splats").implementation == "my_splats.method:Method"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("My", "Use lower-case letters"),
        ("../up", "Use lower-case letters"),
        ("9lives", "is no name of a Python package"),
        ("class", "is no name of a Python package"),
        ("econgs", "is the name of an installed method"),
        ("json", "Python has a module 'json' already"),
        ("torch", "Python has a module 'torch' already"),
    ],
)
def test_names_that_cannot_be_are_refused(tmp_path, capsys, name, words) -> None:
    assert main(["new-method", name, "--out", str(tmp_path)]) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_nothing_is_written_over(tmp_path, capsys) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "work.py").write_text("a year of work")
    assert main(["new-method", "mine", "--out", str(tmp_path)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert [path.name for path in tmp_path.rglob("*")] == ["mine", "work.py"]


def test_a_method_of_commands_bears_its_name(tmp_path, capsys) -> None:
    assert main(["new-method", "my-program", "--command", "--out", str(tmp_path)]) == 0
    folder = tmp_path / "my_program"
    assert f"--plugins {folder}" in capsys.readouterr().out
    assert {path.name for path in folder.iterdir()} == {"command.toml", "blobs.py", "train.py", "render.py"}
    spec = Registry([folder]).spec("my-program")
    assert spec.drawn_here
    assert [path.name for path in spec.files] == ["command.toml", "blobs.py", "render.py", "train.py"]
    assert main(["new-method", "json", "--command", "--out", str(tmp_path)]) == 0  # no module of Python's
    assert main(["new-method", "econgs", "--command", "--out", str(tmp_path)]) == 2
