"""The record of repetitions comes back as it was written."""

import pytest

from econgs_bench.bench.gate.cells import Cell, Key
from econgs_bench.methods.registry import Registry
from tools.proofs import repetitions


def test_values_come_back_and_older_versions_do_not(tmp_path, monkeypatch):
    monkeypatch.setattr(repetitions, "VALUES", tmp_path / "values.csv")
    assert repetitions.read() == {}
    key = Key("set", "a", "hac", "iterations=9", 0.5, "quick", "test", 42)
    version = Registry().spec("hac").version
    cell = Cell(key, version, "a processor; 1 threads")
    for seed in (3, 11):
        cell.values[seed] = {"psnr": 20.0 + seed / 7, "size_bytes": 123456789.0}
        cell.views[seed] = {"test_000": 1.0 / seed, "test_001": 2.0}
    older = key._replace(scene="b")
    repetitions.write({key: cell, older: Cell(older, "an older one", "", {0: {"psnr": 1.0}}, {0: {}})})
    assert len(repetitions.VALUES.read_text().splitlines()) == 4
    (back,) = repetitions.read().values()
    assert (back.key, back.version, back.processor) == (key, version, cell.processor)
    for seed in (3, 11):
        assert back.values[seed] == pytest.approx(cell.values[seed], rel=1e-8)
        assert back.views[seed] == pytest.approx(cell.views[seed], rel=1e-8)
