"""Adam over named groups whose rows come and go (densification) and whose state is plain tensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch.optim.adam import adam

from econgs_bench.econgs.splat.rasterise import choose_backend, native


class Adam:
    """Adam (Kingma and Ba 2015) with one learning rate per named group of parameters.

    A group is one tensor (``optimizer["means"]`` is the current one: densification replaces it) or several
    that share a rate (the weights of a decoder). The optimiser owns them as leaves that require gradients.
    A tensor without a gradient keeps its value and its step count, as in ``torch.optim.Adam``.

    Args:
        groups: name → tensor or tensors.
        learning_rates: name → learning rate; a schedule changes the entries of :attr:`learning_rates`.
        betas, eps: decay of both moments and guard of the division (3DGS uses 1e-15).
    """

    def __init__(
        self,
        groups: Mapping[str, Tensor | Sequence[Tensor]],
        learning_rates: Mapping[str, float],
        *,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
    ) -> None:
        if set(groups) != set(learning_rates):
            named = f"groups {sorted(groups)} and learning rates {sorted(learning_rates)}"
            raise ValueError(f"{named} name different things")
        self.betas = betas
        self.eps = eps
        self.learning_rates = dict(learning_rates)
        self.parameters: dict[str, list[Tensor]] = {}
        self.first: dict[str, list[Tensor]] = {}
        self.second: dict[str, list[Tensor]] = {}
        self.steps: dict[str, list[int]] = {}
        for name, group in groups.items():
            tensors = [group] if isinstance(group, Tensor) else list(group)
            # A leaf stays the same object, which a module may hold; any other tensor becomes a leaf.
            leaves = [one.requires_grad_(True) if one.is_leaf else _leaf(one) for one in tensors]
            self.parameters[name] = leaves
            self.first[name] = [torch.zeros_like(one) for one in leaves]
            self.second[name] = [torch.zeros_like(one) for one in leaves]
            self.steps[name] = [0] * len(leaves)

    def __getitem__(self, name: str) -> Tensor:
        """The only tensor of a group."""
        (tensor,) = self.parameters[name]
        return tensor

    def zero_grad(self) -> None:
        for group in self.parameters.values():
            for tensor in group:
                tensor.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """One update of all tensors with gradients."""
        # One call for all tensors at the same step: fused, they cost one pass over memory.
        together: dict[tuple[int, str], list[tuple[Tensor, Tensor, Tensor, Tensor, float]]] = {}
        for name, group in self.parameters.items():
            for place, tensor in enumerate(group):
                if tensor.grad is None or tensor.numel() == 0:
                    continue
                self.steps[name][place] += 1
                key = self.steps[name][place], choose_backend(tensor)
                state = self.first[name][place], self.second[name][place]
                together.setdefault(key, []).append((tensor, tensor.grad, *state, self.learning_rates[name]))
        for (step, backend), entries in together.items():
            if backend == "native":
                _native_step(entries, step, self.betas, self.eps)
            else:
                _torch_step(entries, step, self.betas, self.eps)

    @torch.no_grad()
    def keep(self, rows: Tensor, names: Sequence[str]) -> None:
        """Keep only these rows (boolean mask or indices) of the named groups, moments included."""
        for name in names:
            self._replace(name, self[name][rows], self.first[name][0][rows], self.second[name][0][rows])

    @torch.no_grad()
    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Append new rows to the named groups; their moments start at zero."""
        for name, new in rows.items():
            new = new.detach().to(self[name])
            moments = [
                torch.cat([old, torch.zeros_like(new)]) for old in (self.first[name][0], self.second[name][0])
            ]
            self._replace(name, torch.cat([self[name], new]), *moments)

    @torch.no_grad()
    def overwrite(self, name: str, values: Tensor) -> None:
        """Set a group's values and clear its moments (the opacity reset of 3DGS)."""
        zeros = torch.zeros_like(values)
        self._replace(name, values.detach().clone(), zeros, zeros.clone())

    @torch.no_grad()
    def write(self, name: str, rows: Tensor, values: Tensor) -> None:
        """Set some rows (indices, each once) of a group's values; moments stay."""
        self[name][rows] = values

    @torch.no_grad()
    def forget(self, rows: Tensor, names: Sequence[str]) -> None:
        """Clear the moments of some rows (indices) of the named groups."""
        for name in names:
            self.first[name][0][rows] = 0.0
            self.second[name][0][rows] = 0.0

    @torch.no_grad()
    def restart(self, name: str) -> None:
        """Clear the moments of a group and count its steps anew."""
        for moment in (*self.first[name], *self.second[name]):
            moment.zero_()
        self.steps[name] = [0] * len(self.steps[name])

    def state(self) -> dict[str, Tensor]:
        """Parameters, moments and step counts as plain tensors ``group/place/part``, for a checkpoint."""
        saved = {}
        for name, group in self.parameters.items():
            for place, tensor in enumerate(group):
                at = f"{name}/{place}"
                saved[f"{at}/value"] = tensor.detach()
                saved[f"{at}/first"] = self.first[name][place]
                saved[f"{at}/second"] = self.second[name][place]
                saved[f"{at}/step"] = torch.tensor(self.steps[name][place])
        return saved

    @torch.no_grad()
    def load_state(self, saved: Mapping[str, Tensor]) -> None:
        """Continue from :meth:`state`; numbers of rows may differ.

        Raises:
            ValueError: the state lacks a group of this optimiser.
        """
        for name, group in self.parameters.items():
            for place, tensor in enumerate(group):
                try:
                    value, first, second, step = (
                        saved[f"{name}/{place}/{part}"] for part in ("value", "first", "second", "step")
                    )
                except KeyError as missing:
                    raise ValueError(f"the saved optimiser state lacks {missing}") from missing
                self.steps[name][place] = int(step)
                self.first[name][place] = first.to(tensor).clone()
                self.second[name][place] = second.to(tensor).clone()
                if value.shape == tensor.shape:
                    tensor.copy_(value)  # in place: a module may hold it
                else:
                    group[place] = _leaf(value.to(tensor))

    def _replace(self, name: str, value: Tensor, first: Tensor, second: Tensor) -> None:
        self.parameters[name] = [_leaf(value)]
        self.first[name], self.second[name] = [first], [second]


def _leaf(tensor: Tensor) -> Tensor:
    return tensor.detach().clone().contiguous().requires_grad_(True)


Entries = list[tuple[Tensor, Tensor, Tensor, Tensor, float]]  # value, gradient, first and second moment, rate


def _native_step(entries: Entries, step: int, betas: tuple[float, float], eps: float) -> None:
    values, gradients, first, second, rates = (list(column) for column in zip(*entries, strict=True))
    native().adam_step(values, gradients, first, second, rates, *betas, eps, step)


def _torch_step(entries: Entries, step: int, betas: tuple[float, float], eps: float) -> None:
    by_rate: dict[float, Entries] = {}
    for entry in entries:
        by_rate.setdefault(entry[-1], []).append(entry)
    for rate, equal in by_rate.items():
        values, gradients, first, second, _ = (list(column) for column in zip(*equal, strict=True))
        device = values[0].device
        # Filled on the device: a number that comes from the host would be waited for.
        steps = torch.full((len(values),), float(step - 1), device=device).unbind()
        adam(
            values,
            gradients,
            first,
            second,
            [],
            list(steps),
            fused=device.type in ("cpu", "cuda"),
            amsgrad=False,
            beta1=betas[0],
            beta2=betas[1],
            lr=rate,
            weight_decay=0.0,
            eps=eps,
            maximize=False,
        )
