"""Models of a bundle measured again: invented figures and exchanged models are found, other data refused."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from econgs_bench.bench.results.bundle import write_bundle
from econgs_bench.bench.run.limits import Limits
from econgs_bench.bench.run.redo import VIEWS, Draw, redo
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.png import write_png
from econgs_bench.datasets.seals import sealed, unsealed

from .conftest import PLUGINS


@pytest.fixture
def store(finished):
    return finished.store


def packed(store, *, models=True):
    path = store.parent / "mine.zip"
    write_bundle(Store(store), path, models=models)
    return path


def only(store, pattern):
    (path,) = store.glob(pattern)
    return path


def change_record(file, change):
    record = json.loads(unsealed(file.read_text()))
    change(record)
    file.write_text(sealed(json.dumps(record)))


def lower(view, decibels):
    """Less PSNR of a view of 8 x 8 pixels, by a whole sum of squares."""
    squares = 255.0**2 * 192 * 10.0 ** (-(view["metrics"]["psnr"] + decibels) / 10.0)
    view["metrics"]["psnr"] = 10.0 * math.log10(255.0**2 * 192 / round(squares))


def better(record):
    measure = record["measure"]
    for view in measure["views"]:
        lower(view, 5.0)
    values = [view["metrics"]["psnr"] for view in measure["views"]]
    measure["metrics"]["psnr"] = math.fsum(values) / len(values)


def arguments(bench, path, *more):
    return ("verify", path, "--redo", 3, "--plugins", PLUGINS, "--dataset", bench.dataset, *more)


def test_an_honest_model_gives_its_figures_again(bench, inside, store):
    done = bench(*arguments(bench, packed(store)))
    name = only(store, "jobs/measure-*").name
    assert f"{name}: measured again in the views r_0000, r_0001, r_0002, r_0003" in done.stdout
    assert "the models that were drawn too" in done.stdout
    assert done.stderr == ""


def test_figures_that_the_model_does_not_have_are_found(bench, inside, store):
    change_record(only(store, "jobs/measure-*/record.json"), better)
    path = packed(store)
    assert "all of it holds" in bench("verify", path).stdout  # it does not contradict itself
    done = bench(*arguments(bench, path), code=1)
    lines = [line for line in done.stderr.splitlines() if "psnr is " in line]
    assert len(lines) == 4, done.stderr
    assert all("measured again" in line for line in lines)


def test_an_exchanged_model_of_equal_size_is_found(bench, inside, store):
    file = only(store, "jobs/encode-*/model/a.json")
    text = file.read_text()
    file.write_text(text.translate(str.maketrans("0123456789", "0987654321")))
    done = bench(*arguments(bench, packed(store)), code=1)
    assert "psnr is " in done.stderr


def test_a_model_that_cannot_be_decoded_does_not_hold(bench, inside, store):
    file = only(store, "jobs/encode-*/model/a.json")
    file.write_text("x" * len(file.read_text()))
    done = bench(*arguments(bench, packed(store)), code=1)
    assert "its model cannot be measured: JSONDecodeError" in done.stderr


def test_a_crash_while_decoding_ends_nothing_else(bench, store, tmp_path):
    plugins = tmp_path / "plugins"
    shutil.copytree(PLUGINS, plugins)
    file = plugins / "fake.py"
    head = "def load(self, folder, device):\n"
    assert head in file.read_text()
    file.write_text(file.read_text().replace(head, f"{head}        os.abort()\n"))
    path = packed(store)
    done = bench("verify", path, "--redo", 1, "--plugins", plugins, "--dataset", bench.dataset, code=1)
    assert "its model cannot be measured: its process ended with code -6" in done.stderr


def test_other_primitives_are_found(bench, inside, store):
    def many(record):
        record["measure"]["primitives"] = 7

    change_record(only(store, "jobs/measure-*/record.json"), many)
    done = bench(*arguments(bench, packed(store)), code=1)
    assert "has 7 primitives, decoded again 1" in done.stderr


def test_paths_that_a_bundle_names_are_not_opened(bench, inside, store):
    done = bench("verify", packed(store), "--redo", 1, "--plugins", PLUGINS, code=2)
    assert re_line(done.stderr, "not verified", "the truth is not here", "--dataset PATH")
    assert "all of it holds" not in done.stdout


def test_data_of_another_content_are_no_truth(bench, inside, store, tmp_path):
    other = tmp_path / "tiny"
    shutil.copytree(bench.dataset, other)
    picture = only(other, "a/test/r_0002.png")
    write_png(picture, np.full((8, 8, 4), 0.5, dtype=np.float32))
    done = bench("verify", packed(store), "--redo", 1, "--plugins", PLUGINS, "--dataset", other, code=2)
    assert re_line(done.stderr, "not verified", "has another content")


def test_a_method_of_another_version_is_not_judged(bench, store, tmp_path):
    plugins = tmp_path / "plugins"
    shutil.copytree(PLUGINS, plugins)
    file = plugins / "fake.py"
    file.write_text(file.read_text().replace('version="1"', 'version="2"'))
    done = bench(
        "verify", packed(store), "--redo", 1, "--plugins", plugins, "--dataset", bench.dataset, code=2
    )
    assert re_line(done.stderr, "not verified", "in version 1, and here is 2")
    assert "not verified" in bench("verify", packed(store), "--redo", 1, code=2).stderr


def test_without_models_nothing_can_be_measured(bench, inside, store):
    refusal = bench(*arguments(bench, packed(store, models=False)), code=2).stderr
    assert "bench bundle --models" in refusal


def re_line(text, *words):
    return any(all(word in line for word in words) for line in text.splitlines())


@pytest.mark.parametrize(
    ("limits", "words"),
    [(Limits(seconds=0.05), "time limit"), (Limits(memory=1.0), "memory limit")],
    ids=["time", "memory"],
)
def test_decoding_has_the_limits_of_jobs(bench, store, limits, words, monkeypatch):
    path = packed(store)
    # The truth lies in the store: what is limited here is the decoding.
    for name, value in bench.environment.items():
        monkeypatch.setenv(name, value)
    done = redo(Store(store), path, 1, datasets=[str(bench.dataset)], plugins=[str(PLUGINS)], limits=limits)
    assert done.problems == []
    assert words in done.unverified[0]
    with pytest.raises(DataError, match="holds no measured model"):
        redo(Store(Path(store.parent / "empty"), create=True), path, 1)


def test_the_hash_alone_draws_models_and_views(store):
    records = Store(store)
    (measure,) = (record for record in records.records() if record.job.kind == "measure")
    for number in range(4):
        key = f"{number:016x}"
        needs = (measure.job.needs[0], f"encode-{key}")
        records.finish(
            measure.model_copy(update={"job": measure.job.model_copy(update={"key": key, "needs": needs})})
        )
        (records.jobs / f"encode-{key}" / "model").mkdir(parents=True)
    draws = [Draw(f"{digest:064x}") for digest in range(20)]
    names = [[record.job.id for record in draw.models(records, 2)] for draw in draws]
    assert names == [[record.job.id for record in draw.models(records, 2)] for draw in draws]
    assert all(len(set(pair)) == 2 for pair in names)
    assert len({pair[0] for pair in names}) > 2
    assert len(draws[0].models(records, 99)) == 5

    record = draws[0].models(records, 1)[0]
    many = record.result.views * 4
    longer = record.model_copy(update={"result": record.result.model_copy(update={"views": many})})
    places = [draw.views(longer) for draw in draws]
    assert all(len(set(one)) == VIEWS and one == sorted(one) for one in places)
    assert len({tuple(one) for one in places}) > 10
