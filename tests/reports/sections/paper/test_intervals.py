"""Ratios of bytes and times have intervals, and rows are ranked among their rivals alone."""

import numpy as np
import pytest
from scipy import stats

from econgs_bench.reports.sections.paper.claims import (
    AMONG,
    FAILS,
    HOLDS,
    NOT_DECIDED,
    UNKNOWN,
    check,
    claims,
)
from econgs_bench.reports.sections.paper.intervals import ratio, same
from econgs_bench.reports.sections.paper.layouts import layouts
from econgs_bench.reports.sections.paper.values import PaperRow, Value
from econgs_bench.reports.sections.paper.verdicts import to_html, to_text
from econgs_bench.reports.statistics import Views
from tests.reports.sections.paper.test_paper_tables import (
    SCENES,
    blocks,
    four,
    line,
    paper_tables,
    results,
    row,
    seen,
    waves,
)


def sized(*sizes, column="size_bytes"):
    """A row whose scenes have these values; a list has those of several seeds."""
    parts = {
        (f"s{i}", str(seed)): float(value)
        for i, own in enumerate(sizes)
        for seed, value in enumerate(np.atleast_1d(own))
    }
    return PaperRow("x", {column: Value(1.0)}, parts={column: parts})


def verdicts(rows, views=None):
    return {one.claim: one for one in check(paper_tables(rows, views), Views(views))}


def rivals(method, *sizes, **changed):
    return [
        row(method, scene, 30.0, size_bytes=size, **changed)
        for scene, size in zip(SCENES, sizes, strict=True)
    ]


def test_a_ratio_of_sums_has_the_interval_of_resampled_scenes():
    """Against the spread of the ratio over samples of scenes that are drawn anew."""
    rng = np.random.default_rng(3)
    sample = rng.lognormal(3.0, 0.5, (4000, 12))
    other = sample * rng.lognormal(0.2, 0.15, sample.shape)
    truth = np.log(other.sum(1) / sample.sum(1)).std()
    found = [ratio(sized(*b), sized(*a), "size_bytes") for a, b in zip(sample[:60], other[:60], strict=True)]
    error = [np.log(one.high / one.low) / 2 / stats.t.ppf(0.975, 11) for one in found]
    assert np.sqrt(np.mean(np.square(error))) == pytest.approx(truth, rel=0.1)
    held = [one.low < np.exp(0.2 + 0.15**2 / 2) < one.high for one in found]
    assert 53 <= sum(held) <= 60
    one = found[0]
    assert one.mean == pytest.approx(other[0].sum() / sample[0].sum())
    assert np.sqrt(one.low * one.high) == pytest.approx(one.mean), "on the logarithm"


def test_seeds_add_to_the_interval_and_alone_make_one():
    seeds = [100.0, 110.0, 130.0]
    alone = ratio(sized(seeds), sized([50.0, 50.0, 50.0]), "size_bytes")
    logs = np.log(np.array(seeds) / 50.0)
    half = stats.t.ppf(0.975, 2) * logs.std(ddof=1) / np.sqrt(3)
    assert np.log(alone.high / alone.low) / 2 == pytest.approx(half)
    assert (alone.views, alone.seeds) == (1, 3)
    both = ratio(sized(seeds, [300.0] * 3), sized([50.0] * 3, [100.0] * 3), "size_bytes")
    shares = np.array([np.mean(seeds), 300.0]) / (np.mean(seeds) + 300.0) - np.array([50.0, 100.0]) / 150.0
    of_seeds = np.log((np.array(seeds) + 300.0) / 150.0)
    terms = np.array([2 * shares @ shares, of_seeds.var(ddof=1) / 3])
    freedom = terms.sum() ** 2 / (terms**2 / (1, 2)).sum()
    half = stats.t.ppf(0.975, freedom) * np.sqrt(terms.sum())
    assert np.log(both.high / both.low) / 2 == pytest.approx(half)
    assert ratio(sized(100.0), sized(50.0), "size_bytes") is None, "nothing is repeated"
    assert ratio(sized(1.0, 2.0), sized(1.0, 2.0, 3.0), "size_bytes") is None, "other scenes"
    assert ratio(sized(1.0, 2.0), sized(1.0, 3.0), "size_bytes").mean == pytest.approx(3 / 4)
    memory = [sized(1.0, 2.0, column="peak_host_bytes") for _ in range(2)]
    assert ratio(*memory, "peak_host_bytes") is None, "a maximum is no mean"


def test_bytes_that_differ_less_than_scenes_do_decide_nothing():
    """The review: 1.02 times smaller, where the answers have an interval of 0.76 to 1.41."""
    ours, theirs = rivals("econgs", 100, 100, 100, 100), rivals("hac", 75, 75, 129, 130)
    found = verdicts(results(*ours, *theirs))
    for name in ("uni-small", "uni-hac-size", "uni-compressed-size"):
        one = found[name]
        assert (one.verdict, one.measured) == (NOT_DECIDED, pytest.approx(1.0225)), name
        assert one.interval.low < 1.0 < one.interval.high
    clear = verdicts(results(*ours, *rivals("hac", 190, 200, 210, 205)))
    assert clear["uni-hac-size"].verdict == HOLDS
    assert verdicts(results(*ours, *rivals("hac", 50, 51, 52, 49)))["uni-hac-size"].verdict == FAILS


def test_a_rival_that_is_not_the_best_may_leave_a_claim_open():
    """HAC is the smallest other one and larger on all scenes; iVR-GS has a wide interval."""
    rows = [*rivals("econgs", 100, 101, 99, 100), *rivals("hac", 150, 151, 149, 152)]
    assert verdicts(results(*rows))["uni-compressed-size"].verdict == HOLDS
    rows += rivals("ivr-gs", 40, 60, 300, 300)
    found = verdicts(results(*rows))["uni-compressed-size"]
    assert (found.verdict, found.measured) == (NOT_DECIDED, pytest.approx(1.75))


def test_times_and_frame_rates_have_intervals_too():
    def rows(*times):
        theirs = [
            row("ivr-gs", scene, 30.0, train_seconds=120.0 * time, fps=100.0 / time)
            for scene, time in zip(SCENES, times, strict=True)
        ]
        return verdicts(results(*four("econgs", 30.0), *theirs))

    assert rows(4.0, 4.1, 3.9, 4.0)["uni-ivrgs-time"].verdict == HOLDS
    assert rows(1.0, 8.0, 4.0, 3.0)["uni-ivrgs-time"].verdict == NOT_DECIDED
    four_at_once = rows(0.5, 1.5, 1.4, 1.3)["rw-four"]
    assert four_at_once.verdict == NOT_DECIDED
    assert "Training" in four_at_once.why
    assert "FPS" in four_at_once.why


def test_equal_models_are_no_evidence():
    """Clouds of fewer points than are asked for make one model of several options."""
    clouds = [
        four("econgs", 35.0, variant=name) for name in ("", "cloud_points=100000", "cloud_points=500000")
    ]
    clouds = [
        one | {"start_points": 10_000, "options": "{}", "dataset": "beetle", "scene": "TF"}
        for own in clouds
        for one in own[:1]
    ]
    rows = results(*clouds)
    found = verdicts(rows, seen(rows, waves(0.1)))
    for name in ("init-more", "init-more-size"):
        assert found[name].verdict == NOT_DECIDED, name
        assert "the same model" in found[name].why
    clouds[1]["psnr"] -= 1.0
    clouds[2]["psnr"] -= 2.0
    other = verdicts(results(*clouds))
    assert other["init-more"].verdict == HOLDS, "means alone: there are no views"
    sizes = {"size_bytes": {("s", "0"): 10.0}, "psnr": {("s", "0"): 30.0}}
    times = [PaperRow("x", {}, parts={**sizes, "fps": {("s", "0"): value}}) for value in (1.0, 2.0)]
    assert same(*times), "a time is not of the model"
    assert not same(times[0], PaperRow("x", {}, parts=sizes | {"psnr": {("s", "0"): 30.1}}))
    assert not same(PaperRow("x", {}), PaperRow("x", {}))


def test_a_claim_on_all_names_who_is_better_beside_it():
    """The review: the highest PSNR of all, beside a bold value of a method that the claim does not name."""
    named = [*four("econgs", 35.86), *four("3dgs", 34.0, size_bytes=2**22, train_seconds=500.0)]
    assert verdicts(results(*named))["uni-best"].verdict == HOLDS
    beside = four("veg", 36.63, size_bytes=2**20, train_seconds=600.0)
    found = verdicts(results(*named, *beside))
    best = found["uni-best"]
    assert best.verdict == AMONG
    assert "VEG, 38.13" in best.why, "the mean of four scenes"
    assert "ECoNGS-R 37.36" in best.why
    assert found["uni-small"].verdict == HOLDS
    assert found["concl"].verdict == AMONG
    text = to_text(list(found.values()))
    (shown,) = (one for one in text.splitlines() if " uni-best " in one)
    assert shown.startswith(AMONG)
    assert "VEG, 38.13" in shown
    assert "VEG, 38.13" in to_html(list(found.values()))
    # It fails where a rival that it names is ahead, whoever else is.
    failing = verdicts(results(*four("econgs", 33.0), *four("3dgs", 34.0), *beside))["uni-best"]
    assert failing.verdict == FAILS


def test_claims_on_all_methods_know_every_row_of_their_table():
    """A method that joins the table joins `beside`, or the claim."""
    lines = layouts()["tables"]["univariate"]["rows"]
    for claim in claims():
        if claim["id"] in ("uni-best", "uni-small", "concl"):
            known = {*claim["rows"][1], *claim["beside"], "ECoNGS-R", "ECoNGS (published)"}
            assert known == {one["label"] for one in lines}
            assert set(claim["rows"][1]) == {
                one["label"] for one in lines if "match" in one and not one["label"].startswith("ECoNGS")
            }, "those with a published row"
        assert set(claim.get("beside", ())) <= {one["label"] for one in lines}


def test_a_measured_row_without_a_value_has_a_verdict_with_the_reason():
    rows = [*four("econgs", 35.0, fps=None), *four("3dgs", 34.0)]
    one = verdicts(results(*rows))["vortex-fps"]
    assert (one.verdict, one.measured) == (UNKNOWN, None)
    assert one.where == "vortex_views, paper, 92 views"
    assert "FPS of ECoNGS-R" in one.why
    assert "FPS of ECoNGS-R" in to_text([one])
    assert "FPS of ECoNGS-R" in to_html([one])
    omitted = [*four("econgs", 35.0, omissions='{"lpips_vgg": "no weights"}'), *four("3dgs", 34.0)]
    omitted += four("econgs", 34.0, variant="view_direction=true", omissions='{"lpips_vgg": "no weights"}')
    assert "no weights" in verdicts(results(*omitted))["abl-vca-lpips"].why


def test_clocks_of_several_processors_are_not_compared():
    """The review: joint learning was 1.38 times faster on one processor, and 0.82 over two."""
    places = (("Intel", 1251.0, 1721.0), ("AMD", 800.0, 780.0), ("AMD", 790.0, 600.0))
    rows = [
        row(
            scene=scene,
            seed=seed,
            variant=variant,
            train_seconds=time / 4,
            fit_processor=place,
            processor=place,
        )
        for seed, (place, joint, alone) in enumerate(places)
        for variant, time in (("", joint), ("joint=false", alone))
        if not (variant == "" and place == "AMD")
        for scene in SCENES
    ]
    found = verdicts(results(*rows))["joint-time"]
    assert found.measured is None or found.measured == pytest.approx(1721.0 / 1251.0, rel=1e-6)


def test_the_design_table_compares_the_options_that_the_claims_mean():
    """The default has no view direction; the option that has it is the paper's full model."""
    rows = [
        *four("econgs", 39.51, size_bytes=100),
        *four("econgs", 39.98, variant="view_direction=true", size_bytes=107),
    ]
    rows += four("econgs", 39.0, variant="context=false", size_bytes=800)
    found = verdicts(results(*rows))
    assert found["abl-vca-psnr"].measured == pytest.approx(0.47)
    assert found["abl-vca-size"].measured == pytest.approx(100 / 107)
    assert found["abl-ctx"].measured == pytest.approx(8.0), "of the model that differs in the context alone"


def test_rows_are_marked_among_those_of_equal_scenes_and_views():
    """Never a composition against its scenes, nor one number of views against another."""
    scenes = [f"t_{i}" for i in range(4)]
    data = {"dataset": "ionisation_like", "scenes_together": None}
    rows = [
        row(method, scene, psnr, **data)
        for method, psnr in (("veg", 33.0), ("econgs", 32.5))
        for scene in scenes
    ]
    rows += [
        row(method, "t", psnr, kind="composed", **data) for method, psnr in (("veg", 31.0), ("econgs", 30.0))
    ]
    (block,) = blocks(results(*rows), "veg")
    places = {block.rows[i].label: place for (i, name), place in block.marks.items() if name == "psnr"}
    assert places == {"basic, VEG": 1, "basic, ECoNGS-R": 2, "composed, VEG": 1, "composed, ECoNGS-R": 2}
    views = [
        row(method, scene, psnr, dataset="argon_bubble_like", requested_views=count, train_views=count)
        for count, base in ((6, 25.0), (92, 35.0))
        for method, psnr in (("ivr-gs", base), ("econgs", base + 1.0))
        for scene in SCENES[:2]
    ]
    (block,) = blocks(results(*views), "limited-views")
    places = {block.rows[i].label: place for (i, name), place in block.marks.items() if name == "psnr"}
    assert places["6 views, ECoNGS-R"] == places["92 views, ECoNGS-R"] == 1
    assert places["6 views, iVR-GS"] == places["92 views, iVR-GS"] == 2
    fuzzy = [
        row(scene=name, dataset="vortices_fuzzy", psnr=psnr)
        for name, psnr in (("blue_fog", 40.0), ("red_fog", 41.0))
    ]
    (block,) = blocks(results(*fuzzy), "fuzzy")
    assert block.marks == {}, "two scenes are no rivals"


def test_sizes_of_compositions_count_a_shared_model_once():
    """Three scenes, one model each, shown in two compositions; and a joint model of all."""
    mib = 2**20

    def rows(method, joint):
        names = ("a", "b", "c")
        group = "a+b+c"
        own = [
            row(method, name, 30.0, dataset="csafe_heptane", group=group if joint else name,
                group_bytes=6 * mib if joint else 2 * mib, size_bytes=2 * mib)
            for name in names
        ]  # fmt: skip
        for name, members in (("all", "abc"), ("two", "ab")):
            groups = group if joint else ",".join(members)
            size = 2 * mib * len(members)
            own.append(
                row(
                    method,
                    name,
                    29.0,
                    dataset="csafe_heptane",
                    kind="composed",
                    group=groups,
                    size_bytes=size,
                )
            )
        return own

    (block,) = blocks(results(*rows("veg", False), *rows("econgs", True)), "veg")
    assert line(block, "basic, VEG").values["size_bytes"].mean == pytest.approx(6.0)
    assert line(block, "composed, VEG").values["size_bytes"].mean == pytest.approx(6.0), "not 10"
    assert line(block, "composed, ECoNGS-R").values["size_bytes"].mean == pytest.approx(6.0)
