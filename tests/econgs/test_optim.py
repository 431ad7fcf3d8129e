"""Adam against torch.optim.Adam, and what densification does to its state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from econgs_bench.econgs.optim import Adam

SHAPES = {"means": (101, 3), "opacities": (101,), "sh": (101, 15, 3), "odd": (7,), "many": (40_001,)}
RATES = {"means": 1.6e-4, "opacities": 0.05, "sh": 1.25e-4, "odd": 0.3, "many": 1e-3}


def draw(dtype: torch.dtype, device: str, seed: int = 0) -> dict[str, torch.Tensor]:
    random = np.random.default_rng(seed)
    return {
        name: torch.from_numpy(random.normal(size=shape).astype(np.float32)).to(device, dtype)
        for name, shape in SHAPES.items()
    }


def gradients(step: int, like: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Of very different magnitudes; some exactly zero, as those of unseen Gaussians and of inactive bands."""
    random = np.random.default_rng(100 + step)
    result = {}
    for name, one in like.items():
        values = random.normal(size=one.shape) * 10.0 ** random.uniform(-8, 2, one.shape)
        values[random.uniform(size=one.shape) < 0.2] = 0
        if name == "sh":
            values[:, 8:] = 0
        result[name] = torch.from_numpy(values.astype(np.float32)).to(one)
    return result


def run(dtype: torch.dtype, device: str, steps: int) -> tuple[Adam, dict[str, torch.Tensor]]:
    """Ours and torch's over the same gradients with a changing rate and a group that sometimes has none."""
    start = draw(dtype, device)
    ours = Adam({name: one.clone() for name, one in start.items()}, RATES)
    exact = {name: one.double().cpu().requires_grad_(True) for name, one in start.items()}
    theirs = torch.optim.Adam(
        [{"params": [one], "lr": RATES[name], "name": name} for name, one in exact.items()], eps=1e-15
    )
    for step in range(steps):
        ours.zero_grad()
        theirs.zero_grad()
        step_gradients = gradients(step, start)
        for name, gradient in step_gradients.items():
            if name == "odd" and step % 3 == 1:
                continue
            ours[name].grad = gradient.clone()
            exact[name].grad = gradient.double().cpu()
        ours.learning_rates["means"] = theirs.param_groups[0]["lr"] = RATES["means"] * 0.9**step
        ours.step()
        theirs.step()
    return ours, {name: one.detach() for name, one in exact.items()}


def test_float32_follows_torch(backend: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ECONGS_BACKEND", backend.name)
    start = draw(torch.float64, "cpu")
    ours, exact = run(torch.float32, backend.device, 25)
    for name in SHAPES:
        moved = ours[name].detach().double().cpu() - start[name]
        expected = exact[name] - start[name]
        # Each step rounds the value (of up to 4) by 1.2e-7 at most, and its own length by a few 1e-7.
        assert (moved - expected).abs().max() < 25 * 1.2e-7 + 1e-6 * expected.abs().max()
        assert moved.abs().max() > 5 * RATES[name] * 0.3
    assert torch.equal(ours["sh"][:, 8:].cpu(), start["sh"][:, 8:].float())


def test_float64_is_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ECONGS_BACKEND", raising=False)
    ours, exact = run(torch.float64, "cpu", 10)
    for name in SHAPES:
        torch.testing.assert_close(ours[name].detach(), exact[name], rtol=0, atol=1e-13)


def test_rows_take_their_moments_along(backend: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ECONGS_BACKEND", backend.name)
    ours, _ = run(torch.float32, backend.device, 5)
    before = {name: one.clone() for name, one in ours.state().items()}
    rows = torch.arange(101, device=backend.device) % 3 == 0
    names = ["means", "opacities", "sh"]
    ours.keep(rows, names)
    ours.append({name: torch.ones((4, *SHAPES[name][1:]), device=backend.device) for name in names})
    for name in names:
        count = int(rows.sum())
        assert ours[name].shape == (count + 4, *SHAPES[name][1:])
        assert ours[name].is_leaf
        assert ours[name].requires_grad
        for part in ("first", "second", "value"):
            now = ours.state()[f"{name}/0/{part}"]
            assert torch.equal(now[:count], before[f"{name}/0/{part}"][rows])
            assert (now[count:] == (1 if part == "value" else 0)).all()
        assert ours.steps[name] == [5]
        ours[name].grad = torch.ones_like(ours[name])
    assert ours.steps["odd"] == [3]
    ours.step()
    # Old rows have their momentum; a new row moves by less than the rate, as bias is corrected for step 6.
    assert torch.isfinite(ours["means"]).all()
    ratio = (0.1 / (1 - 0.9**6)) / (0.001 / (1 - 0.999**6)) ** 0.5
    moved = ours["opacities"].detach()[-4:].cpu()
    torch.testing.assert_close(moved, torch.full((4,), 1 - 0.05 * ratio), rtol=1e-5, atol=0)


def test_overwriting_forgets_the_moments() -> None:
    ours, _ = run(torch.float32, "cpu", 3)
    ours.overwrite("opacities", torch.full((101,), -2.0))
    assert (ours["opacities"] == -2).all()
    assert ours.first["opacities"][0].abs().max() == 0
    assert ours.second["opacities"][0].abs().max() == 0
    assert ours.first["means"][0].abs().max() > 0


def test_a_saved_state_continues_as_if_nothing_had_happened() -> None:
    ours, _ = run(torch.float32, "cpu", 4)
    saved = {name: one.clone() for name, one in ours.state().items()}
    other = Adam({name: one[:3] for name, one in draw(torch.float32, "cpu", 9).items()}, RATES)
    other.load_state(saved)
    for one in (ours, other):
        for name, gradient in gradients(7, {name: ours[name].detach() for name in SHAPES}).items():
            one[name].grad = gradient
        one.learning_rates = dict(RATES)
        one.step()
    for name in SHAPES:
        assert torch.equal(ours[name], other[name])
    with pytest.raises(ValueError, match=r"lacks.*sh/0/second"):
        other.load_state({name: one for name, one in saved.items() if name != "sh/0/second"})


def test_a_group_of_several_tensors_keeps_a_modules_own_parameters() -> None:
    layer = torch.nn.Linear(3, 2)
    optimiser = Adam({"decoder": list(layer.parameters())}, {"decoder": 0.1})
    before = layer.weight.detach().clone()
    layer(torch.ones(1, 3)).sum().backward()
    optimiser.step()
    torch.testing.assert_close(layer.weight.detach(), before - 0.1, rtol=0, atol=1e-6)
    optimiser.load_state({name: one.clone() for name, one in optimiser.state().items()})
    assert optimiser.parameters["decoder"][0] is layer.weight
    optimiser.zero_grad()
    assert layer.weight.grad is None


def test_empty_groups_and_wrong_names() -> None:
    optimiser = Adam({"means": torch.zeros(0, 3)}, {"means": 0.1})
    optimiser["means"].grad = torch.zeros(0, 3)
    optimiser.step()
    with pytest.raises(ValueError, match="name different things"):
        Adam({"means": torch.zeros(1)}, {"scales": 0.1})


def test_rows_are_written_and_forgotten_alone():
    ours, _ = run(torch.float32, "cpu", 3)
    before = {name: one.clone() for name, one in ours.state().items()}
    rows = torch.tensor([5, 2])
    ours.write("means", rows, torch.tensor([[1.0, 2, 3], [4, 5, 6]]))
    ours.forget(rows, ["means"])
    assert ours["means"][rows].tolist() == [[1, 2, 3], [4, 5, 6]]
    others = torch.ones(101, dtype=torch.bool).index_fill_(0, rows, False)
    for part in ("value", "first", "second"):
        name = f"means/0/{part}"
        assert torch.equal(ours.state()[name][others], before[name][others])
        assert part == "value" or not ours.state()[name][rows].any()
    assert torch.equal(ours.state()["sh/0/first"], before["sh/0/first"])


def test_a_group_that_restarts_steps_as_that_of_a_new_optimiser():
    """Several tensors in a group; another group goes on."""
    start = {name: [torch.randn(3, 2), torch.randn(5)] for name in ("a", "b")}
    ours = Adam({name: [one.clone() for one in group] for name, group in start.items()}, {"a": 0.1, "b": 0.1})

    def step(optimiser, names=("a", "b")):
        for name in names:
            for tensor in optimiser.parameters[name]:
                tensor.grad = torch.cos(tensor.detach())
        optimiser.step()

    for _ in range(4):
        step(ours)
    now = {name: [one.detach().clone() for one in group] for name, group in ours.parameters.items()}
    ours.restart("a")
    step(ours)
    new = Adam({"a": now["a"]}, {"a": 0.1})
    step(new, ("a",))
    for one, expected in zip(ours.parameters["a"], new.parameters["a"], strict=True):
        torch.testing.assert_close(one, expected, rtol=0, atol=0)
    assert ours.steps == {"a": [1, 1], "b": [5, 5]}
