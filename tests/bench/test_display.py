"""The line of a running job."""

import pytest

from bench.display import status_line

STATE = {
    "stage": "growth under noise", "iteration": 549, "iterations": 1600, "left": 125.0, "psnr": 25.452,
    "primitives": 10272, "loss": 0.0356, "parts": {"image": 0.031, "alpha": 0.0045, "color": 1.5e-5},
}  # fmt: skip
TITLE = "10/13 fit econgs on vortices, cores + sheaths, seed 0"


@pytest.mark.parametrize("width", [40, 68, 80, 120, 200])
def test_it_fits_and_losses_yield_first(width):
    line = status_line(TITLE, STATE, width)
    assert len(line) <= width
    assert "34 %, 2:05 min left, 25.45 dB" in line
    words = ["growth under noise", "10272 primitives", "loss 0.0356", "image 0.031", "alpha 0.0045"]
    present = [word in line for word in words]
    assert present == sorted(present, reverse=True)
    assert all(present) == (width == 200)


def test_what_is_not_known_is_not_there():
    assert status_line("1/2 views", {"stage": "rendering"}, 80) == "1/2 views, rendering"
    assert status_line("1/2 views", {}, 80) == "1/2 views"
