"""``econgs/_native.pyi`` specifies the compiled module as it is: names, parameters, types."""

import ast
import re
from pathlib import Path

import econgs_bench.econgs._native as native

STUB = Path(__file__).parents[2] / "econgs/_native.pyi"
ARRAYS = {"float32": "Floats", "float64": "Doubles", "int32": "Ints", "int64": "Longs", "uint8": "Bytes"}


def stub_spelling(signature: str) -> str:
    """The signature that nanobind recorded, with the stub's names of types."""

    def array(match: re.Match[str]) -> str:
        return ("" if "writable=False" in match[0] else "Out") + ARRAYS[match[1]]

    signature = re.sub(r"ndarray\[dtype=(\w+)[^]]*\]", array, signature)
    return ast.unparse(
        ast.parse(re.sub(r"(collections\.abc|econgs_bench\.econgs\._native)\.", "", signature) + ": ...")
    )


def test_stub_and_module_hold_the_same_signatures() -> None:
    body = ast.parse(STUB.read_text(encoding="utf-8")).body
    stub = {node.name: ast.unparse(node) for node in body if isinstance(node, ast.FunctionDef)}
    functions = {name: getattr(native, name) for name in dir(native) if not name.startswith("_")}
    module = {
        name: stub_spelling(function.__nb_signature__[0][0])
        for name, function in functions.items()
        if not isinstance(function, type)
    }
    assert stub == module
    classes = {node.name: node for node in body if isinstance(node, ast.ClassDef)}
    assert set(classes) == {name for name, value in functions.items() if isinstance(value, type)}
    for name, node in classes.items():
        members = {member.name for member in node.body if isinstance(member, ast.FunctionDef)}
        assert members == {member for member in vars(functions[name]) if not member.startswith("_")}
