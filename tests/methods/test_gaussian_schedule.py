import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from econgs_bench.methods.gaussian_splatting.schedule import Schedule


def events(predicate, iterations):
    return [i for i in range(1, iterations + 1) if predicate(i)]


def test_the_published_schedule_at_the_published_budget():
    schedule = Schedule(30_000)
    assert events(schedule.grows, 30_000) == list(range(600, 15_000, 100))
    assert events(schedule.resets_opacity, 30_000) == [3_000, 6_000, 9_000, 12_000]
    white = Schedule(30_000, early_reset=True)
    assert events(white.resets_opacity, 30_000) == [500, 3_000, 6_000, 9_000, 12_000]
    assert [schedule.degree(i) for i in (1, 999, 1_000, 1_999, 2_000, 3_000, 30_000)] == [0, 0, 1, 1, 2, 3, 3]
    assert not schedule.prunes_large(3_000)
    assert schedule.prunes_large(3_100)
    assert schedule.collects(14_999)
    assert not schedule.collects(15_000)
    assert schedule.decayed(0, 1.6e-4, 1.6e-6) == pytest.approx(1.6e-4)
    assert schedule.decayed(15_000, 1.6e-4, 1.6e-6) == pytest.approx(1.6e-5)
    assert schedule.decayed(30_000, 1.6e-4, 1.6e-6) == pytest.approx(1.6e-6)


def test_rates_decay_over_the_fits_own_budget():
    schedule = Schedule(300)
    rates = [schedule.decayed(i, 1.0, 0.01) for i in (0, 150, 300, 400)]
    assert rates == pytest.approx([1.0, 0.1, 0.01, 0.01])
    linear = [Schedule(300, decay="linear").decayed(i, 1.0, 0.01) for i in (0, 150, 300, 400)]
    assert linear == pytest.approx([1.0, 0.505, 0.01, 0.01])


@settings(deadline=None, max_examples=20)
@given(st.integers(100, 40_000))
def test_growth_happens_at_least_ten_times_in_its_own_half(iterations):
    schedule = Schedule(iterations)
    growth = events(schedule.grows, iterations)
    assert len(growth) >= 10
    assert schedule.growth_interval <= 100
    assert iterations / 80 < growth[0]
    assert growth[-1] < iterations / 2 + 1


@settings(deadline=None, max_examples=20)
@given(st.integers(1, 40_000), st.integers(0, 3))
def test_boundaries_scale_with_the_budget_and_no_budget_is_too_small(iterations, degree):
    schedule = Schedule(iterations, sh_degree=degree)
    degrees = [schedule.degree(i) for i in range(iterations + 1)]
    assert degrees == sorted(degrees)
    assert max(degrees) <= degree
    if iterations >= 30:
        assert degrees[-1] == degree
        assert degrees.index(degree) == pytest.approx(degree * iterations / 30, abs=degree)
    events(schedule.grows, iterations)
    assert not Schedule(iterations, resets=False).resets_opacity(iterations)


def test_large_ones_are_pruned_from_the_same_iteration_without_resets():
    for changed in ({"resets": False}, {"least_interval": 5_000}):
        assert events(Schedule(30_000, **changed).prunes_large, 3_002) == [3_001, 3_002]


def test_resets_have_a_least_interval():
    short = Schedule(1_200, early_reset=True)
    assert events(short.resets_opacity, 1_200) == [20, 120, 240, 360, 480]
    rare = Schedule(1_200, early_reset=True, least_interval=250)
    assert events(rare.resets_opacity, 1_200) == [250, 500]
    assert events(Schedule(30_000, early_reset=True, least_interval=500).resets_opacity, 30_000)[:2] == [
        500,
        3_000,
    ]


@pytest.mark.parametrize(("decay", "middle"), [("linear", 0.55), ("exponential", 0.1**0.5)])
def test_other_rates_fall_from_the_end_of_growth_to_the_end_of_the_budget(decay, middle):
    schedule = Schedule(1_200, decay=decay)
    factors = [schedule.settled(i, 0.1) for i in (1, 600, 900, 1_200)]
    assert factors == pytest.approx([1.0, 1.0, middle, 0.1])
    assert {schedule.settled(i, 1.0) for i in range(1_201)} == {1.0}
