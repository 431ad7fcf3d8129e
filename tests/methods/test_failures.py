"""Whose fault an exception is: told from the frames of real plugins, not from its kind alone."""

from __future__ import annotations

import errno
import sys

import pytest

from econgs_bench.bench.__main__ import main
from econgs_bench.methods.contract import checks
from econgs_bench.methods.failures import Failure, failure
from econgs_bench.methods.registry import Registry
from econgs_bench.methods.skeleton import files

PLUGIN = """
import errno, os
from econgs_bench.methods.interface import MethodSpec
from econgs_bench.methods.options import parse_assignments

SPEC = MethodSpec(
    name="culprit", title="t", reference="r", version="1", implementation="culprit:Method", uses_alpha="no",
    iterations={"quick": 1, "standard": 1, "paper": 1},
)

def own():
    return {}["no such key"]

def misuse():
    parse_assignments(["not an assignment"])

def wrapped():
    try:
        own()
    except KeyError as error:
        raise RuntimeError("could not go on") from error

def full():
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

def greedy():
    raise MemoryError

def deep(n=30):
    return deep(n - 1) if n else own()
"""


@pytest.fixture
def culprit(tmp_path, monkeypatch):
    """A plugin's spec, and what one of its functions raises."""
    (tmp_path / "culprit.py").write_text(PLUGIN)
    monkeypatch.setattr(sys, "path", list(sys.path))
    spec = Registry([tmp_path]).spec("culprit")
    module = sys.modules["culprit"]

    def raised(name):
        with pytest.raises(Exception) as caught:  # noqa: PT011
            getattr(module, name)()
        caught.value.__traceback__ = caught.value.__traceback__.tb_next  # this file is no plugin
        return failure(caught.value, spec)

    yield raised, spec
    del sys.modules["culprit"]


@pytest.mark.parametrize(
    ("name", "fault", "line"),
    [
        ("own", "plugin", 'return {}["no such key"]'),
        ("misuse", "plugin", 'parse_assignments(["not an assignment"])'),
        ("wrapped", "plugin", 'raise RuntimeError("could not go on") from error'),
        ("full", "machine", "raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))"),
        ("greedy", "machine", "raise MemoryError"),
        ("deep", "plugin", 'return {}["no such key"]'),
    ],
)
def test_the_innermost_line_of_the_plugin_is_named(culprit, name, fault, line) -> None:
    found = culprit[0](name)
    number = PLUGIN.splitlines().index(
        f"    {line}" if f"    {line}" in PLUGIN.splitlines() else f"        {line}"
    )
    assert (found.fault, found.place) == (fault, f"culprit.py:{number + 1}")
    assert line in found.trace
    assert len(found.trace.splitlines()) <= 9
    assert ("raised in" in found.trace) is (name == "misuse")


def test_what_no_plugin_was_running_for_is_the_harness_or_the_machine(culprit) -> None:
    _, spec = culprit
    assert failure(ValueError("a bug"), spec) == Failure("harness")
    assert failure(OSError(errno.EMFILE, "too many open files"), spec) == Failure("machine")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            ".sigmoid()\n        splats", ".sigmoids()\n        splats",
            ["error   fit", "at fault: the plugin's code", "method.py:", "sigmoids()"],
        ),
        (
            "        return cls(scene for",
            '        if "pytest" not in __import__("sys").modules:\n'
            '            raise KeyError("only in a new process")\n        return cls(scene for',
            ["failed  saved and loaded", "KeyError: 'only in a new process'", "method.py:",
             'raise KeyError("only in a new process")'],
        ),
    ],
)  # fmt: skip
def test_check_plugin_shows_the_authors_lines(tmp_path, monkeypatch, capsys, old, new, words) -> None:
    for path, text in files("broken-one", "broken_one").items():
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text(text.replace(old, new))
    assert new in (tmp_path / "broken_one" / "method.py").read_text()
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(checks, "CHECKS", (checks.fit, checks.saved_and_loaded))
    try:
        main(["check-plugin", "broken-one", "--plugins", str(tmp_path), "--iterations", "4"])
    finally:
        for name in [name for name in sys.modules if name.startswith("broken_one")]:
            del sys.modules[name]
    output = capsys.readouterr().out
    assert not [word for word in words if word not in output], output
    assert "methods/contract/checks.py" not in output
