"""``pytest --bench-gate FILE``: a test per result of the baseline, beside the tests of a project."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from econgs_bench.bench.gate.verdict import Finding


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the options."""
    group = parser.getgroup("bench", "quality gate of econgs-bench")
    group.addoption("--bench-gate", metavar="FILE", help="test a run store against this baseline")
    group.addoption("--bench-store", metavar="DIR", default="runs", help="the run store (default: runs)")
    group.addoption("--bench-times", action="store_true", help="test times too")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(
    session: pytest.Session, config: pytest.Config, items: list[pytest.Item]
) -> None:
    """Add the results of the baseline before selections by name apply."""
    path = config.getoption("--bench-gate")
    if not path:
        return
    from econgs_bench.bench.gate.judgement import judged
    from econgs_bench.bench.gate.text import findings_by_cell
    from econgs_bench.datasets.errors import DataError

    times = config.getoption("--bench-times")
    try:
        verdict, _, _ = judged(Path(path), Path(config.getoption("--bench-store")), times=times)
    except DataError as error:
        raise pytest.UsageError(str(error)) from error
    for cell, findings in findings_by_cell(verdict).items():
        items.append(_Result.from_parent(session, name=f"bench-gate[{cell}]", findings=findings))


class _Loss(Exception):
    """Findings of one result that are worse."""


class _Result(pytest.Item):
    """One result of the baseline."""

    def __init__(self, *, findings: list[Finding], **more: Any) -> None:
        super().__init__(**more)
        self._findings = findings

    def runtest(self) -> None:
        texts = {
            kind: [f.text for f in self._findings if f.kind == kind] for kind in ("worse", "not measured")
        }
        if texts["worse"]:
            raise _Loss("\n".join(texts["worse"]))
        if texts["not measured"]:
            pytest.skip(texts["not measured"][0])

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        return str(excinfo.value) if excinfo.errisinstance(_Loss) else super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, None, str]:
        return Path(self.config.getoption("--bench-gate")), None, self.name
