"""The same with options that matter: its color is right for one of them, its file as long as another."""

from dataclasses import dataclass, replace
from typing import Literal

from fake import Color, Options, Single, _spec

from econgs_bench.methods.interface import Configuration, Diverged, option

RIGHT = 0.3
"""The best shift."""


@dataclass(frozen=True)
class TunedOptions(Options):
    shift: float = option(0.2, "makes the color darker than it should be", minimum=0.0, maximum=1.0)
    length: int = option(4000, "further bytes of the file", minimum=1, maximum=1_000_000)
    mood: Literal["even", "bad"] = option("even", "bad: the fit diverges")


SPEC = replace(
    _spec("fake-tuned", joint=False, implementation="fake_tuned:Tuned"),
    options=TunedOptions,
    iterations={"quick": 60, "standard": 600, "paper": 6000},
    configurations={"fair": Configuration(), "paper": Configuration({"shift": 0.6, "group_budget": 0.5})},
    tunable=("shift", "length"),
)


class Shifted(Color):
    def save(self, folder, rate=None):
        ledger = super().save(folder, rate)
        (folder / "padding.bin").write_bytes(bytes(self.length))
        ledger[""]["padding"] = self.length
        return ledger


class Tuned(Single):
    name = "fake-tuned"

    def fit(self, group, options, *arguments):
        if options.mood == "bad":
            raise Diverged("it is in a bad mood")
        return super().fit(group, options, *arguments)

    def restore(self, checkpoint, options, device):
        colors = super().restore(checkpoint, options, device).colors
        model = Shifted({name: [c + RIGHT - options.shift for c in color] for name, color in colors.items()})
        model.length = options.length
        return model
