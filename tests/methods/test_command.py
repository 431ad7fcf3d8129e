"""Methods of commands: what a good program gives, and what a hostile one cannot do."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch

from econgs_bench import methods
from econgs_bench.bench.machine.provenance import source_hash
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.png import write_png
from econgs_bench.methods.command import command_spec, process
from econgs_bench.methods.command.method import CommandMethod, CommandModel, _pictures
from econgs_bench.methods.contract.checks import Recorder, files_of
from econgs_bench.methods.contract.scene import tiny_scene
from econgs_bench.methods.gaussian_splatting.ply import PARTS, properties, read_any, write_ply
from econgs_bench.methods.interface import Budget, Edit, MethodSpec, Refused
from econgs_bench.methods.options import resolve
from econgs_bench.methods.registry import Registry, load_method

HERE = Path(__file__).parent / "commands"
RECIPES = Path(methods.__path__[0]) / "command" / "recipes"
SCENE = tiny_scene("tiny")
CAMERAS = SCENE.train.cameras[:12]

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are watched on Linux")


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch) -> Path:
    """The folder of the program; temporary folders are inside the test's own."""
    before = set(psutil.Process().children(recursive=True))  # other tests may have left some
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    folder = shutil.copytree(HERE, tmp_path / "plugin")
    text = (folder / "command.toml").read_text()
    (folder / "command.toml").write_text(
        text.replace("[environment]", f'[environment]\npython = "{sys.executable}"')
    )
    yield folder
    assert not list((tmp_path / "tmp").iterdir()), "a folder is left"
    assert set(psutil.Process().children(recursive=True)) <= before, "a process is left"


def spec_of(plugin: Path, old: str = "", new: str = "") -> MethodSpec:
    """The spec after a change of the file."""
    text = (plugin / "command.toml").read_text()
    assert old in text
    (plugin / "command.toml").write_text(text.replace(old, new) if old else text)
    return command_spec(plugin / "command.toml")


def fitted(spec: MethodSpec, recorder: Recorder | None = None, **options: str) -> CommandModel:
    method = CommandMethod(spec.files[0])
    chosen = resolve(spec, "quick", options).options
    recorder = recorder or Recorder([12])
    return method.fit([SCENE], chosen, Budget(12), 7, "cpu", recorder)  # type: ignore[return-value]


def test_a_good_program_trains_and_draws(plugin: Path, tmp_path: Path) -> None:
    spec = spec_of(plugin)
    recorder = Recorder([12])
    model = fitted(spec, recorder)
    assert recorder.iterations == [*range(1, 13), 12]  # line feeds and carriage returns end lines
    assert recorder.losses == [0.5] * 12
    assert model.primitives() == 1
    drawn = model.draw_all(CAMERAS, background=(0.0, 0.0, 0.0))
    for index in range(len(CAMERAS)):  # by their numbers, as 2 before 10
        rgb, alpha = drawn[index]
        assert rgb.shape == (32, 32, 3)
        np.testing.assert_allclose(rgb[5, 5] * 255, [index, 128, 192], atol=1e-3)
        assert alpha is not None
        assert (alpha == 1.0).all()
    np.testing.assert_allclose(drawn.frame_seconds, [(10 + index) / 1e3 for index in range(12)])
    assert (drawn.peak_host_bytes or 0) > 2**20
    (tmp_path / "model").mkdir()
    ledger = model.save(tmp_path / "model")
    files = files_of(tmp_path / "model")
    assert sorted(files) == ["files/deep/model.bin", "files/point_cloud.ply", "scene.json"]
    assert sum(ledger["tiny"].values()) == sum(map(len, files.values()))
    restored = CommandMethod(spec.files[0]).restore(recorder.checkpoints[12], None, "cpu")
    (tmp_path / "again").mkdir()
    restored.save(tmp_path / "again")
    assert files_of(tmp_path / "again") == files
    loaded = load_method(spec).load(tmp_path / "model", "cpu")
    assert torch.equal(loaded.render(CAMERAS[3])[0], model.render(CAMERAS[3])[0])
    here = loaded.drawn_here()  # type: ignore[attr-defined]
    rgb, alpha = here.render(CAMERAS[0])
    assert here.primitives() == 1
    assert 0.1 < float(alpha.max()) <= 1.0
    for path in (tmp_path / "model" / "files" / "deep" / "model.bin", tmp_path / "model" / "scene.json"):
        whole = path.read_bytes()
        path.write_bytes(whole[:-1])
        with pytest.raises(DataError, match=r"scene\.json"):
            load_method(spec).load(tmp_path / "model", "cpu")
        path.write_bytes(whole)
    for refused in (
        lambda: model.render(CAMERAS[0], edit={"tiny": Edit(opacity=0.5)}),
        lambda: here.render(CAMERAS[0], edit={"tiny": Edit(opacity=0.5)}),
        lambda: model.save(tmp_path / "model", 1.0),
        lambda: CommandMethod(spec.files[0]).compose([model, model]),
        lambda: CommandMethod(spec.files[0]).fit([SCENE, SCENE], None, Budget(1), 0, "cpu", recorder),
    ):
        with pytest.raises(Refused):
            refused()


def test_numbers_of_primitives_that_are_none_are_passed_over(plugin: Path) -> None:
    program = plugin / "program.py"
    text = program.read_text()
    assert 'loss {loss}"' in text
    program.write_text(text.replace('loss {loss}"', 'loss {loss} of {10**22 if iteration % 2 else -5}"'))
    spec = spec_of(plugin, r"(?P<loss>\S+)'", r"(?P<loss>\S+) of (?P<primitives>\S+)'")
    recorder = Recorder([12])
    fitted(spec, recorder)
    assert recorder.iterations == [12]  # the last, of the harness itself


def test_pictures_may_have_digits_that_are_no_numbers(tmp_path: Path) -> None:
    for name in ("v_10.png", "v_1²1.png", "v_2.png"):
        write_png(tmp_path / name, np.zeros((32, 32, 4), np.float32))
    found = _pictures(tmp_path, "*.png", CAMERAS[:3], "it")
    assert [path.name for path in found] == ["v_1²1.png", "v_2.png", "v_10.png"]


TRAINING = [
    ("fail", DataError, "exit code 1: no such kernel"),
    ("memory", MemoryError, "CUDA out of memory"),
    ("hang", DataError, "ended after 1 s, its timeout"),
    ("bomb", DataError, "its folder holds .* at most"),
    ("nothing", DataError, r"wrote no file \*.ply"),
    ("link", DataError, "deep/secret.bin is a link"),
    ("linked-folder", DataError, "deep.* is a link"),
    ("pipe", DataError, "'deep/pipe.bin' is no file of a model"),
    ("large", DataError, "2 files of 1.0 MiB, at most 10000 of 0.5 MiB"),
    ("ply-nan", DataError, "holds NaN"),
]


@pytest.mark.parametrize(("how", "kind", "words"), TRAINING, ids=[one[0] for one in TRAINING])
def test_training_that_fails_says_why(plugin: Path, how: str, kind: type[Exception], words: str) -> None:
    spec = spec_of(plugin, "timeout = 30", "timeout = 1") if how == "hang" else spec_of(plugin)
    with pytest.raises(kind, match=words):
        fitted(spec, train=how)


DRAWING = [
    ("fail", "exit code 3"),
    ("hang", "ended after 1 s, its timeout"),
    ("half", r"drew 6 pictures of 12 \(\*.png\)"),
    ("more", "drew 13 pictures of 12"),
    ("size", "has 33x32 pixels, not 32x32"),
    ("sixteen", "16 bits a channel"),
    ("text", "cannot be read"),
    ("cut", "cannot be read"),
    ("claim", "60000x60000 pixels, not 32x32|cannot be read"),
    ("link", "is a link"),
]


@pytest.mark.parametrize(("how", "words"), DRAWING, ids=[one[0] for one in DRAWING])
def test_drawing_that_fails_says_why(plugin: Path, how: str, words: str) -> None:
    spec = spec_of(plugin, "timeout = 30", "timeout = 1") if how == "hang" else spec_of(plugin)
    model = fitted(spec, render=how)
    with pytest.raises(DataError, match=words):
        model.draw_all(CAMERAS)


@pytest.mark.parametrize("step", ["train", "render"])
def test_what_leaves_its_session_is_ended(plugin: Path, tmp_path: Path, step: str) -> None:
    note = tmp_path / "pid"
    model = fitted(spec_of(plugin), note=str(note), **{step: "daemon"})
    if step == "render":
        model.draw_all(CAMERAS[:1])
    assert not psutil.pid_exists(int(note.read_text()))


def test_endless_output_is_no_endless_log(plugin: Path, capsys) -> None:
    method = CommandMethod(spec_of(plugin).files[0])
    method.scratch = plugin / "scratch"
    options = resolve(command_spec(plugin / "command.toml"), "quick", {"train": "talk"}).options
    method.fit([SCENE], options, Budget(12), 0, "cpu", Recorder([12]))
    text = capsys.readouterr().out
    assert "the rest of its output is not kept" in text
    assert len(text) < 2**20 + 2**15
    assert not list((plugin / "scratch").iterdir())


def test_pictures_without_alpha_and_frames_without_times(plugin: Path) -> None:
    drawn = fitted(spec_of(plugin), render="opaque").draw_all(CAMERAS)
    assert drawn[0][1] is None
    drawn = fitted(spec_of(plugin), render="silent").draw_all(CAMERAS)
    assert drawn.frame_seconds == ()


def test_a_missing_environment_is_named(plugin: Path) -> None:
    for old, new, words in (
        (f'"{sys.executable}"', '"envs/gone/bin/python"', "interpreter .*envs/gone/bin/python is not there"),
        ('code = "."', 'code = "clone"', "clone is not there"),
        (
            'code = "."',
            'check = ["{python}", "-c", "import no_such_kernel"]',
            "No module named 'no_such_kernel'",
        ),
    ):
        file = plugin / "command.toml"
        text = file.read_text()
        with pytest.raises(DataError, match=words):
            fitted(spec_of(plugin, old, new))
        file.write_text(text)


def test_commands_do_not_see_the_harness(plugin: Path, monkeypatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(plugin))
    check = "import os; assert not os.environ.keys() & {'PYTHONPATH', 'PYTHONSAFEPATH'}; "
    check += "assert os.environ['CUDA_VISIBLE_DEVICES'] == ''"
    spec = spec_of(plugin, 'code = "."', f'check = ["{{python}}", "-c", "{check}"]')
    CommandMethod(spec.files[0]).prepare([SCENE], "cpu")


def test_it_is_found_listed_and_hashed_like_others(plugin: Path, tmp_path: Path) -> None:
    for folder in (plugin, tmp_path):
        registry = Registry([folder])
        assert registry.origin("program") == f"commands: {plugin / 'command.toml'}"
    before = source_hash(registry.spec("program"))
    (plugin / "program.py").write_text("another program")
    assert source_hash(registry.spec("program")) != before
    spec = spec_of(plugin, 'version = "1"', 'version = "2"')
    assert (spec.version, spec.drawn_here, spec.resumable) == ("2", True, False)


BAD = [
    ('version = "1"\n', "", "version"),
    ('files = ["*.ply", "deep/**"]', 'files = ["../*.ply"]', "leads out of the folder"),
    ('files = ["*.ply", "deep/**"]', 'files = ["/etc/*"]', "leads out of the folder"),
    ("timeout = 30", "timeuot = 30", "unknown key, perhaps timeout"),
    ('"{views}", ', "", r"lacks \{views\}"),
    ('"{views}", ', '"{views}", "{test_views}", ', "placeholder {test_views}; known: python"),
    ("(?P<iteration>", "(?P<step>", "other groups"),
    ("(?P<iteration>", "(", "no regular expression|other groups|unbalanced"),
    ('train = { default = "good"', 'lambda = { default = "good"', "option name 'lambda'"),
    ('hash = ["program.py"]', 'hash = ["gone.py"]', "no file gone.py"),
    ('disk = "20M"', 'disk = "much"', "no size"),
    ('name = "program"', 'name = "Pro gram"', "method name"),
]


@pytest.mark.parametrize(("old", "new", "words"), BAD, ids=[one[2] for one in BAD])
def test_a_bad_file_is_refused_by_name(plugin: Path, old: str, new: str, words: str) -> None:
    text = (plugin / "command.toml").read_text()
    assert old in text
    (plugin / "command.toml").write_text(text.replace(old, new))
    with pytest.raises(DataError, match=words) as raised:
        Registry([plugin])
    assert "command.toml" in str(raised.value)
    assert len(str(raised.value).splitlines()) == 1


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gaussians_of_any_degree_are_read(tmp_path: Path, degree: int) -> None:
    count = (degree + 1) ** 2 - 1
    whole = np.random.default_rng(1).random((5, 62), np.float32)
    names = properties(PARTS)
    rest = [f"f_rest_{i}" for i in range(3 * count)]
    parts = {"rest": tuple(name for name in names if name[0] != "n" and not name.startswith("f_rest"))}
    if rest:
        parts["sh"] = tuple(rest)
    source = {f"f_rest_{c * count + k}": f"f_rest_{c * 15 + k}" for c in range(3) for k in range(count)}
    columns = [names.index(source.get(name, name)) for name in properties(parts)]
    write_ply(tmp_path / "a.ply", whole[:, columns], parts)
    rows, found, _ = read_any(tmp_path / "a.ply")
    assert found == degree
    kept = [i for i, name in enumerate(names) if name in (*parts["rest"], *source.values())]
    np.testing.assert_array_equal(rows[:, kept], whole[:, kept])
    assert not np.delete(rows, kept, axis=1).any()


def test_a_blind_scene_is_refused(plugin: Path) -> None:
    spec = spec_of(plugin)
    blind = replace(SCENE, train=replace(SCENE.train, cameras=(), images=SCENE.train.images[:0]))
    options = resolve(spec, "quick").options
    with pytest.raises(Refused):
        CommandMethod(spec.files[0]).fit([blind], options, Budget(1), 0, "cpu", Recorder())


def test_a_package_may_offer_commands(plugin: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    package = tmp_path / "offers_commands"
    package.mkdir()
    (package / "__init__.py").touch()
    lines = ["from econgs_bench.methods.command import command_spec"]
    lines += [f"SPEC = command_spec({str(plugin / 'command.toml')!r})"]
    (package / "spec.py").write_text("\n".join(lines) + "\n")
    spec = Registry([package]).spec("program")
    assert spec.files[0] == plugin / "command.toml"
    assert isinstance(load_method(spec), CommandMethod)


@pytest.mark.parametrize("name", sorted(path.parent.name for path in RECIPES.glob("*/command.toml")))
def test_recipes_are_sound_and_miss_their_environment_by_name(tmp_path: Path, name: str) -> None:
    spec = Registry([RECIPES / name]).spec(command_spec(RECIPES / name / "command.toml").name)
    assert spec.devices == ("cuda",)
    with pytest.raises(DataError, match=r"the folder /path/to/.* is not there"):
        CommandMethod(spec.files[0]).prepare([SCENE], "cuda")


def test_memory_on_the_device_is_that_of_its_processes(tmp_path: Path, monkeypatch) -> None:
    """By a stand-in for ``nvidia-smi`` that lists every process of this machine with 100 MiB."""
    lister = tmp_path / "nvidia-smi"
    lister.write_text('#!/bin/sh\nfor p in /proc/[0-9]*; do echo "${p#/proc/}, 100"; done\n')
    lister.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setattr(process, "_DEVICE_LOOK", 0.2)
    for device, expected in (("cuda:1", 200 * 2**20), ("cpu", None)):
        variables = process.environment(device, {"OWN": "1"})
        assert variables["CUDA_VISIBLE_DEVICES"] == ("1" if device == "cuda:1" else "")
        usage = process.run(
            ["sh", "-c", "sleep 1 & wait"], what="it", cwd=tmp_path, variables=variables, device=device
        )
        assert usage.device_bytes == expected
        assert usage.seconds >= 1.0
