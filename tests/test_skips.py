"""CI=true makes a skip a failure, unless it is for something that CI's machine may lack."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

TESTS = """
import pytest

def test_data():
    pytest.skip("BENCH_DATA is not set")

def test_device():
    pytest.skip("no CUDA device with gsplat here")

@pytest.mark.xfail
def test_known():
    assert False
"""


@pytest.mark.parametrize(
    ("ci", "ends"), [("", "3 skipped, 1 xfailed"), ("true", "1 failed, 1 skipped, 1 xfailed, 1 error")]
)
def test_skips_in_ci(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ci: str, ends: str) -> None:
    monkeypatch.setenv("CI", ci)
    (tmp_path / "conftest.py").write_bytes((Path(__file__).parent / "conftest.py").read_bytes())
    (tmp_path / "test_some.py").write_text(TESTS)
    (tmp_path / "test_module.py").write_text('import pytest\npytest.importorskip("no_such_package")\n')
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--continue-on-collection-errors"],
        cwd=tmp_path, capture_output=True, encoding="utf-8", timeout=120, check=False,
    )  # fmt: skip
    assert f"{ends} in " in done.stdout
    assert ("could not import 'no_such_package'" in done.stdout) == bool(ci)
