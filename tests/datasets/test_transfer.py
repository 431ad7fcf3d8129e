"""Classification against numpy's own interpolation, and the limits of bumps."""

from __future__ import annotations

import numpy as np
import pytest

from econgs_bench.datasets.transfer import Bump, TransferFunction

RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
X = np.linspace(0.0, 1.0, 4001)


def test_a_bump_is_a_trapezoid() -> None:
    transfer = TransferFunction("t", (Bump("b", 0.2, 0.3, 0.5, 0.9, RED, 0.4),), 0.02)
    opacity = 1.0 - np.exp(-transfer.classify(X)[:, 3] * 0.02)
    expected = np.interp(X, [0.2, 0.3, 0.5, 0.9], [0.0, 0.4, 0.4, 0.0])
    np.testing.assert_allclose(opacity, expected, atol=1e-12)


def test_opacity_over_the_reference_length_does_not_depend_on_steps() -> None:
    transfer = TransferFunction("t", (Bump("b", 0.0, 0.0, 1.0, 1.0, RED, 0.4),), 0.02)
    extinction = transfer.classify(np.array([0.5]))[0, 3]
    for steps in (1, 7, 100):
        assert 1.0 - np.prod(np.full(steps, np.exp(-extinction * 0.02 / steps))) == pytest.approx(0.4)


def test_colors_are_opacity_weighted_and_continue_where_nothing_is_seen() -> None:
    bumps = (Bump("r", 0.2, 0.3, 0.4, 0.6, RED, 0.2), Bump("b", 0.4, 0.6, 0.7, 0.8, BLUE, 0.6))
    transfer = TransferFunction("t", bumps)
    at = transfer.classify(np.array([0.5, 0.0, 1.0]))
    weights = np.array([0.1, 0.3])
    np.testing.assert_allclose(at[0, :3], (weights[0] * np.array(RED) + weights[1] * np.array(BLUE)) / 0.4)
    np.testing.assert_allclose(at[1], [*RED, 0.0])
    np.testing.assert_allclose(at[2], [*BLUE, 0.0])


def test_steps_and_ends() -> None:
    transfer = TransferFunction("t", (Bump("b", 0.5, 0.5, 1.0, 1.0, RED, 0.5),))
    opaque = transfer.classify(np.array([0.0, 0.499, 0.5, 1.0]))[:, 3] > 0
    assert opaque.tolist() == [False, False, True, True]


def test_opacity_stays_below_one() -> None:
    bumps = tuple(Bump(n, 0.0, 0.0, 1.0, 1.0, RED, 0.9) for n in "ab")
    assert np.isfinite(TransferFunction("t", bumps).classify(X)).all()


def test_table_samples_the_exact_function() -> None:
    transfer = TransferFunction("t", (Bump("b", 0.2, 0.3, 0.5, 0.9, RED, 0.4),))
    table = transfer.table(1001)
    assert table.dtype == np.float32
    np.testing.assert_allclose(table, transfer.classify(np.arange(1001) / 1000), rtol=1e-6)
