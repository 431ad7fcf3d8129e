"""The attacks in their small form: a handful of each."""

from __future__ import annotations

import os
import random
import sys
from dataclasses import replace

import numpy as np
import pytest

from econgs_bench.bench.store.store import Store
from tests.bench.conftest import suite_file, write_dataset
from tools.fire import damage, disks, kills, mutations, plugins, soak, strangers, together
from tools.fire.attack import Tally, bench_in, contents, difference, leftovers, work_folder

pytestmark = [
    pytest.mark.slow,  # at night, as the attacks themselves
    pytest.mark.skipif(sys.platform != "linux", reason="signals, mounts and forks of Linux"),
]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("data") / "tiny")


@pytest.fixture(scope="module")
def finished(scenes, tmp_path_factory):
    """A suite of the method fake, and a run of it that nobody touched."""
    folder = tmp_path_factory.mktemp("finished")
    suite = suite_file(folder, f'"{scenes}" = ["a"]', "threads = 1")
    bench = bench_in(folder / "undisturbed", scenes)
    bench.run_suite(suite)
    return bench, suite


@pytest.fixture
def tally():
    counts = Tally()
    yield counts
    assert counts.counts
    assert not counts.failed, counts.counts


def test_a_kill_within_a_measurement(finished, scenes, tmp_path, tally) -> None:
    undisturbed, suite = finished
    bench = bench_in(tmp_path / "killed", scenes)
    torn = kills.kill_in(bench, suite, "measure", 0.2, random.Random(0))
    bench.run_suite(suite, "--retry")
    assert not torn
    tally.add(
        "store", difference(contents(undisturbed.store), contents(bench.store)) or leftovers(bench.store)
    )


def test_faults_of_stages_and_specs(scenes, tmp_path, tally) -> None:
    bench = bench_in(tmp_path / "stages", scenes)
    bench.plugins = plugins.FOLDER
    chosen = (("save", "crash"), ("save", "link"), ("render", "bytes"))
    faults = plugins.all_faults()
    plugins.attack_stages(bench, {fault: faults[fault] for fault in chosen}, tally)
    plugins.attack_specs(bench, ("leave",), tally)


def test_two_runs_at_once(finished, scenes, tmp_path, tally) -> None:
    together.attack(tmp_path, scenes, finished[1], [2], tally, finished[0])


@pytest.mark.parametrize(("pattern", "read"), [("measure", damage.of_record), ("fit", damage.of_checkpoint)])
def test_damage_to_records_and_checkpoints(finished, tally, pattern, read) -> None:
    store = finished[0].store
    (record,) = store.glob(f"jobs/{pattern}-*/record.json")
    rng, job = np.random.default_rng(0), record.parent.name
    if pattern == "measure":
        damage.attack("records", record, lambda: read(store, job), 40, rng, tally)
    else:
        (file,) = record.parent.glob("checkpoint/*/checkpoint.json")
        damage.attack("checkpoints", file, lambda: read(record.parent / "checkpoint"), 40, rng, tally)


def test_mutations_of_a_format_with_checksums_made_again(tmp_path) -> None:
    plain, repaired = mutations.fuzz("vq-3dgs", 60, 0, tmp_path)
    assert not plain.faults + repaired.faults
    assert plain.counts["refused"] > 20
    assert sum(repaired.counts.values()) > 10


@pytest.fixture
def stranger(scenes, tmp_path):
    """A store of a stranger, and what is watched while commands read it."""
    bench = bench_in(tmp_path / "whole", scenes)
    bench.run()
    watch = strangers.Watch(tmp_path / "stranger" / "home")
    yield strangers.Victim(tmp_path / "stranger", bench, watch)
    assert watch.commands
    assert not watch.crashes + watch.touched


def test_what_a_stranger_sends(stranger, tally) -> None:
    strangers.attack_names(stranger, ["x/../../../home/victim"], ["run"], tally)
    strangers.attack_links(stranger, ["jobs/{encode}/model/weights.bin", "partial"], ["bundle"], tally)


def test_a_watch_sees_what_it_is_for(stranger, tmp_path) -> None:
    watch, home = strangers.Watch(tmp_path / "other" / "home"), tmp_path / "other" / "home"
    (home / "victim" / "letter").unlink()
    assert watch.look() == ["changed a file outside"]
    assert watch.look() == []
    (tmp_path / "written").mkdir()
    (tmp_path / "written" / "model.bin").write_bytes((home / "id_rsa").read_bytes())
    assert watch.look(tmp_path / "written") == ["copied a file of the reader to model.bin"]
    assert watch.touched == 2
    stranger.renew()
    (stranger.bench.store / "store.json").write_text("[")
    assert stranger.run("results") == ""


def test_streams_that_a_library_does_not_survive(tmp_path, tally) -> None:
    watch = strangers.Watch(tmp_path / "home")
    strangers.attack_streams(tmp_path, ["zfp"], 4, 0, watch, tally)
    assert not watch.crashes


@pytest.mark.skipif(os.geteuid() != 0 or not disks.can_mount(), reason="only root is two users")
def test_two_users_of_a_machine(tally) -> None:
    with work_folder() as folder:
        (folder / "users").mkdir()
        today = int(strangers.PROTECTED.read_text())  # the script tries all
        strangers.attack_users(folder / "users", [today], tally)


@pytest.mark.skipif(not disks.can_mount(), reason="this process may not mount a tmpfs")
def test_a_disk_that_fills_and_is_given_room(scenes, finished, tmp_path, tally) -> None:
    disks.full(tmp_path, scenes, finished[1], [0.5], tally, finished[0])


def test_a_file_system_without_locks_does_no_harm(scenes, finished, tmp_path, tally) -> None:
    disks.shimmed(tmp_path, scenes, finished[1], "lock-less", tally, finished[0], 1)


def test_what_a_soak_counts(tally, tmp_path) -> None:
    Store(tmp_path / "runs", create=True)
    one = soak.sample(0.0, 3, tmp_path / "runs", tmp_path)
    assert one.handles > 2
    assert (one.files, one.unfinished, one.temporary) == (1, 0, 1)
    kept = Tally()
    rounds = 2 * soak.EVERY
    grown = [one] * rounds + [replace(one, handles=one.handles + 1, temporary=0)] * rounds
    soak.judge(grown, 0, kept)
    assert {name for name, (held, _) in kept.counts.items() if not held} == {"handles", "temporary"}
    soak.judge([replace(one, temporary=0)] * rounds, 0, tally)
