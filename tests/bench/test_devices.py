"""A device that a machine lacks is an error before anything is rendered for it."""

from __future__ import annotations

import pytest
import torch

from econgs_bench.bench.run.display import Display
from econgs_bench.bench.run.experiment import check_device, execute
from econgs_bench.bench.run.request import RunRequest
from econgs_bench.datasets.errors import DataError


@pytest.mark.parametrize(
    ("device", "count", "there"),
    [("cpu", 0, True), ("cuda", 1, True), ("cuda:1", 2, True), ("cuda", 0, False), ("cuda:2", 2, False)],
)
def test_devices_of_a_machine(monkeypatch, device, count, there):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    if there:
        check_device(device)
    else:
        with pytest.raises(DataError, match=f"^--device {device}: .*no CUDA|numbered from 0"):
            check_device(device)


def test_a_run_makes_no_store_for_a_device_that_is_not_there(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(DataError, match="--device cuda"):
        execute(RunRequest.of("quick", tmp_path / "store", device="cuda"), Display())
    assert not (tmp_path / "store").exists()
