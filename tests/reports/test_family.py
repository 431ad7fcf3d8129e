"""One correction for all leads of a page."""

import gc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from statsmodels.stats.multitest import multipletests

from econgs_bench.reports.family import LEVEL, Family, largest

P_VALUES = st.lists(st.floats(0.0, 1.0) | st.sampled_from([0.001, 0.01, 0.02, 0.05]), min_size=1, max_size=40)


@pytest.fixture(scope="module", autouse=True)
def _quick():
    """statsmodels collects garbage in each call, of all that a worker holds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gc, "collect", lambda: 0)
        yield


@given(P_VALUES)
def test_the_correction_is_holms(p_values):
    declared, corrected, *_ = multipletests(p_values, LEVEL, method="holm")
    family = Family.of(p_values)
    assert [family.corrected(p) for p in p_values] == pytest.approx(list(corrected), abs=1e-12)
    near = np.isclose(corrected, LEVEL, atol=1e-12)
    assert all(
        family.significant(p) == is_so
        for p, is_so, at_the_level in zip(p_values, declared, near, strict=True)
        if not at_the_level
    )


@given(P_VALUES, st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_a_smaller_p_value_is_never_corrected_to_a_larger_one(p_values, one, other):
    """Also of p-values that are no lead's: those of its single rivals."""
    family = Family.of(p_values)
    assert family.corrected(min(one, other)) <= family.corrected(max(one, other))


def test_the_reviews_leads_of_34_limits_are_not_significant():
    """Four were reported as leads without a correction."""
    deciding = [0.022, 0.015, 0.025, 0.050]
    family = Family.of([*deciding, *[0.5] * 30])
    assert not any(map(family.significant, deciding))
    assert [Family.of([p]).significant(p) for p in deciding] == [True] * 4
    assert [family.significant(p) for p in (0.0014, 0.0016)] == [True, False], "Holm over 34 asks 0.0015"


def test_a_lead_that_is_not_tested_is_neither_significant_nor_counted():
    family = Family.of([0.03, None, None])
    assert family.p_values == (0.03,)
    assert family.significant(0.03)
    assert not family.significant(None)
    assert (family.corrected(None), family.text(None), family.verdict(None)) == (None, "", "")


def test_a_lead_on_all_rivals_is_as_certain_as_that_on_the_least_certain():
    assert largest([0.01, 0.2, 0.0]) == 0.2
    assert largest([0.01, None]) is None
    assert largest([]) is None


def test_a_p_value_is_printed_with_the_corrected_one():
    assert Family.of([0.02, 0.3]).text(0.02) == "0.020 (0.040)"
    assert Family.of([0.0001]).text(0.0001) == "< 0.001 (< 0.001)"
