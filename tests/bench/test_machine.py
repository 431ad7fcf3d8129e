"""How busy the machine is: verdicts on hand-made loads, and a real process that takes a core."""

from __future__ import annotations

import subprocess
import sys
from argparse import Namespace

import pytest

from econgs_bench.bench.commands import doctor
from econgs_bench.bench.machine import load as machine
from econgs_bench.bench.machine.load import Load, clock_cap, measure_load
from econgs_bench.bench.machine.locks import locked

EVEN = (0.1,) * 20


@pytest.mark.parametrize(
    ("load", "slowdown", "busy"),
    [
        (Load(8, 0.1, laps=EVEN), 1.0125, False),
        (Load(8, 2.0, laps=EVEN), 1.25, False),
        (Load(8, 5.0, laps=EVEN), 1.625, True),  # busy all the time: no lap differs from the others
        (Load(2, 2.0, laps=EVEN), 2.0, True),
        (Load(8, 0.0, laps=(0.1,) * 17 + (0.17,) * 3), 1.7, True),  # busy now and then
        (Load(8, 0.0, laps=(0.1,) * 50 + (0.9,)), 1.0, False),  # one hiccup
        (Load(8, 0.0), 1.0, False),  # no native core
        (Load(8, 0.0, locked=True), 1.0, True),
    ],
)
def test_a_machine_is_busy_from_the_limit_of_the_report(load, slowdown, busy):
    assert load.slowdown == pytest.approx(slowdown)
    assert load.busy == busy


def test_a_process_that_takes_a_core_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("BENCH_LOCKS", str(tmp_path))
    monkeypatch.setattr(machine, "LAP_SECONDS", 0.3)
    spinner = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        load = measure_load()
    finally:
        spinner.kill()
        spinner.wait()
    assert load.foreign > 0.2
    assert any(name.startswith("python") and cores > 0.1 for name, cores in load.users)
    assert [cores for _, cores in load.users] == sorted((c for _, c in load.users), reverse=True)
    assert load.laps


def test_a_timed_job_is_not_disturbed(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("BENCH_LOCKS", str(tmp_path))
    monkeypatch.setattr(machine, "IDLE_SECONDS", 0.1)
    monkeypatch.setattr(machine, "lap_seconds", lambda: pytest.fail("ran beside a timed job"))
    with locked("timing"):
        monkeypatch.setattr(doctor, "CHECKS", (doctor._machine,))
        assert doctor.doctor(Namespace()) == 0
    out = capsys.readouterr().out
    assert out.startswith("busy    machine")
    assert "A timed job of a run is under way" in out


def test_the_verdict_names_what_it_means(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "CHECKS", (doctor._machine,))
    monkeypatch.setattr(machine, "measure_load", lambda: Load(4, 3.0, (("cc1plus", 2.9),), 3.1, EVEN))
    doctor.doctor(Namespace())
    monkeypatch.setattr(machine, "measure_load", lambda: Load(4, 0.0, (), 0.1, EVEN))
    doctor.doctor(Namespace())
    busy, remedy, quiet = capsys.readouterr().out.splitlines()
    assert busy.split()[:2] == ["busy", "machine"]
    assert "1.8 times slower than quiet (limit 1.5)" in busy
    assert "others use 3.0 of 4 cores (cc1plus 2.9), load 3.1" in busy
    assert "--retry busy" in remedy
    assert "quiet: reference kernel 100 ms (100 to 100 in 20 laps)" in quiet
    assert quiet.endswith("training times and FPS measured now count")


def test_a_capped_clock(tmp_path):
    for core, permitted in ((0, 3_400_000), (1, 2_100_000)):
        folder = tmp_path / f"cpu{core}" / "cpufreq"
        folder.mkdir(parents=True)
        (folder / "scaling_max_freq").write_text(f"{permitted}\n")
        (folder / "cpuinfo_max_freq").write_text("3400000\n")
    assert clock_cap(tmp_path) == (2.1e9, 3.4e9)
    (tmp_path / "cpu1" / "cpufreq" / "scaling_max_freq").write_text("3400000\n")
    assert clock_cap(tmp_path) is None
    assert clock_cap(tmp_path / "none") is None
