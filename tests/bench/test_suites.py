"""Suites that come with the program: each can be planned anywhere, with stand-ins where data are missing."""

import pytest

from bench.plan import Planner
from bench.selection import Selection
from bench.suites import VIEWS, load_suite, names
from datasets.catalogue import list_datasets
from datasets.errors import DataError, UnknownName

BUILT_IN = {info.name for info in list_datasets() if info.kind == "procedural"}


@pytest.mark.parametrize("name", names())
def test_every_dataset_of_a_suite_is_known_and_what_is_missing_has_a_stand_in_or_is_left_out(name):
    suite = load_suite(name)
    assert set(suite.datasets) <= {info.name for info in list_datasets()}
    without = suite.present(BUILT_IN)
    if name not in ("real-volumes", "unstructured"):
        assert without, "nothing to run without data"
        assert set(without) <= BUILT_IN
    assert suite.preset == "quick" or name == "datasets"
    assert set(suite.presets) == set(VIEWS)


@pytest.mark.parametrize("name", ["design", "storage", "hyperparameters", "threshold", "init-points"])
def test_variants_of_a_suite_are_options_that_methods_have(name, monkeypatch):
    monkeypatch.setattr("bench.selection.chosen_datasets", lambda *_: [])
    monkeypatch.setattr("bench.plan.chosen_datasets", lambda *_: [])
    suite = load_suite(name)
    planner = Planner(Selection(suite), {})
    assert len(planner._settings) == len(suite.variants)


def test_stand_ins_take_the_place_of_missing_data_only():
    suite = load_suite("univariate")
    everything = set(suite.datasets)
    assert list(suite.present(everything)) == list(suite.datasets)
    assert "vortices" not in suite.present(everything)
    some = suite.present({"vortex"})
    assert "vortex" in some
    assert some["jet_flame"] == ("mf",)
    assert "vortex_views" not in some


def suite_file(folder, datasets, more=""):
    path = folder / "suite.toml"
    path.write_text(f'title = "t"\nmethods = ["3dgs"]\npreset = "quick"\n{more}[datasets]\n{datasets}\n')
    return str(path)


def test_a_suite_may_fit_with_several_numbers_of_training_views(dataset, tmp_path):
    suite = load_suite(suite_file(tmp_path, f'"{dataset}" = ["a"]', "train_views = [6, 12]\n"))
    jobs = Planner(Selection(suite), {}).jobs(None)
    assert [job.request.train_views for job in jobs if job.kind == "fit"] == [6, 12]
    assert len({job.id for job in jobs}) == len(jobs) == 8


def test_bad_suites_are_refused_by_name(tmp_path):
    with pytest.raises(UnknownName, match=r"shels.*shells"):
        load_suite(suite_file(tmp_path, 'shells = []\n[stand_ins]\nshels = ""'))
    suite = load_suite(suite_file(tmp_path, 'vortex = []\n[stand_ins]\nvortex = ""'))
    with pytest.raises(DataError, match="none of its datasets has data"):
        Planner(Selection(suite), {})
