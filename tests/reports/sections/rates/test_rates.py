from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from econgs_bench.reports.curves import Curve, Point
from econgs_bench.reports.family import Family
from econgs_bench.reports.sections.rates import conclusion as rates
from econgs_bench.reports.sections.rates import intervals
from econgs_bench.reports.sections.rates.conclusion import Difference, difference, differences, p_values
from econgs_bench.reports.statistics import Views
from econgs_bench.reports.style import Model

ANCHOR = ([1358.24, 2486.44, 4593.60, 9487.76], [34.851, 36.845, 38.615, 40.037])
TEST = ([1356.24, 2451.52, 4469.00, 9787.80], [34.987, 36.970, 38.651, 40.121])


def curve(size, psnr, title="x"):
    points = (Point("", b, q, {}) for b, q in zip(size, psnr, strict=True))
    return Curve("d", Model(title), tuple(points))


def akima(x, y, at):
    """Akima (1970) in a few lines: slopes from weighted neighbours, two phantom points at each end."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    m = np.diff(y) / np.diff(x)
    m = np.concatenate(
        [[3 * m[0] - 2 * m[1], 2 * m[0] - m[1]], m, [2 * m[-1] - m[-2], 3 * m[-1] - 2 * m[-2]]]
    )
    left, right = np.abs(m[3:] - m[2:-1])[: len(x)], np.abs(m[1:-2] - m[:-3])[: len(x)]
    slope = (left * m[1:-2] + right * m[2:-1]) / (left + right)
    i = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(x) - 2)
    h = x[i + 1] - x[i]
    t = (at - x[i]) / h
    return (
        (2 * t**3 - 3 * t**2 + 1) * y[i]
        + (t**3 - 2 * t**2 + t) * h * slope[i]
        + (3 * t**2 - 2 * t**3) * y[i + 1]
        + (t**3 - t**2) * h * slope[i + 1]
    )


def test_an_independent_implementation_agrees():
    """On the example of the reference implementation of Akima's interpolation for BD-rate."""
    pair = difference(curve(*ANCHOR), curve(*TEST))
    q = np.linspace(max(ANCHOR[1][0], TEST[1][0]), min(ANCHOR[1][-1], TEST[1][-1]), 20_001)
    gap = np.mean(akima(TEST[1], np.log10(TEST[0]), q) - akima(ANCHOR[1], np.log10(ANCHOR[0]), q))
    assert pair.rate == pytest.approx(100 * (10**gap - 1), abs=0.01)
    r = np.linspace(*np.log10([ANCHOR[0][0], ANCHOR[0][-1]]), 20_001)
    gap = np.mean(akima(np.log10(TEST[0]), TEST[1], r) - akima(np.log10(ANCHOR[0]), ANCHOR[1], r))
    assert pair.psnr == pytest.approx(gap, abs=1e-3)
    assert pair.psnr_range == (34.987, 40.037)
    assert pair.bytes_range == pytest.approx((1358.24, 9487.76))
    assert (pair.warnings, pair.refused) == ((), "")


@pytest.mark.parametrize(("factor", "rate"), [(0.8, -20.0), (1.25, 25.0), (0.01, -99.0)])
def test_the_rate_is_the_bytes_at_equal_quality(factor, rate):
    size, psnr = np.array(ANCHOR[0]), ANCHOR[1]
    assert difference(curve(size, psnr), curve(size * factor, psnr)).rate == pytest.approx(rate)


@pytest.mark.parametrize("gain", [1.0, -20.0])
def test_a_decibel_more_at_equal_bytes_is_a_decibel(gain):
    size, psnr = ANCHOR[0], np.array(ANCHOR[1])
    assert difference(curve(size, psnr), curve(size, psnr + gain)).psnr == pytest.approx(gain)


def test_curves_may_have_different_numbers_of_points():
    size = np.geomspace(1e4, 1e6, 6)
    psnr = 10 * np.log10(size)
    fewer = curve(np.geomspace(1e4, 1e6, 4) / 2, np.linspace(40.0, 60.0, 4))
    pair = difference(curve(size, psnr), fewer)
    assert pair.rate == pytest.approx(-50.0)


@pytest.mark.parametrize(
    ("size", "psnr", "reason"),
    [
        (ANCHOR[0][:3], ANCHOR[1][:3], "b has 3 points, 4 are needed"),
        (ANCHOR[0], [34.0, 36.0, 35.0, 40.0], "b has 3 points on its front, 4 are needed"),
        ([1e5, 2e5, 3e5, 4e5], [24.0, 26.0, 28.0, 30.0], "no overlap of their PSNR: 34.85 to 40.04"),
    ],
)  # fmt: skip
def test_refused_with_the_reason(size, psnr, reason):
    pair = difference(curve(*ANCHOR, "a"), curve(size, psnr, "b"))
    assert pair.refused.startswith(reason)
    assert pair.rate is pair.psnr is None


def test_models_that_others_of_the_same_method_beat_are_left_out():
    """As rates that are codecs: one that is larger and worse than another says nothing of the method."""
    size, psnr = [*ANCHOR[0], 5000.0, 20000.0], [*ANCHOR[1], 36.0, 39.0]
    order = np.argsort(size)
    whole = curve(np.array(size)[order], np.array(psnr)[order], "b")
    pair, plain = difference(whole, curve(*TEST, "a")), difference(curve(*ANCHOR, "b"), curve(*TEST, "a"))
    assert (pair.rate, pair.psnr) == (plain.rate, plain.psnr)
    assert pair.warnings == ("b without 2 points that others of its own beat",)


def test_curves_that_share_no_size_still_have_a_bd_rate():
    """What a method is for that takes a hundredth of the bytes."""
    size, psnr = np.array(ANCHOR[0]), ANCHOR[1]
    pair = difference(curve(size, psnr), curve(size / 100, psnr))
    assert (pair.psnr, pair.bytes_range, pair.refused) == (None, None, "")
    assert pair.warnings == ("no overlap of their size: 1,358 to 9,488 and 14 to 95 B",)
    assert pair.overlap == 1.0


def test_curves_that_share_no_psnr_still_have_a_bd_psnr():
    size, psnr = ANCHOR[0], np.array(ANCHOR[1])
    pair = difference(curve(size, psnr), curve(size, psnr - 20))
    assert (pair.rate, pair.psnr_range, pair.refused) == (None, None, "")
    assert pair.warnings[0].startswith("no overlap of their PSNR")


def test_a_small_overlap_is_warned_of():
    pair = difference(curve(*ANCHOR), curve(np.array(ANCHOR[0]) * 4, np.array(ANCHOR[1]) + 4))
    assert pair.overlap < 0.5
    assert "share only" in pair.warnings[0]


def test_interpolations_that_disagree_are_warned_of():
    size, psnr = [1e3, 5e3, 2e4, 5e4, 5e5], [31.0, 32.0, 40.0, 41.0, 42.0]
    pair = difference(curve(size, psnr), curve([1e3, 1e4, 1e5, 1e6], [30.0, 35.0, 40.0, 45.0]))
    assert any("PCHIP gives" in words for words in pair.warnings)


def test_curves_gather_rates_and_fits_that_differ_in_the_rate_knob(maker):
    for weight, psnr, size in ((None, 36.0, 400), (1e-3, 35.0, 300), (5e-3, 34.0, 200), (1e-2, 33.0, 100)):
        variant = f"rate_weight={weight:g}" if weight else ""
        for scene in "ab":
            maker.run(scene=scene, method="econgs", variant=variant, psnr=psnr, size=size, views=0)
    maker.run(scene="a", method="econgs", variant="rate_weight=1", psnr=1.0, size=50, views=0)  # lacks b
    for rate, psnr, size in ((None, 34.0, 500), (64, 34.0, 500), (4, 32.0, 450)):  # the default's size is 64
        for scene in "ab":
            maker.run(scene=scene, method="ivr-gs", rate=rate, psnr=psnr, size=size, views=0)
    rows = maker.report().curves["vortex"]
    assert [c.title for c in rows] == ["ECoNGS-R", "iVR-GS"]
    assert [(p.rate, p.bytes, p.psnr) for p in rows[0].points] == [
        ("0.01", 100, 33.0), ("0.005", 200, 34.0), ("0.001", 300, 35.0), ("", 400, 36.0)
    ]  # fmt: skip
    assert [(p.rate, p.bytes) for p in rows[1].points] == [("4", 450), ("64", 500)]
    (pair,) = differences({"vortex": rows})
    assert pair.refused == "iVR-GS has 2 points, 4 are needed"


def test_other_options_make_other_curves(maker):
    maker.run(method="econgs", variant="context=false,rate_weight=0.01", views=0)
    maker.run(method="econgs", variant="rate_weight=0.01", views=0)
    report = maker.report()
    rows = report.curves["vortex"]
    assert [c.title for c in rows] == ["ECoNGS-R [context=false]", "ECoNGS-R"]
    assert {c.model for c in rows} < set(report.models)  # they have looks
    assert differences({"vortex": rows}) == []


def test_points_of_a_curve_are_means_over_the_seeds_that_all_have(maker):
    for seed, psnr in ((0, 33.8), (1, 33.0), (2, 33.6)):
        maker.run(method="econgs", seed=seed, psnr=psnr, size=400, views=0)
    maker.run(method="econgs", variant="rate_weight=0.001", seed=0, psnr=33.7, size=300, views=0)
    maker.run(method="econgs", variant="rate_weight=0.01", seed=0, psnr=33.1, size=200, views=0)
    for seed, psnr in ((0, 34.0), (1, 34.2)):
        maker.run(method="3dgs", seed=seed, psnr=psnr, views=0)
    maker.run(method="hac", seed=0, psnr=33.0, size=500, views=0)
    maker.run(method="hac", variant="rate_weight=0.1", seed=1, psnr=32.0, size=400, views=0)
    (rows,) = maker.report().curves.values()
    assert [[round(point.psnr, 3) for point in curve.points] for curve in rows] == [
        [33.1, 33.7, 33.8],
        [34.1],
        [32.0, 33.0],
    ]


# --------------------------------------------------------------------------- intervals


def measured(rng, curves, *, views=48, seeds=1, view_noise=0.4, seed_noise=0.0, size_noise=0.0):
    """Curves with views and seeds: what a view adds is common to all points, in part also to both curves."""
    rows, fits, made = [], [], []
    common = 2 * np.sin(np.arange(views) * 0.7) + rng.normal(0, view_noise, views)
    for name, (sizes, quality) in zip("ab", curves, strict=True):
        own = rng.normal(0, view_noise, views)
        points, shifts = [], rng.normal(0, seed_noise, seeds)
        sizes_of = np.exp(rng.normal(0, size_noise, seeds))
        for i, (size, psnr) in enumerate(zip(sizes, quality, strict=True)):
            jobs = tuple(f"{name}{i}-{seed}" for seed in range(seeds))
            values = psnr + common + own + 0.2 * rng.normal(0, view_noise, (seeds, views)) + shifts[:, None]
            for seed, job in enumerate(jobs):
                fit = {"job": job, "scene": "s", "seed": seed, "psnr": values[seed].mean()}
                fits.append(fit | {"size_bytes": size * sizes_of[seed]})
                for view in range(views):
                    rows.append(
                        {
                            "job": job,
                            "scene": "s",
                            "seed": seed,
                            "view": f"{view:03}",
                            "psnr": values[seed, view],
                        }
                    )
            points.append(Point("", float(np.mean(size * sizes_of)), float(values.mean()), {"jobs": jobs}))
        made.append(Curve("d", Model(name), tuple(points)))
    return made, Views(pd.DataFrame(rows)), pd.DataFrame(fits)


def test_intervals_are_those_of_resampled_views_and_whole_curves():
    curves, views, fits = measured(np.random.default_rng(3), (ANCHOR, TEST))
    pair = difference(*curves, views, fits)
    series = [[views.sample(p.row["jobs"], "psnr").scenes["s"].values for p in c.points] for c in curves]
    rng = np.random.default_rng(0)
    rates, gains = [], []
    for _ in range(400):  # blocks of 8 of 48 views, the same for all points
        drawn = np.concatenate([(start + np.arange(8)) % 48 for start in rng.integers(0, 48, 6)])
        means = [[values[drawn].mean() for values in points] for points in series]
        other = difference(curve(ANCHOR[0], means[0]), curve(TEST[0], means[1]))
        rates.append(np.log(1 + other.rate / 100))
        gains.append(other.psnr)
    factor = scipy.stats.t.ppf(0.975, 5) * np.sqrt(6 / 5)
    width = np.log(1 + np.array(pair.rate_interval) / 100)
    assert width.mean() == pytest.approx(np.log(1 + pair.rate / 100))
    assert np.diff(width)[0] / 2 == pytest.approx(factor * np.std(rates), rel=0.08)
    assert np.diff(pair.psnr_interval)[0] / 2 == pytest.approx(factor * np.std(gains), rel=0.08)
    assert np.mean(pair.psnr_interval) == pytest.approx(pair.psnr)
    assert pair.seeds == 1


def test_intervals_of_three_seeds_hold_the_truth():
    """Seeds differ in PSNR and in bytes; the truth is the curves without noise."""
    truth = difference(curve(*ANCHOR), curve(np.array(ANCHOR[0]) * 0.8, np.array(ANCHOR[1])))
    held = {"rate": 0, "psnr": 0}
    half = (np.array(ANCHOR[0]) * 0.8, ANCHOR[1])
    for trial in range(60):
        rng = np.random.default_rng(trial)
        curves, views, fits = measured(
            rng, (ANCHOR, half), views=12, seeds=3, view_noise=0.02, seed_noise=0.2, size_noise=0.05
        )
        pair = difference(*curves, views, fits)
        assert pair.seeds == 3
        held["rate"] += pair.rate_interval[0] < truth.rate < pair.rate_interval[1]
        held["psnr"] += pair.psnr_interval[0] < truth.psnr < pair.psnr_interval[1]
    assert min(held.values()) >= 53  # 95 % of 60 is 57; below 53 once in 40 such tests at 93 %


def test_the_p_value_of_a_number_is_that_of_its_interval():
    """Zero lies on the end of the interval of the level 1 - p, by Student's t with its degrees of freedom."""
    curves, views, fits = measured(np.random.default_rng(4), (ANCHOR, TEST), seeds=3, seed_noise=0.3)
    pair = difference(*curves, views, fits)
    for middle, ends, p in (
        (pair.psnr, pair.psnr_interval, pair.psnr_p),
        (np.log10(1 + pair.rate / 100), np.log10(1 + np.array(pair.rate_interval) / 100), pair.rate_p),
    ):
        half = (ends[1] - ends[0]) / 2

        def inside(freedom, middle=middle, half=half):
            error = half / scipy.stats.t.ppf(0.975, freedom)
            return 2 * scipy.stats.t.sf(abs(middle) / error, freedom)

        # The freedom lies between that of the seeds alone and that of blocks and seeds together.
        assert min(inside(2), inside(7)) <= p <= max(inside(2), inside(7))
    assert (p > 0.05) == (pair.rate_interval[0] < 0 < pair.rate_interval[1])
    assert difference(*curves, Views(), fits).psnr_p is None


def test_a_seed_narrows_no_interval_and_missing_views_make_none():
    curves, views, fits = measured(np.random.default_rng(1), (ANCHOR, TEST), seeds=3, seed_noise=0.3)
    several = difference(*curves, views, fits)
    first = [
        Curve(
            "d",
            c.model,
            tuple(Point("", p.bytes, p.psnr, {"jobs": p.row["jobs"][:1]}) for p in c.points),
        )
        for c in curves
    ]
    one = difference(*first, views, fits)
    assert np.diff(several.psnr_interval) > np.diff(one.psnr_interval)
    assert difference(*curves, Views(), fits).rate_interval is None
    assert difference(*curves, Views(), fits).rate == several.rate


ALONE = Family()
"""Of a page that has no other lead."""


def conclusion(pairs, family=ALONE):
    return rates.conclusion(pairs, family)


def test_the_conclusion_names_who_significantly_takes_the_fewest_bytes_and_has_the_best_picture():
    def pair(reference, test, rate, ends, psnr=None, around=None, dataset="d"):
        def p(ends):
            return None if ends is None else 0.01 if ends[0] > 0 or ends[1] < 0 else 0.2

        return Difference(
            dataset, reference, test, rate=rate, rate_interval=ends, psnr=psnr, psnr_interval=around,
            rate_p=p(ends), psnr_p=p(around),
        )  # fmt: skip

    leads = [
        pair("b", "a", -50.0, (-60.0, -40.0)),
        pair("c", "a", -80.0, (-85.0, -70.0)),
        pair("c", "b", 5.0, None),
    ]
    bytes_alone = "No two curves can be compared at equal bytes."
    assert conclusion(leads) == (
        "On d, at equal PSNR, a significantly takes the fewest bytes: 5.0 times fewer than c; "
        f"2.0 times fewer than b. {bytes_alone}"
    )
    few = [replace(leads[0], overlap=0.2), replace(leads[1], overlap=0.5), leads[2]]
    assert "5.0 times fewer than c; 2.0 times fewer than b [over 20 % of their range]." in conclusion(few)
    # The reference may be the one that wins.
    assert "b significantly takes the fewest bytes: 1.2 times fewer than a." in conclusion(
        [pair("b", "a", 25.0, (10.0, 40.0))]
    )
    assert conclusion([pair("b", "a", -50.0, (-80.0, 10.0))]).startswith(
        "On d, at equal PSNR, no method significantly"
    )
    # A curve that another one has no PSNR in common with wins nothing at equal PSNR.
    assert "no method significantly takes the fewest bytes" in conclusion(leads[1:])
    assert conclusion([*leads, Difference("e", "a", "b", refused="x")]).endswith(
        f"On e, no two curves can be compared at equal PSNR. {bytes_alone}"
    )
    better = [
        pair("b", "a", None, None, 2.0, (1.0, 3.0)),
        pair("a", "c", None, None, -3.25, (-4.0, -2.5)),
        pair("c", "b", None, None, 0.1, (-1.0, 1.2)),
    ]
    assert conclusion(better) == (
        "On d, no two curves can be compared at equal PSNR. "
        "At equal bytes, a significantly has the highest PSNR: 3.2 dB above c; 2.0 dB above b."
    )
    assert conclusion([*better[1:], pair("b", "a", None, None, 2.0, (-1.0, 5.0))]).endswith(
        "At equal bytes, no method significantly has the highest PSNR."
    )


def test_a_method_wins_against_one_that_a_model_of_it_beats_throughout():
    """Which has no PSNR, or no size, in common with it: all its models are larger and worse."""
    size, psnr = np.array(ANCHOR[0]), np.array(ANCHOR[1])
    best, worse = curve(size, psnr, "best"), curve(size * 1.5, psnr - 6.0, "worse")
    large = curve(size * 100, psnr - 1.0, "large")
    assert [difference(worse, best).beaten, difference(best, worse).beaten] == ["worse", "worse"]
    assert difference(best, curve(size, psnr + 1.0, "x")).beaten == ""
    # Smaller, but not better than the best of the others.
    assert difference(best, curve(size * 100, psnr + 1.0, "x")).beaten == ""

    pairs = [
        replace(difference(best, worse), psnr_interval=(-9.0, -8.0), psnr_p=0.001),
        replace(difference(best, large), rate_interval=(9e3, 2e4), rate_p=0.002),
        difference(worse, large),
    ]
    factor, gain = 1 + pairs[1].rate / 100, -pairs[0].psnr
    dominant = "one model of it is smaller and better than all of"
    assert conclusion(pairs) == (
        f"On d, at equal PSNR, best significantly takes the fewest bytes: {factor:.1f} times fewer than "
        f"large; {dominant} worse. "
        f"At equal bytes, best significantly has the highest PSNR: {gain:.1f} dB above worse; "
        f"{dominant} large."
    )
    assert p_values(pairs) == [0.002, 0.002], "the larger one of those on its rivals"
    assert conclusion(pairs, Family.of([0.002, 0.002, *[0.9] * 30])).count("no method significantly") == 2
    # Where they can be compared, the lead has to be significant.
    assert "no method significantly takes" in conclusion([difference(best, worse), *pairs[1:]])


def test_slopes_between_close_points_leave_what_both_curves_share_alone():
    """One more dB on every point of both curves changes no BD-rate, so the slopes sum to nothing."""
    first = [(90113, 37.6443), (142007, 38.9433), (206215, 39.3079), (286683, 39.3734), (535963, 39.3801),
             (2592958, 39.3949)]  # fmt: skip
    second = [(55518, 37.7022), (60247, 38.5913), (72738, 40.0775), (83643, 40.4721), (90028, 40.6541),
              (106222, 40.8317)]  # fmt: skip
    sizes = [[float(b) for b, _ in one] for one in (first, second)]
    psnr = [[q for _, q in one] for one in (first, second)]

    def number(values):
        return rates._log_bytes(sizes[0], values[0], sizes[1], values[1])

    slopes = intervals._slopes(number, psnr)
    assert sum(part.sum() for part in slopes) == pytest.approx(0.0, abs=1e-3)
    for one, other in zip(slopes, intervals._slopes(number, psnr, 1e-4), strict=True):
        assert one == pytest.approx(other, abs=1e-3)


def test_a_method_whose_curve_is_too_short_is_no_rival_that_was_beaten():
    short = curve([100.0, 200.0, 400.0], [30.0, 35.0, 40.0], "short")
    worse, best = (
        curve([1e3, 2e3, 4e3, 8e3], np.array(ANCHOR[1]) + add, name) for add, name in ((0.0, "w"), (2.0, "b"))
    )
    pairs = [replace(difference(worse, best), rate_p=1e-6, psnr_p=1e-6, seeds=3)]
    assert rates.conclusion(pairs, Family.of(p_values(pairs))).startswith(
        "On d, at equal PSNR, b significantly"
    )
    pairs += [difference(short, best), difference(short, worse)]
    text = rates.conclusion(pairs, Family.of(p_values(pairs)))
    assert text.startswith(
        "On d, at equal PSNR, of the methods that can be compared (not short), b significantly"
    )
    one = [replace(pairs[0], seeds=1)]
    assert "; one seed." in rates.conclusion(one, Family.of(p_values(one)))
