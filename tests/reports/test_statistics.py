import numpy as np
import pandas as pd
import pytest
from scipy import stats

from econgs_bench.reports.statistics import Views, _weights, block_length, interval
from econgs_bench.reports.style import ends, signed
from econgs_bench.reports.tables.documents import to_latex, to_markdown
from econgs_bench.reports.tables.ranks import UNDECIDED_NOTE, ranks
from econgs_bench.reports.tables.table import UNDECIDED, tex


def autoregressive(rng, count, n, rho):
    """(count, n) stationary AR(1) series of mean 0 and variance 1."""
    x = rng.normal(size=(count, n))
    for i in range(1, n):
        x[:, i] = rho * x[:, i - 1] + np.sqrt(1 - rho**2) * x[:, i]
    return x


def test_blocks_of_one_view_are_the_ordinary_bootstrap():
    values = np.random.default_rng(1).gamma(2.0, size=60)
    ours = _weights(60, 1, 20_000) @ values
    theirs = stats.bootstrap((values,), np.mean, n_resamples=20_000, method="percentile", rng=2)
    assert ours.std() == pytest.approx(theirs.standard_error, rel=0.03)
    assert np.quantile(ours, [0.025, 0.975]) == pytest.approx(theirs.confidence_interval, rel=0.01)


@pytest.mark.parametrize("length", [1, 5, 13])
def test_the_error_of_the_mean_is_that_of_circular_blocks(length):
    """Of whole blocks it is known: the variance of all circular block means, over the number drawn."""
    values = autoregressive(np.random.default_rng(3), 1, 65, 0.8)[0]
    blocks = [np.mean(np.roll(values, -start)[:length]) for start in range(65)]
    expected = np.std(blocks) * np.sqrt(length / 65)
    assert (_weights(65, length, 50_000) @ values).std() == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(("rho", "least", "most"), [(0.0, 0.93, 0.99), (0.5, 0.92, 0.98), (0.8, 0.88, 0.97)])
def test_the_interval_covers_the_truth_though_neighbours_are_alike(rho, least, most):
    covered = [
        inside.low <= 0 <= inside.high
        for x in autoregressive(np.random.default_rng(7), 800, 91, rho)
        if (inside := interval([x]))
    ]
    assert least <= np.mean(covered) <= most


def test_views_taken_for_independent_would_deceive():
    """What the blocks are for: at this correlation they raise coverage from a half to nine tenths."""
    series = autoregressive(np.random.default_rng(7), 400, 91, 0.8)
    alone = np.mean([abs(interval([x], 1).mean) <= interval([x], 1).high - x.mean() for x in series])
    assert alone < 0.6


def test_blocks_are_a_sixth_of_the_path():
    assert [block_length(n) for n in (4, 16, 91, 181)] == [1, 3, 16, 31]


def test_the_half_width_is_students_t_of_independent_block_means():
    """Of as many blocks as make up the path: t with one degree less, and their unbiased variance."""
    values = np.random.default_rng(5).normal(size=24)
    blocks = [np.mean(np.roll(values, -start)[:4]) for start in range(24)]
    expected = stats.t.ppf(0.975, 6 - 1) * np.sqrt(np.var(blocks) / 6 * 6 / (6 - 1))
    result = interval([values])
    assert result.high - result.mean == pytest.approx(expected, rel=0.03)
    assert result.mean - result.low == pytest.approx(result.high - result.mean)


def test_equal_values_have_an_interval_of_almost_no_width():
    for count in range(8, 60):
        for value in (34.0, 33.98, 0.1):
            one = interval([np.full(count, value)])
            low, high = one.low, one.high
            assert low == pytest.approx(value, abs=1e-12)
            assert high == pytest.approx(value, abs=1e-12)


def test_too_few_views_have_no_interval():
    result = interval([np.array([1.0, 2.0, 3.0])])
    assert (result.mean, result.low, result.high, result.views) == (2.0, None, None, 3)
    assert not result.excludes_zero


def test_several_paths_weigh_the_same():
    rng = np.random.default_rng(2)
    a, b = rng.normal(0, 1, 40), rng.normal(10, 1, 80)
    both = interval([a, b], 1)
    assert both.mean == pytest.approx((a.mean() + b.mean()) / 2)
    expected = np.sqrt(stats.sem(a) ** 2 + stats.sem(b) ** 2) / 2
    assert (both.high - both.low) / 2 == pytest.approx(expected * stats.t.ppf(0.975, 39), rel=0.05)


def table(**jobs):
    """A views table: job -> (scene, seed, psnr per view)."""
    rows = [
        {"job": job, "scene": scene, "seed": seed, "view": f"{i:03d}", "psnr": value}
        for job, (scene, seed, values) in jobs.items()
        for i, value in enumerate(values)
    ]
    return pd.DataFrame(rows)


def crossed(rng, seeds, views, of_seed, of_view, rest):
    """(seeds, views) values whose mean is 0 in truth: each seed and each view adds a number of its own."""
    parts = of_seed * rng.normal(size=(seeds, 1)), of_view * rng.normal(size=(1, views))
    return sum(parts) + rest * rng.normal(size=(seeds, views))


def of_crossed(values):
    return Views(table(**{f"s{i}": ("x", i, row) for i, row in enumerate(values)})).sample(
        [f"s{i}" for i in range(len(values))], "psnr"
    )


def test_views_and_seeds_together_have_the_error_of_a_mixed_model():
    """Random effects of views and seeds by statsmodels (REML), blocks of one view."""
    import statsmodels.formula.api as smf

    values = crossed(np.random.default_rng(1), 8, 60, 0.3, 1.0, 0.5)
    rows = table(**{f"s{i}": ("x", i, row) for i, row in enumerate(values)}).assign(one=1)
    parts = {"view": "0 + C(view)", "seed": "0 + C(seed)"}
    model = smf.mixedlm("psnr ~ 1", rows, groups="one", re_formula="0", vc_formula=parts).fit()
    ours = interval([values.mean(0)], 1, [values.mean(1)])
    error = (ours.high - ours.mean) / ours_quantile(values)
    assert ours.mean == pytest.approx(model.params["Intercept"])
    assert error == pytest.approx(model.bse["Intercept"], rel=0.05)


def ours_quantile(values):
    """Student's t of a sum of two variances, by scipy."""
    seeds, views = (float(values.mean(axis).var(ddof=1)) / values.shape[1 - axis] for axis in (1, 0))
    freedom = (seeds + views) ** 2 / (seeds**2 / (len(values) - 1) + views**2 / (values.shape[1] - 1))
    return stats.t.ppf(0.975, freedom)


@pytest.mark.parametrize(("seeds", "least"), [(2, 0.88), (3, 0.91), (5, 0.93)])
@pytest.mark.parametrize(("of_seed", "of_view"), [(0.3, 1.0), (0.05, 1.0), (0.5, 0.2)])
def test_the_interval_over_views_and_seeds_covers_the_truth(seeds, least, of_seed, of_view):
    rng = np.random.default_rng(11)
    found = [
        interval([x.mean(0)], None, [x.mean(1)])
        for x in (crossed(rng, seeds, 60, of_seed, of_view, 0.3) for _ in range(600))
    ]
    assert np.mean([one.low <= 0 <= one.high for one in found]) >= least


def test_views_alone_would_deceive_where_seeds_differ():
    rng = np.random.default_rng(11)
    drawn = [crossed(rng, 3, 60, 0.5, 0.2, 0.1) for _ in range(300)]
    assert np.mean([(one := interval([x.mean(0)])).low <= 0 <= one.high for x in drawn]) < 0.5


def test_models_with_the_same_seeds_are_paired_by_seed():
    """What a start is worth is common to both."""
    rng = np.random.default_rng(4)
    hard = crossed(rng, 3, 60, 1.0, 1.0, 0.0)
    better = of_crossed(hard + 0.3 + 0.05 * rng.normal(size=hard.shape))
    difference = better.minus(of_crossed(hard))
    assert (difference.excludes_zero, difference.seeds) == (True, 3)
    fewer = better.minus(of_crossed(hard[:2]))
    assert (fewer.excludes_zero, fewer.seeds) == (False, 2)
    assert of_crossed(hard[:1]).interval() == pytest.approx(interval([hard[0]]))


def test_scenes_seen_along_one_path_are_drawn_together():
    """Two scenes with the same errors are worth no more than one."""
    base = np.random.default_rng(0).normal(30, 1, 40)
    views = Views(table(a=("x", 0, base), b=("y", 0, base)))
    assert views.sample(["a", "b"], "psnr").interval()[:3] == pytest.approx(interval([base])[:3])


def test_pairing_sees_what_single_intervals_hide():
    rng = np.random.default_rng(0)
    hard = rng.normal(30, 3, 60)  # how hard a view is, is common to both
    views = Views(table(a=("x", 0, hard + 0.3 + rng.normal(0, 0.2, 60)), b=("x", 0, hard)))
    a, b = views.sample(["a"], "psnr"), views.sample(["b"], "psnr")
    assert a.interval().low < b.interval().high
    difference = a.minus(b)
    assert difference.excludes_zero
    assert difference.mean == pytest.approx(0.3, abs=0.1)
    assert b.minus(a).low == pytest.approx(-difference.high)


def test_only_shared_views_are_paired_and_only_equal_scenes_compared():
    views = Views(table(a=("x", 0, [1.0] * 9), b=("x", 0, [0.0] * 6), c=("y", 0, [0.0] * 9)))
    a, b, c = (views.sample([job], "psnr") for job in "abc")
    assert (a.minus(b).mean, a.minus(b).views) == (1.0, 6)
    assert a.minus(c) is None
    assert views.sample(["missing"], "psnr") is None


def test_views_are_paired_by_name_whatever_their_order():
    rows = table(a=("x", 0, np.arange(9.0) + 0.5), b=("x", 0, np.arange(9.0)))
    turned = pd.concat([rows[rows["job"] == "a"], rows[rows["job"] == "b"][::-1]])
    difference = Views(turned).difference(["a"], ["b"], "psnr")
    assert difference[:5] == pytest.approx((0.5, 0.5, 0.5, 9, 1))


def rivals(maker, **noise):
    """Methods on one scene: name -> (psnr, noise of its views)."""
    rng = np.random.default_rng(4)
    for method, (psnr, sigma) in noise.items():
        maker.run(method=method, psnr=psnr, views=0)
        job = maker.rows["results"][-1]["job"]
        for i, value in enumerate(rng.normal(0, 1, 40)):
            view = {"job": job, "scene": "tf0", "seed": 0, "view": f"{i}", "psnr": psnr + sigma * value}
            maker.rows["views"].append(view)


@pytest.mark.parametrize(
    ("methods", "expected"),
    [
        ({"a": (30.0, 0.1), "b": (30.2, 3.0), "c": (25.0, 0.1)}, [UNDECIDED, UNDECIDED, None]),
        ({"a": (33.0, 0.1), "b": (30.2, 3.0), "c": (30.0, 0.1), "d": (24.0, 0.1)},
         [1, UNDECIDED, UNDECIDED, None]),
        ({"a": (33.0, 0.1), "b": (30.2, 0.1), "c": (29.0, 0.1)}, [1, 2, None]),
    ],
)  # fmt: skip
def test_no_ranking_where_the_paired_interval_contains_zero(maker, methods, expected):
    rivals(maker, **methods)
    report = maker.report()
    for table in (report.results, report.means):
        marks = ranks(table, report.views)
        assert [marks.get((i, "psnr")) for i in range(len(methods))] == expected


def test_without_views_means_alone_rank(maker):
    rivals(maker, a=(30.0, 0.1), b=(30.2, 3.0))
    assert [ranks(maker.report().results).get((i, "psnr")) for i in (0, 1)] == [2, 1]


def test_undecided_values_have_a_sign_that_a_note_explains(maker):
    rivals(maker, a=(30.0, 0.1), b=(30.2, 3.0))
    report = maker.report()
    markdown = to_markdown(report.results, report.ranks)
    assert UNDECIDED_NOTE in markdown
    assert "30.20 ≈ |" in markdown
    assert "**30.20**" not in markdown
    latex = to_latex(report.results, report.ranks)
    assert tex(UNDECIDED_NOTE) in latex
    assert r"30.20\rlap{$^{\approx}$}" in latex
    assert UNDECIDED_NOTE not in to_markdown(report.results)


def test_intervals_that_exclude_zero_do_not_read_as_if_they_touched_it():
    assert ends(-0.5634, -0.0041, sign=True) == "\N{MINUS SIGN}0.563 to \N{MINUS SIGN}0.004"
    assert ends(-0.5634, 0.0041, sign=True) == "\N{MINUS SIGN}0.56 to +0.00"
    assert ends(0.5, 1.25) == "0.50 to 1.25"
    assert signed(-0.001) == "+0.00"
    assert signed(-1.5) == "\N{MINUS SIGN}1.50"
    assert ends(None, None) == "\N{EN DASH}"


@pytest.mark.parametrize("seed", range(5))
def test_the_p_value_is_students_t_of_the_means_of_blocks(seed):
    """Of a mean at the end of its 95 % interval it is 0.05; otherwise that of its t."""
    x = np.random.default_rng(seed).normal(size=24)
    found = interval([x])
    assert found.p_value(found.half) == pytest.approx(0.05)
    assert found.freedom == 5, "six blocks"
    error = found.half / stats.t.ppf(0.975, 5)
    assert found.p_value(found.mean) == pytest.approx(2 * stats.t.sf(abs(found.mean) / error, 5))
    assert interval([x[:3]]).p_value(1.0) is None


def test_values_that_never_differ_have_a_p_value_of_zero_or_one():
    same = interval([np.full(12, 0.5)])
    assert (same.half, same.p_value(0.5), same.p_value(0.0)) == (0.0, 0.0, 1.0)
