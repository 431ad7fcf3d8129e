import re
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from econgs_bench import methods
from econgs_bench.datasets.errors import DataError, UnknownName
from econgs_bench.methods import registry
from econgs_bench.methods.registry import Registry, load_method

ROOT = Path(methods.__file__).parents[1]

PLUGIN = """
from dataclasses import dataclass
from econgs_bench.methods.interface import MethodSpec, option

@dataclass(frozen=True)
class Options:
    size: int = option(3, "how much", minimum=1)

SPEC = MethodSpec(
    name={name!r}, title="A toy", reference="", version="1",
    implementation="{module}:Toy", uses_alpha="no",
    options=Options, presets={{"paper": {preset}}},
    iterations={{"quick": 1, "standard": 2, "paper": 3}},
)
"""
AGAIN, SO = "from dataclasses import replace\n", "SPEC = replace(SPEC, options=A)\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder for plugins; what they add to the process is taken back."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith("toy_"):
            del sys.modules[name]


def write(folder, module, name="toy", file="spec.py", preset="{}", extra=""):
    package = folder / module
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / file).write_text(PLUGIN.format(name=name, module=f"{module}.method", preset=preset) + extra)
    (package / "method.py").write_text("class Toy:\n    pass\n")
    return package


def python(code):
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, encoding="utf-8", check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_listing_finds_the_built_in_methods_without_torch_or_numpy():
    code = (
        "import sys; sys.path.insert(0, '.');"
        "from econgs_bench.methods.registry import Registry; r = Registry();"
        "print(*r.names()); print([m for m in ('torch', 'numpy', 'scipy') if m in sys.modules])"
    )
    names = python(code)
    assert "3dgs" in names
    assert names[-1] == "[]"


def test_every_built_in_spec_loads_its_implementation():
    known = Registry()
    for name in known.built_in():
        method = load_method(known.spec(name))
        assert all(callable(getattr(method, name)) for name in ("partition", "fit", "load", "compose"))


@pytest.mark.parametrize("spec", Registry().specs.values(), ids=lambda spec: spec.name)
def test_the_source_of_a_built_in_method_is_what_it_imports_of_the_methods(spec):
    """All folders of methods/ that its own folder builds on, and no other."""
    folders, todo = set(), [spec.implementation.split(".")[2]]
    if spec.name in ("sz3", "zfp"):
        todo.append(spec.name)
    while todo:
        folders.add(folder := todo.pop())
        text = "".join(file.read_text("utf-8") for file in (ROOT / "methods" / folder).glob("*.py"))
        found = set(re.findall(r"econgs_bench\.methods\.(\w+)", text)) - {"interface", "shared"}
        todo += found - folders - ({"mesh"} if folder != "mesh" else set())
    own = {one.rpartition(".")[2] for one in spec.source if ".methods." in one} - {"interface", "shared"}
    assert own == folders


@pytest.mark.parametrize("line", ["from methods.interface import option", "import datasets.camera"])
def test_a_plugin_with_the_imports_of_before_learns_todays(folder, line):
    write(folder, "toy_old", extra=f"{line}\n")
    module = line.split()[1]
    with pytest.raises(DataError, match=f"Import econgs_bench.{module.split('.')[0]}"):
        Registry([folder])


def test_unknown_method_lists_near_matches():
    with pytest.raises(UnknownName, match="Did you mean 3dgs"):
        Registry().spec("3dg")


@pytest.mark.parametrize("file", ["spec.py", "__init__.py"])
def test_a_folder_of_plugins(folder, file):
    write(folder, f"toy_in_{file.strip('_').split('.')[0].strip('_')}", file=file)
    (folder / "helper.py").write_text("raise RuntimeError('not a plugin: must not run')\n")
    found = Registry([folder])
    assert "toy" in found.names()
    assert str(folder) in found.origin("toy")
    assert type(load_method(found.spec("toy"))).__name__ == "Toy"


def test_the_plugin_itself_may_be_the_folder(folder):
    package = write(folder, "toy_alone")
    assert "toy" in Registry([package]).names()


def test_a_module_is_a_plugin_too(folder):
    (folder / "toy_module.py").write_text(
        PLUGIN.format(name="toy", module="toy_module", preset="{}") + "class Toy: pass\n"
    )
    assert type(load_method(Registry([folder]).spec("toy"))).__name__ == "Toy"


def test_duplicates_are_refused_naming_both(folder):
    write(folder, "toy_a")
    write(folder, "toy_b")
    with pytest.raises(DataError) as caught:
        Registry([folder])
    assert "toy_a" in str(caught.value)
    assert "toy_b" in str(caught.value)


def test_a_plugin_cannot_replace_a_built_in_method(folder):
    write(folder, "toy_thief", name="3dgs")
    with pytest.raises(DataError, match="built in"):
        Registry([folder])


def test_a_plugin_hidden_by_another_module_is_refused(folder):
    write(folder, "json")
    with pytest.raises(DataError, match="another module 'json' comes first"):
        Registry([folder])


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"preset": "{'sise': 4}"}, "sise"),
        ({"preset": "{'size': 0}"}, "below the minimum"),
        ({"name": "To y"}, "method name"),
        ({"extra": "SPEC = 3\n"}, "SPEC is a int"),
        ({"extra": f"{AGAIN}@dataclass\nclass A:\n    a: int = option(1, '')\n{SO}"}, "no frozen dataclass"),
        ({"extra": f"{AGAIN}@dataclass(frozen=True)\nclass A:\n    a: int = 1\n{SO}"}, "'a' is not declared"),
        (
            {"extra": f"{AGAIN}@dataclass(frozen=True)\nclass A:\n    a: float = option(1, '')\n{SO}"},
            "not of its type",
        ),
        (
            {
                "extra": f"{AGAIN}@dataclass(frozen=True)\nclass A:\n    samples: int = option(1, '')\n"
                "SPEC = replace(SPEC, options=A, point_sampled=True)\n"
            },
            "an option called 'samples'",
        ),
        ({"extra": "import no_such_module_here\n"}, "no_such_module_here"),
        ({"extra": "import sys\nsys.exit(0)\n"}, "SystemExit"),
        *(
            ({"extra": f"{AGAIN}SPEC = replace(SPEC, {field}={value})\n"}, f"{field} is ")
            for field, value in (
                ("name", None),
                ("version", 1),
                ("title", 3),
                ("joint", 2),
                ("point_sampled", "'yes'"),
                ("source", "'toy'"),
                ("devices", "()"),
                ("devices", "'cpu'"),
                ("devices", "('tpu',)"),
                ("edits", "{'color'}"),
                ("iterations", None),
                ("iterations", "{'quick': '1', 'standard': 2, 'paper': 3}"),
                ("presets", 3),
                ("rate_knobs", "(3,)"),
                ("configurations", "{'fair': 1}"),
                ("tunable", "3"),
                ("tunable", "'size'"),
            )
        ),
    ],
)
def test_a_spec_that_is_wrong_says_so(folder, arguments, reason):
    write(folder, "toy_wrong", **arguments)
    with pytest.raises(DataError, match=reason):
        Registry([folder])


def test_who_is_lenient_loses_the_methods_of_a_lost_folder_alone(folder):
    there, lost = folder / "there", folder / "lost"
    there.mkdir()
    write(there, "toy_there")
    found = Registry([lost, there], lenient=True)
    assert found.spec("toy").name == "toy"
    with pytest.raises(DataError, match=f"{lost}: not a folder"):
        found.spec("another")


def test_missing_and_empty_folders(folder):
    with pytest.raises(DataError, match="not a folder"):
        Registry([folder / "nothing"])
    with pytest.raises(DataError, match="no method in it"):
        Registry([folder])


def test_installed_plugins_one_broken(folder, monkeypatch):
    write(folder, "toy_installed", name="toy")
    sys.path.append(str(folder))
    points = [
        EntryPoint("toy", "toy_installed.spec:SPEC", registry.GROUP),
        EntryPoint("toy", "toy_installed.spec:SPEC", registry.GROUP),  # found twice on the path
        EntryPoint("broken", "toy_not_there:SPEC", registry.GROUP),
    ]
    monkeypatch.setattr(registry, "entry_points", lambda group: points)
    found = Registry()
    assert set(found.names()) >= {"3dgs", "toy"}
    assert found.origin("toy").startswith("installed")
    assert set(found.broken) == {"broken"}
    with pytest.raises(DataError, match="toy_not_there"):
        found.spec("broken")


def test_an_implementation_that_is_not_there(folder):
    write(folder, "toy_hollow")
    (folder / "toy_hollow" / "method.py").write_text("")
    with pytest.raises(DataError, match="cannot be imported"):
        load_method(Registry([folder]).spec("toy"))


@pytest.mark.parametrize(
    ("head", "encoding"),
    [
        ("# -*- coding: latin-1 -*-\n# by Ren\xe9\n", "latin-1"),
        ("#!/usr/bin/env python\n# vim: set fileencoding=cp1252 :\n# \u20ac\n", "cp1252"),
        ("# coding: shift_jis\n# \u8868\n", "shift_jis"),
        ("", "utf-8-sig"),
        ("# by Ren\xe9\r\n", "utf-8"),
    ],
)
def test_a_plugin_has_any_encoding_that_python_reads(folder, head: str, encoding: str) -> None:
    spec = write(folder, "toy_coded") / "spec.py"
    spec.write_bytes((head + spec.read_text().strip()).encode(encoding))
    found = Registry([folder])
    assert found.spec("toy").options().size == 3
    assert not found.broken


def test_a_spec_in_the_first_line_may_follow_a_byte_order_mark(folder) -> None:
    (folder / "toy_first.py").write_bytes(b"\xef\xbb\xbfSPEC = __import__('toy_other.spec').spec.SPEC\n")
    write(folder, "toy_other")
    with pytest.raises(DataError, match="toy"):  # the same method twice: both files were found
        Registry([folder])


def test_a_file_that_is_no_source_is_no_plugin(folder) -> None:
    write(folder, "toy_good")
    (folder / "toy_notes.py").write_bytes("caf\xe9\n".encode("latin-1"))
    (folder / "toy_binary.py").write_bytes(bytes(range(256)))
    (folder / "toy_wide.py").write_bytes("notes\n".encode("utf-16"))
    assert "toy" in Registry([folder]).specs


def test_a_plugin_of_another_encoding_than_it_declares_is_named(folder) -> None:
    write(folder, "toy_good")
    (folder / "toy_torn.py").write_bytes("BY = 'Ren\xe9'\nSPEC = None\n".encode("latin-1"))
    with pytest.raises(DataError, match=r"toy_torn\.py.*cannot be imported \(SyntaxError"):
        Registry([folder])
    assert "toy" in Registry([folder], lenient=True).specs
