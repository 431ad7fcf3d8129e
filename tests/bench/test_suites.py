"""Suites that come with the program: each can be planned anywhere, with stand-ins where data are missing."""

from dataclasses import replace

import pytest

from econgs_bench.bench.plan.planner import Planner
from econgs_bench.bench.plan.selection import Selection
from econgs_bench.bench.suites.edits import edits_of
from econgs_bench.bench.suites.suite import VIEWS, load_suite, names
from econgs_bench.datasets.catalogue import list_datasets
from econgs_bench.datasets.errors import DataError, UnknownName
from econgs_bench.reports.sections.paper.layouts import layouts, published_as, takes
from tests.bench.conftest import plan, suite_file

BUILT_IN = {info.name for info in list_datasets() if info.kind == "procedural"}


@pytest.mark.parametrize("name", names())
def test_every_dataset_of_a_suite_is_known_and_what_is_missing_has_a_stand_in_or_is_left_out(name):
    suite = load_suite(name)
    assert _members(suite.datasets) <= {info.name for info in list_datasets()}
    without = _members(suite.present(BUILT_IN))
    if name not in ("tuning", "unseen-data", "unseen-schedules", "unstructured"):
        assert without, "nothing to run without data"
        assert without <= BUILT_IN
    own = {"stability": "small", "unseen-schedules": "full"}
    assert suite.preset == own.get(name, "quick") or name == "datasets"
    assert set(suite.presets) >= set(VIEWS)


def _members(sources):
    """Names of the catalogue's sets, without resolution."""
    return {part.partition("@")[0] for source in sources for part in source.split("+")}


@pytest.mark.parametrize("name", names())
def test_without_data_a_suite_names_scenes_that_its_datasets_have(name):
    known = {info.name: {*info.scenes, *info.compositions} for info in list_datasets([])}
    known["beetle_like+argon_bubble_like"] = set()  # of which all scenes are learned
    here = [info.name for info in list_datasets([]) if info.available]
    for dataset, choices in load_suite(name).present(here).items():
        assert {scene for choice in choices for scene in choice} <= known[dataset.partition("@")[0]]


@pytest.mark.parametrize("name", ["design", "storage", "hyperparameters", "threshold", "init-points"])
def test_variants_of_a_suite_are_options_that_methods_have(name, monkeypatch):
    monkeypatch.setattr("econgs_bench.bench.plan.selection.subsets", lambda *_: [])
    monkeypatch.setattr("econgs_bench.bench.plan.planner.subsets", lambda *_: [])
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
    assert some["jet_flame"] == (("mf",),)
    assert "vortex_views" not in some


@pytest.mark.parametrize("name", sorted(layouts()["tables"]))
def test_a_table_of_the_paper_shows_what_its_suite_runs(name):
    suite = load_suite(name)
    for dataset in {*suite.datasets, *suite.stand_ins.values()} - {""}:
        assert published_as(name, dataset) or takes(name, dataset), dataset
    extra = layouts()["tables"][name].get("data", [])
    assert set(extra) <= set(suite.datasets)
    methods = {row["method"] for row in layouts()["tables"][name]["rows"]}
    assert methods <= {*suite.methods, *suite.optional}


@pytest.mark.parametrize(
    ("name", "datasets"),
    [
        ("joint-gain", {"ionization": 2, "combustion": 2, "vortex_views": 1}),
        ("timing", {"ionization": 1, "combustion": 1, "supernova": 1, "vortex": 1}),
        ("rate-distortion", {"supernova": 1, "ionization": 1}),
        ("datasets", dict.fromkeys(["argon_bubble", "combustion", "ionization", "supernova", "beetle"], 1)),
        ("datasets", dict.fromkeys(["vortex", "tangaroa"], 1)),
    ],
)
def test_suites_run_the_datasets_of_the_papers_tables(name, datasets):
    suite = load_suite(name)
    assert {one: len(suite.datasets[one]) for one in datasets} == datasets
    assert all(suite.stand_ins[one] for one in set(datasets) - {"vortex_views"})


def test_all_methods_are_on_the_rate_distortion_chart():
    """Codecs are rates of one fit."""
    shown = {*load_suite("univariate").methods, "3dgs-coded"}
    assert set(load_suite("rate-distortion").methods) == shown


def test_a_suite_may_run_several_choices_of_a_datasets_scenes(dataset, tmp_path):
    """What is learned together with others is another model."""
    suite = suite_file(tmp_path, f'"{dataset}" = [["a", "b"], []]')
    jobs = plan(suite, methods=("fake-joint",))
    assert scenes_of("partition", jobs) == [("a", "b"), ("a", "b", "c")]
    assert sum(job.kind == "views" for job in jobs) == 3
    assert scenes_of("fit", plan(suite, scenes=("c",))) == [("c",)]


def test_lengths_are_further_fits_of_trained_methods_at_their_own_rate(dataset, tmp_path):
    """Published defaults of both presets; methods that learn nothing have one length."""
    suite = suite_file(tmp_path, f'"{dataset}" = ["a"]', 'lengths = [0.25, 1.0, 4.0]\nrates = "all"')
    names = ("3dgs", "hac")
    fits = [job for job in plan(suite, methods=names) if job.kind == "fit"]
    found = {name: [fit.iterations for fit in fits if fit.method == name] for name in names}
    assert found["3dgs"] == [1_200, 300, 4_800]
    assert sorted(set(found["hac"])) == [400, 1_600, 6_400]
    assert found["hac"].count(1_600) > 1 == found["hac"].count(400) == found["hac"].count(6_400)
    size = "train_views = 12\ntest_views = 4\nwidth = 8\nheight = 8\nprerendered_limit = 8"
    short = f"[presets.quick]\nbudget = 0.1\n{size}"
    suite = suite_file(tmp_path, f'"{dataset}" = ["a"]', f"lengths = [0.25]\n{short}")
    fits = [job for job in plan(suite, methods=("3dgs",)) if job.kind == "fit"]
    assert [fit.iterations for fit in fits] == [120, 30]
    volume = suite_file(tmp_path, '"argon_bubble_like@32" = []', "lengths = [4.0]")
    assert sum(job.kind == "partition" for job in plan(volume, methods=("sz3",))) == 1
    assert sum(job.kind == "partition" for job in plan(volume, methods=("econgs",))) == 2


def test_variants_of_a_method_that_is_not_there_are_refused(dataset, tmp_path):
    suite = suite_file(tmp_path, f'"{dataset}" = ["a"]', "variants = [{}, { 3dgsx.iterations = 20 }]")
    with pytest.raises(UnknownName, match=r"3dgsx.*3dgs"):
        plan(suite, methods=("3dgs",))


@pytest.mark.parametrize("length", ["1e300", "inf", "nan"])
def test_a_length_that_is_none_is_refused(dataset, tmp_path, length):
    with pytest.raises(DataError, match="lengths"):
        load_suite(suite_file(tmp_path, f'"{dataset}" = ["a"]', f"lengths = [{length}]"))


def test_a_group_has_the_iterations_that_its_scenes_ask_for(dataset, tmp_path):
    suite = suite_file(tmp_path, f'"{dataset}" = ["a", "b"]')

    def iterations(**options):
        jobs = plan(suite, methods=("fake-joint",), overrides={"fake-joint": options})
        return [job.iterations for job in jobs if job.kind == "partition"]

    assert iterations() == [20]
    assert iterations(group_budget=1.0) == [40]
    assert iterations(group_budget=0.5) == [28]
    assert iterations(group_budget=1.0, iterations=7) == [14]


def scenes_of(kind, jobs):
    return [job.scenes for job in jobs if job.kind == kind]


def test_naming_one_of_a_suites_datasets_keeps_the_suites_scenes_of_it(dataset, tmp_path):
    suite = suite_file(tmp_path, f'"{dataset}" = ["a", "b"]\nvortices = []')
    assert scenes_of("fit", plan(suite, datasets=(str(dataset),))) == [("a",), ("b",)]
    assert scenes_of("fit", plan(suite, datasets=(str(dataset),), scenes=("c",))) == [("c",)]
    assert scenes_of("fit", plan(suite, datasets=("shells",))) == [("outer",), ("middle",), ("core",)]


def test_a_suite_may_fit_with_several_numbers_of_training_views(dataset, tmp_path):
    jobs = plan(suite_file(tmp_path, f'"{dataset}" = ["a"]', "train_views = [6, 12]"))
    assert [job.request.train_views for job in jobs if job.kind == "fit"] == [6, 12]
    assert len({job.id for job in jobs}) == len(jobs) == 8


def test_a_suite_may_record_more_anchors_than_others(dataset, tmp_path):
    def measure(more: str = ""):
        jobs = plan(suite_file(tmp_path, f'"{dataset}" = ["a"]', more))
        return next(job for job in jobs if job.kind == "measure")

    usual, many = measure(), measure("sampled = 1000")
    assert (usual.sampled, many.sampled) == (100, 1000)
    assert usual.id == measure("sampled = 100").id != many.id
    assert usual.needs == many.needs
    assert load_suite("features").sampled == 1000


@pytest.mark.parametrize(
    ("datasets", "more", "error", "words"),
    [
        ("shells = []", "sampled = 0", DataError, r"sampled \(line \d+\): .*greater than or equal to 1"),
        ("shells = []", "threads = 0", DataError, r"threads \(line \d+\)"),
        ("shells = []", "train_views = [true]", DataError, r"train_views\[0\] \(line \d+\): .*integer"),
        ("shells = []", "train_views = [1_000_000_000]", DataError, r"train_views\[0\]"),
        ("shells = []", "variants = [{ econgs = 3 }]", DataError, r"variants\[0\].econgs \(line \d+\)"),
        ("shells = []", "compositions = 3", DataError, r"compositions \(line \d+\): is no list of names"),
        ("shells = []", "sedes = [1]", DataError, r"sedes \(line \d+\): unknown key, perhaps seeds"),
        ("shells = []", "repeats = [inf]", DataError, r"repeats\[0\]"),
        ("shells = []", "repeats = [-1]", DataError, r"repeats\[0\]"),
        ("shells = []", f"edits = {'[' * 5000}{']' * 5000}", DataError, "nested too deeply"),
        ("shells = [3]", "", DataError, r"datasets.shells \(line \d+\): is no list of names"),
        ('shells = []\n[stand_ins]\nshels = ""', "", UnknownName, r"shels.*shells"),
        ('vortex = []\n[stand_ins]\nvortex = ""', "", DataError, "none of its datasets has data"),
        ('shells = ["outer", ["core"]]', "", DataError, "names, or lists of names"),
    ],
)
def test_bad_suites_are_refused_by_name(tmp_path, datasets, more, error, words):
    with pytest.raises(error, match=words):
        plan(suite_file(tmp_path, datasets, more))


@pytest.mark.parametrize(
    ("key", "value"),
    [("width", '"x"'), ("width", "0"), ("height", "-5"), ("test_views", "-3"), ("cloud_points", "-1")]
    + [
        ("width", "1_000_000"),
        ("cloud_points", "100_000_000_000"),
        ("train_views", "true"),
        ("budget", "nan"),
    ],
)
def test_a_preset_that_cannot_be_is_refused_with_key_and_line(tmp_path, key, value):
    numbers = dict.fromkeys(["train_views", "test_views", "width", "height", "prerendered_limit"], "8")
    lines = [f"{name} = {number}" for name, number in (numbers | {key: value}).items()]
    head = 'title = "t"\npreset = "mine"\nmethods = ["3dgs"]\n[datasets]\nshells = []\n[presets.mine]'
    path = tmp_path / "mine.toml"
    path.write_text("\n".join([head, *lines]), encoding="utf-8")
    line = 7 + list(numbers | {key: value}).index(key)
    with pytest.raises(DataError, match=rf"presets.mine.{key} \(line {line}\)"):
        load_suite(str(path))
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(DataError, match="is no TOML file"):
        load_suite(str(path))


def test_a_preset_of_a_name_of_its_own_takes_options_and_iterations_of_another(tmp_path):
    own = (
        'presets.small = { like = "quick", train_views = 6, test_views = 2, width = 8, height = 8,'
        " prerendered_limit = 8 }"
    )

    def fit(more, preset, **options):
        suite = suite_file(tmp_path, "vortices = []", more)
        jobs = plan(suite, preset=preset, methods=("hac",), overrides={"hac": options})
        return next(job for job in jobs if job.kind == "fit")

    usual, small = fit("", "quick"), fit(own, "small")
    assert (small.preset, small.options, small.iterations) == ("small", usual.options, usual.iterations)
    assert (small.request.width, small.request.train_views) == (8, 6)
    half = own.replace(" }", ", budget = 0.5 }")
    assert fit(half, "small").iterations == usual.iterations // 2
    assert fit(half, "small", iterations=77).iterations == 77
    assert fit(own, "standard").request.width == VIEWS["standard"].width
    with pytest.raises(UnknownName, match="preset"):
        fit(own.replace("quick", "quik"), "small")
    for share in ("0.0", "-1.0", "1.5", "nan"):
        with pytest.raises(DataError, match=r"presets\.small\.budget"):
            fit(half.replace("0.5", share), "small")


def test_initial_clouds_have_the_points_that_an_option_asks_for():
    """And, where it asks for less than the preset gives, that many: an older fit stays the same."""
    selection = replace(Selection(load_suite("init-points")), datasets=("beetle_like",))
    jobs = {job.variant: job for job in Planner(selection, {}).jobs(None) if job.kind == "partition"}
    points = {variant: job.cloud_points for variant, job in jobs.items()}
    assert points == {
        "": 10_000, "cloud_points=1000": 10_000, "cloud_points=100000": 100_000,
        "cloud_points=500000": 500_000,
        "random_points=500000,start=random": 10_000, "random_points=100000,start=random": 10_000,
        "start=random": 10_000, "random_points=1000,start=random": 10_000,
    }  # fmt: skip
    assert all(job.identity["cloud_points"] == job.cloud_points for job in jobs.values())
    assert set(points) == {row.get("variant", "") for row in layouts()["tables"]["init-points"]["rows"]}


def test_starts_are_compared_early_as_well():
    """A twentieth of the iterations, of each start, as a ladder."""
    selection = replace(Selection(load_suite("init-attributes")), datasets=("beetle_like",))
    jobs = [job for job in Planner(selection, {}).jobs(None) if job.kind == "partition"]
    budgets = {(job.variant, job.stress): job.iterations for job in jobs}
    assert set(budgets) == {
        (start, stress) for start in ("", "start=positions", "start=random") for stress in ("", "budget=0.05")
    }
    assert budgets["", "budget=0.05"] == round(0.05 * budgets["", ""])


def test_compositions_are_edited_step_by_step():
    suite = load_suite("editing")
    steps = [edits_of(["a", "b", "c"], chain) for chain in suite.chains]
    assert [one["a"].light for one in steps] == [(1.0, 0.0, 0.0)] * 4
    assert [one["a"].diffuse for one in steps] == [None, 1.5, 1.5, 1.5]
    assert [one["b"].opacity for one in steps] == [None, None, 0.3, 0.3]
    assert [one["c"].palette is not None for one in steps] == [False, False, False, True]
