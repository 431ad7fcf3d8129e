"""Procedural stand-ins: as many scenes as the paper's sets, one field at any resolution, physics."""

from __future__ import annotations

import numpy as np
import pytest

from econgs_bench.datasets import procedural
from econgs_bench.datasets.catalogue import entries, list_datasets
from econgs_bench.datasets.procedural.flame import _CHI, JetFlame
from econgs_bench.datasets.procedural.front import IonisationFront
from econgs_bench.datasets.procedural.space import Slice

# The paper's tables of univariate and multivariate datasets: dims, basic scenes.
PAPER = {
    "argon_bubble": ((2560, 1024, 1024), 2, "argon_bubble_like"),
    "supernova": ((864, 864, 864), 4, "supernova_like"),
    "beetle": ((864, 864, 494), 1, "beetle_like"),
    "vortex": ((512, 512, 512), 4, "vortices"),
    "combustion": ((1920, 2880, 480), 41, "jet_flame"),
    "ionization": ((2400, 992, 992), 24, "ionisation_like"),
    "tangaroa": ((600, 360, 240), 8, "ship_wake"),
}


@pytest.mark.parametrize("name", PAPER)
def test_the_papers_sets_and_their_stand_ins(name: str) -> None:
    """Counts of the paper, and the same scenes."""

    def looks(entry: str) -> list[list[dict[str, object]]]:
        scenes = entries.entry(entry)["scenes"]
        return [[{k: v for k, v in b.items() if k != "name"} for b in scene["bumps"]] for scene in scenes]

    infos = {info.name: info for info in list_datasets([])}
    dims, scenes, stand_in = PAPER[name]
    assert (infos[name].dims, len(infos[name].scenes)) == (dims, scenes)
    assert looks(name) == looks(stand_in)
    assert not infos[name].available


def test_univariate_scenes_are_compositions_of_the_multivariate_sets() -> None:
    assert len(entries.entry("jet_flame")["compositions"]["mf"]) == 9
    assert len(entries.entry("ionisation_like")["compositions"]["t"]) == 4


@pytest.mark.parametrize("name", procedural.FIELDS)
def test_entries_say_the_dims_and_variables(name: str) -> None:
    (info,) = [info for info in list_datasets([]) if info.name == name]
    assert info.variables == procedural.FIELDS[name]
    if name in procedural._FAMILIES:
        assert info.dims == procedural._FAMILIES[name].dims(procedural.default_resolution(name))


def test_fractions_of_mass() -> None:
    values = IonisationFront(0)(Slice(np.linspace(-0.5, 0.5, 40), np.linspace(-0.2, 0.2, 20), 0.03))
    np.testing.assert_allclose(values["H"] + values["H+"] + values["H2"], 0.76, atol=1e-12)
    # The rest is He++, which only the source's side has.
    twice = 0.24 - values["He"] - values["He+"]
    assert twice.min() > -1e-12
    assert np.abs(twice[:, -10:]).max() < 1e-12 < 0.1 < twice[:, 0].max()
    assert min(values[name].min() for name in ("H", "H+", "H2", "He", "He+")) >= 0.0


def test_dissipation_is_the_squared_gradient_of_the_mixture() -> None:
    step = 5e-4
    x, y = np.arange(-20, 21) * step, np.arange(-20, 21) * step
    flame = JetFlame(0)
    below, here, above = (flame(Slice(x, y, z)) for z in (-step, 0.0, step))
    mixture = 2.0 * here["MF"] - 1.0
    along_y, along_x = np.gradient(mixture, step)
    along_z = (above["MF"] - below["MF"]) / step
    squared = (along_x**2 + along_y**2 + along_z**2)[1:-1, 1:-1]
    np.testing.assert_allclose(here["CHI"][1:-1, 1:-1] * _CHI, squared, rtol=0.02, atol=0.01 * squared.max())
