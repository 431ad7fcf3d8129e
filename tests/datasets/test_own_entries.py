"""Datasets that users write: by path, from a folder of their own, and with mistakes."""

import os
import re

import numpy as np
import pytest

from econgs_bench.datasets.catalogue import list_datasets, open_dataset
from econgs_bench.datasets.catalogue.entries import OWN_ENVIRONMENT, built_in
from econgs_bench.datasets.errors import DataError

LINE = re.compile(r" \(line \d+\)")
RAYS = "a pixel has 1, 4, 9, 16 ... 1024 samples"
ENTRY = """
[[files]]
path = "ramp.npy"

[[scenes]]
name = "middle"
[[scenes.bumps]]
name = "middle"
range = [0.3, 0.4, 0.6, 0.7]
color = [0.9, 0.6, 0.2]
opacity = 0.5
"""


@pytest.fixture
def folder(tmp_path):
    np.save(tmp_path / "ramp.npy", np.linspace(0, 1, 512, dtype=np.float32).reshape(8, 8, 8))
    (tmp_path / "engine.toml").write_text(ENTRY)
    return tmp_path


def test_an_entry_opens_by_its_path_with_files_beside_it(folder, monkeypatch):
    dataset = open_dataset(str(folder / "engine.toml"))
    assert (dataset.name, dataset.title) == ("engine", "scenes of engine.toml")
    (scene,) = dataset.scenes
    assert scene.transfer.classify(np.array([0.5]))[0, :3] == pytest.approx([0.9, 0.6, 0.2])
    assert dataset.volume("value").dims == (8, 8, 8)
    monkeypatch.chdir(folder)
    assert open_dataset("engine.toml").volume("value").dims == (8, 8, 8)


def test_a_folder_of_entries_is_part_of_the_catalogue(folder, monkeypatch):
    (folder / "fuel.toml").write_text(ENTRY)
    monkeypatch.setenv(OWN_ENVIRONMENT, os.pathsep.join([str(folder), "nowhere"]))
    names = [info.name for info in list_datasets()]
    assert names[: len(built_in())] == list(built_in())
    assert names[len(built_in()) :] == ["engine", "fuel-own"], "no entry takes a name of the catalogue"
    assert open_dataset("engine").volume("value").dims == (8, 8, 8)
    assert open_dataset("fuel-own").scenes[0].name == "middle"
    assert all(info.available for info in list_datasets() if info.name in ("engine", "fuel-own"))


def test_a_broken_entry_breaks_nothing_else(folder, monkeypatch):
    (folder / "bad.toml").write_text(ENTRY.replace("opacity", "opaque"))
    monkeypatch.setenv(OWN_ENVIRONMENT, str(folder))
    bad, engine = (info for info in list_datasets() if info.name not in built_in())
    assert (bad.kind, bad.available) == ("broken", False)
    line = (folder / "bad.toml").read_text().splitlines().index("opaque = 0.5") + 1
    assert f"{folder / 'bad.toml'}: scenes[0].bumps[0].opaque (line {line}): unknown key" in bad.where
    assert engine.available
    assert open_dataset("vortices").name == "vortices"
    with pytest.raises(DataError, match=r"bad\.toml"):
        open_dataset("bad")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (("opacity = 0.5", "opacity = 1.5"), "scenes[0].bumps[0].opacity: Input should be less than 1"),
        (("[0.3, 0.4, 0.6, 0.7]", "[0.3, 0.4, 0.2, 0.7]"), "does not ascend"),
        (("[0.3, 0.4, 0.6, 0.7]", "[0.3, 0.4]"), "scenes[0].bumps[0].range"),
        (("[0.9, 0.6, 0.2]", "'orange'"), "scenes[0].bumps[0].color"),
        (("[0.9, 0.6, 0.2]", "'#33f66'"), "'#33f66' is no color. Write a color as"),
        (("[0.9, 0.6, 0.2]", "[51, 102, 255]"), "whose channels go from 0 to 1. Write a color as"),
        (("[0.9, 0.6, 0.2]", "[0.1, 0.2]"), "[0.1, 0.2] is no color"),
        (("[0.9, 0.6, 0.2]", "[nan, 0.2, 0.3]"), "is no color, whose channels"),
        (('name = "middle"\n[[', 'name = "middle"\nbackground = "white"\n[['), "'white' is no color"),
        (("opacity", "opacty"), "scenes[0].bumps[0].opacty: unknown key, perhaps opacity (and 1 more)"),
        (('path = "ramp.npy"', ""), "files[0].path: Field required"),
        (('name = "middle"\n[[scenes.bumps', '[[scenes.bumps'), "scenes[0].name: Field required"),
        (('name = "middle"\n[[scenes.bumps', 'name = "a/b"\n[[scenes.bumps'), "scenes[0].name"),
        (('[[scenes]]\n', '[[scenes]]\nvariable = "T"\n'), "variable T, which no file has"),
        (('[[files]]', 'compositions = { both = ["middle", "other"] }\n[[files]]'), "names the scene other"),
        (('[[files]]', 'spacing = [1.0, 0.0, 1.0]\n[[files]]'), "spacing[1]: Input should be greater than 0"),
        (("[[scenes.bumps]]", "[[scenes.bump]]"), "scenes[0].bump: unknown key, perhaps bumps"),
        (('"ramp.npy"', '"ramp.npy"\nurl = "http://h/ramp.npy"'), "files[0]: a url needs the sha512"),
        (('"ramp.npy"', f'"../r.npy"\nurl = "https://h/r"\nsha512 = "{"0" * 128}"'), "leaves the folder"),
        (('"ramp.npy"', '"ramp.npy"\nurl = "file:///etc/passwd"'), "files[0].url"),
        *(
            (("[[files]]", f"samples = {value}\n[[files]]"), f"samples: {RAYS}, not {shown}. Take")
            for value, shown in (("0", "0"), ("-1", "-1"), ("3", "3"), ("1.5", "1.5"), ("4000000", "4000000"),
                                 ("'many'", "'many'"), ("true", "True"), ("[4]", "[4]"), ("nan", "nan"))
        ),
        (("[[files]]", "[[files"), "is no TOML file"),
        (('[[files]]\npath = "ramp.npy"', ""), "files is missing"),
        (("[[files]]", 'field = "shells"\n[[files]]'), 'are of kind = "procedural"'),
        (("[[files]]", 'kind = "procedural"\nfield = "shells"\n[[files]]'), "files is of volume files"),
        (('[[files]]\npath = "ramp.npy"', 'kind = "procedural"'), "field None is no set of formulas"),
        (('[[files]]\npath = "ramp.npy"', 'kind = "procedural"\nfield = "shells"'),
         "variable value, which the formula lacks"),
        (('[[files]]\npath = "ramp.npy"', 'kind = "procedural"\nfield = "shells"\nresolution = 7'),
         "resolution: Input should be greater than or equal to 8"),
    ],
)  # fmt: skip
def test_a_mistake_is_named_with_its_file_and_key(folder, change, reason):
    path = folder / "engine.toml"
    path.write_text(ENTRY.replace(*change))
    with pytest.raises(DataError) as error:
        open_dataset(str(path))
    assert str(error.value).startswith(f"{path}: ")
    assert reason in LINE.sub("", str(error.value))


def test_an_entry_of_a_formula_needs_no_file(folder, monkeypatch):
    head = 'kind = "procedural"\nfield = "shells"\nresolution = 16'
    text = ENTRY.replace('[[files]]\npath = "ramp.npy"', head).replace(
        "[[scenes.b", 'variable = "shells"\n[[scenes.b'
    )
    (folder / "mine.toml").write_text(text)
    dataset = open_dataset(str(folder / "mine.toml"))
    assert (dataset.name, dataset.frame) == ("mine", None)
    own, shipped = dataset.volume("shells"), open_dataset("shells@16").volume("shells")
    assert own.source == shipped.source
    np.testing.assert_array_equal(own.values, shipped.values)
    monkeypatch.setenv(OWN_ENVIRONMENT, str(folder))
    assert open_dataset("mine").name == "mine"
    other = open_dataset("mine@24")
    assert (other.name, other.volume("shells").dims) == ("mine@24", (24, 24, 24))
    (info,) = (one for one in list_datasets() if one.name == "mine")
    assert (info.kind, info.available, info.variables) == ("procedural", True, ("shells",))


@pytest.mark.parametrize("text", ["#3366ff", "#36f", "#36F", "#3366FF"])
def test_a_color_may_be_written_as_on_the_web(folder, text):
    path = folder / "engine.toml"
    surface = f'[[scenes]]\nname = "s"\nbackground = "{text}"\n'
    surface += f'[[scenes.isosurfaces]]\nname = "s"\nvalue = 0.5\ncolor = "{text}"\n'
    path.write_text(ENTRY.replace("[0.9, 0.6, 0.2]", f'"{text}"') + surface)
    first, second = open_dataset(str(path)).scenes
    color = (0.2, 0.4, 1.0)
    assert first.transfer.bumps[0].color == second.background == second.isosurfaces[0].color == color


@pytest.mark.parametrize(("value", "samples"), [("'auto'", 0), ("1", 1), ("16", 16), ("'16'", 16)])
def test_an_entry_states_the_rays_of_a_pixel(folder, value, samples):
    path = folder / "engine.toml"
    path.write_text(f"samples = {value}\n{ENTRY}")
    assert open_dataset(str(path)).samples == samples
    path.write_text(ENTRY)
    assert open_dataset(str(path)).samples == 0


def test_a_missing_entry_or_volume_is_named(folder):
    with pytest.raises(DataError, match=r"nothing\.toml: cannot be read"):
        open_dataset(str(folder / "nothing.toml"))
    (folder / "ramp.npy").unlink()
    with pytest.raises(DataError, match=r"ramp\.npy was not found"):
        open_dataset(str(folder / "engine.toml"))


def test_a_volume_file_never_takes_a_name_of_the_catalogue(folder):
    (folder / "ramp.npy").rename(folder / "fuel.npy")
    assert open_dataset(str(folder / "fuel.npy")).name == "fuel-own"
