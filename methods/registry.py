"""Which methods there are: those built in, those installed, those in plugin folders.

Looking methods up imports their specs only, never their implementations: no torch.
"""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import entry_points
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Any, Literal, cast, get_args, get_origin, get_type_hints

from econgs_bench import methods
from econgs_bench.datasets.errors import DataError, printable, text_of
from econgs_bench.datasets.names import unknown
from econgs_bench.methods.interface import PRESETS, MethodSpec
from econgs_bench.methods.options import CONFIGURATION, DRAWN, ITERATIONS, SAMPLES, check, declared

if TYPE_CHECKING:
    from econgs_bench.methods.interface import Method

GROUP = "econgs_bench.methods"
COMMAND = "command.toml"
"""File of a plugin that other programs carry out (:mod:`.methods.command`)."""
BUILT_IN = "built in: econgs_bench.methods."
"""How the origins of the methods that come with the harness begin."""
_SPEC = re.compile(rb"^(?:\xef\xbb\xbf)?SPEC\b\s*[:=]", re.MULTILINE)
"""In bytes: a source has the encoding that it declares (PEP 263), and what is no source may have any."""


@dataclass(frozen=True)
class _Candidate:
    """A method before its spec is imported."""

    name: str | None  # of an entry point; None: only its spec has a name
    origin: str
    load: Callable[[], Any]


class Registry:
    """The methods at hand.

    Args:
        plugin_folders: folders given by ``--plugins``. Each is a package with a ``SPEC`` (in
            ``__init__.py`` or ``spec.py``) or holds such packages and modules. They join
            ``sys.path``, behind all that is there. A folder with ``command.toml`` is a method of commands.
        lenient: a plugin folder that cannot be used only lands in ``broken``, too.

    Raises:
        DataError: a plugin folder is missing or empty, a plugin in it cannot be used, or two
            methods share a name. (An installed plugin that cannot be used only lands in
            ``broken``: it must not stop those who do not ask for it.)
    """

    def __init__(self, plugin_folders: Iterable[Path | str] = (), *, lenient: bool = False) -> None:
        self._specs: dict[str, MethodSpec] = {}
        self._origins: dict[str, str] = {}
        self._lost: list[str] = []
        self.broken: dict[str, str] = {}
        """Plugins that cannot be used: entry point name, or plugin folder -> what is wrong."""
        for candidate in _built_in():
            self._add(candidate)
        for candidate in _installed():
            try:
                self._add(candidate)
            except DataError as error:
                self.broken[str(candidate.name)] = str(error)
        for folder in plugin_folders:
            try:
                for candidate in _in_folder(Path(folder)):
                    self._add(candidate)
            except DataError as error:
                if not lenient:
                    raise
                self.broken[str(folder)] = str(error)
                self._lost.append(str(folder))

    def _add(self, candidate: _Candidate) -> None:
        try:
            spec = candidate.load()
        except DataError:
            raise
        except (Exception, SystemExit) as error:
            reason = f"its spec cannot be imported ({type(error).__name__}: {text_of(error)})"
            raise DataError(candidate.origin, reason, _remedy(error, "Repair the plugin")) from error
        check_spec(spec, candidate.origin)
        if candidate.name is not None and candidate.name != spec.name:
            raise DataError(
                candidate.origin,
                f"its entry point is called {candidate.name!r} but its spec {spec.name!r}",
                "Give both the same name",
            )
        if spec.name in self._specs:
            raise DataError(
                candidate.origin,
                f"a method {spec.name!r} is there already ({self._origins[spec.name]})",
                "Rename one of them",
            )
        self._specs[spec.name] = spec
        self._origins[spec.name] = candidate.origin

    def __iter__(self) -> Iterator[MethodSpec]:
        return (self._specs[name] for name in self.names())

    def names(self) -> list[str]:
        """Names of all usable methods, sorted."""
        return sorted(self._specs)

    @property
    def specs(self) -> dict[str, MethodSpec]:
        """Name of a method -> its spec."""
        return dict(self._specs)

    def built_in(self) -> list[str]:
        """Names of the methods that come with the harness, sorted."""
        return [name for name in self.names() if self._origins[name].startswith(BUILT_IN)]

    def spec(self, name: str) -> MethodSpec:
        """The spec of a method.

        Raises:
            UnknownName: no method has that name; near matches are listed.
            DataError: it is installed but cannot be used, or perhaps in a plugin folder that cannot.
        """
        if name in self._specs:
            return self._specs[name]
        if reason := self.broken.get(name) or "; ".join(map(self.broken.__getitem__, self._lost)):
            raise DataError(f"method {name!r}", reason, "The other methods can be used")
        raise unknown("method", name, self._specs, hint="--plugins FOLDER adds methods of your own")

    def origin(self, name: str) -> str:
        """Where a method comes from, for people."""
        self.spec(name)
        return self._origins[name]


def load_method(spec: MethodSpec) -> Method:
    """Import the implementation that a spec names; this is where torch comes in.

    Raises:
        DataError: the module or the attribute is not there.
    """
    module_name, _, attribute = spec.implementation.partition(":")
    try:
        implementation = getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError) as error:
        raise DataError(
            f"method {spec.name!r}",
            f"its implementation {spec.implementation!r} cannot be imported ({text_of(error)})",
            _remedy(error, "Install what it needs, or correct the spec"),
        ) from error
    arguments = spec.files[:1]
    return cast("Method", implementation(*arguments) if isinstance(implementation, type) else implementation)


def _remedy(error: BaseException, otherwise: str) -> str:
    """What mends a failed import: plugins of before import the harness's packages by their bare names."""
    name = (error.name if isinstance(error, ImportError) else None) or ""
    ours = name.partition(".")[0] in ("bench", "methods", "econgs", "datasets", "reports")
    return f"Import econgs_bench.{name} instead of {name}" if ours else otherwise


def check_name(name: str, origin: str) -> None:
    """Refuse what cannot be the name of a method.

    Raises:
        DataError: naming what is wrong with it.
    """
    if not re.fullmatch(r"[a-z0-9][a-z0-9_-]*", name):
        raise DataError(origin, f"method name {name!r}", "Use lower-case letters, digits, - and _")


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value is of a type: a class, a choice of literals, or a container of such."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return value in inner
    if origin is UnionType:
        return any(_fits(value, one) for one in inner)
    if origin is Mapping:
        return isinstance(value, Mapping) and all(
            _fits(name, inner[0]) and _fits(one, inner[1]) for name, one in value.items()
        )
    if origin in (tuple, frozenset):
        like = tuple if origin is tuple else (frozenset, set)
        return isinstance(value, like) and all(_fits(one, inner[0]) for one in value)
    kind = origin or kind
    return isinstance(value, kind) and (kind is bool or not isinstance(value, bool))


@cache
def _fields() -> tuple[tuple[str, Any], ...]:
    """The fields of a spec and their types."""
    return tuple(get_type_hints(MethodSpec).items())


def check_spec(spec: Any, origin: str) -> None:
    """Refuse a spec that contradicts itself.

    Raises:
        DataError: naming what is wrong with it.
    """
    wrong = partial(DataError, origin)
    if not isinstance(spec, MethodSpec):
        raise wrong(
            f"SPEC is a {type(spec).__name__}", "Make it an econgs_bench.methods.interface.MethodSpec"
        )
    for field, kind in _fields():
        value = getattr(spec, field)
        if not _fits(value, kind) or (field == "devices" and not value):
            words = kind.__name__ if isinstance(kind, type) else re.sub(r"[\w.]+\.", "", str(kind))
            raise wrong(f"{field} is {printable(repr(value))}", f"Make it {words}")
    check_name(spec.name, origin)
    if not re.fullmatch(r"[\w.]+:\w+", spec.implementation):
        raise wrong(f"implementation {spec.implementation!r}", "Write it as module:attribute")
    missing = [preset for preset in (*PRESETS, *spec.presets) if preset not in spec.iterations]
    if missing:
        raise wrong(f"no iterations of preset {', '.join(missing)}", f"Declare {', '.join(PRESETS)}")
    if min(spec.iterations.values()) < 1:
        raise wrong("a preset without iterations", "Give each preset a number of iterations >= 1")
    try:
        options = declared(spec.options)
    except TypeError as error:
        raise wrong(
            f"options: {error}", "Declare each field with econgs_bench.methods.interface.option"
        ) from error
    if ITERATIONS in options:
        raise wrong(f"an option called {ITERATIONS!r}", "Leave it out: the budget is settable as it is")
    if CONFIGURATION in options:
        raise wrong(f"an option called {CONFIGURATION!r}", "Declare MethodSpec.configurations")
    if SAMPLES in options and spec.point_sampled:
        raise wrong(f"an option called {SAMPLES!r}", "Rename it: rays a pixel are settable as they are")
    if DRAWN in options and spec.drawn_here:
        raise wrong(f"an option called {DRAWN!r}", "Rename it: who draws is settable as it is")
    for name, option in options.items():
        check(spec.name, name, option, option.default)
        if option.search is not None:
            for end in option.search:
                check(spec.name, name, option, end)
            if option.search[0] >= option.search[1]:
                raise wrong(f"option {name}: search {option.search}", "Write it as (lowest, highest)")
    overlays = {f"preset {name}": values for name, values in spec.presets.items()}
    overlays |= {f"configuration {name}": one.options for name, one in spec.configurations.items()}
    for overlay, values in overlays.items():
        for name, value in values.items():
            if name not in options:
                raise unknown("option", name, options, of=f"{overlay} of {spec.name}")
            check(spec.name, name, options[name], value)
    for name, one in spec.configurations.items():
        for preset, iterations in one.iterations.items():
            if preset not in spec.iterations:
                raise unknown("preset", preset, spec.iterations, of=f"configuration {name} of {spec.name}")
            if iterations < 1:
                raise wrong(f"{iterations} iterations in configuration {name}", "Give it at least 1")
    for name in spec.tunable:
        if name not in options:
            raise unknown("tunable option", name, options, of=f"method {spec.name}")
    for knob in spec.rate_knobs:
        if knob.refit and knob.name not in options:
            raise unknown("rate knob", knob.name, options, of=f"method {spec.name}")


def _built_in() -> Iterator[_Candidate]:
    """Packages beside this module with a ``spec.py``: there without any metadata installed."""
    for module in pkgutil.iter_modules(methods.__path__):
        folder = Path(methods.__path__[0], module.name)
        if module.ispkg and (folder / "spec.py").is_file():
            spec = _spec_of(f"{methods.__name__}.{module.name}.spec")
            yield _Candidate(None, f"{BUILT_IN}{module.name}", spec)


def _installed() -> Iterator[_Candidate]:
    """Entry points of other distributions; one installed twice over counts once."""
    seen: set[tuple[str, str]] = set()
    for point in entry_points(group=GROUP):
        if (point.name, point.value) not in seen:
            seen.add((point.name, point.value))
            package = f"{point.dist.name} {point.dist.version}, " if point.dist is not None else ""
            yield _Candidate(point.name, f"installed: {package}{point.value}", point.load)


def _in_folder(folder: Path) -> Iterator[_Candidate]:
    folder = folder.expanduser().resolve()
    if not folder.is_dir():
        raise DataError(folder, "not a folder", "Give --plugins the folder that holds the plugins")
    if commands := [one for one in (folder, *sorted(folder.iterdir())) if (one / COMMAND).is_file()]:
        yield from (_Candidate(None, f"commands: {one / COMMAND}", _command(one)) for one in commands)
        if commands[0] == folder:
            return
    if (folder / "__init__.py").is_file():
        root, candidates = folder.parent, [folder]
    else:
        root, candidates = folder, sorted(folder.iterdir())
    plugins = [(path, module) for path in candidates if (module := _spec_module(path)) is not None]
    if not plugins and not commands:
        remedy = (
            f"A plugin is a module, or a package with spec.py, that defines SPEC; or a folder with {COMMAND}"
        )
        raise DataError(folder, "no method in it", remedy)
    if str(root) not in sys.path:
        sys.path.append(str(root))
    for path, module in plugins:
        top = path.stem
        located = importlib.util.find_spec(top)
        origin = Path(located.origin) if located is not None and located.origin is not None else None
        if origin is None or not origin.resolve().is_relative_to(root):
            raise DataError(
                path,
                f"another module {top!r} comes first ({origin})",
                "Rename the plugin; if it is this one, installed, leave out --plugins or uninstall it",
            )
        yield _Candidate(None, f"plugin folder: {path}", _spec_of(module))


def _command(folder: Path) -> Callable[[], Any]:
    def load() -> Any:
        from econgs_bench.methods.command.file import command_spec

        return command_spec(folder / COMMAND)

    return load


def _spec_module(path: Path) -> str | None:
    """The module that defines SPEC, without running anything; None if ``path`` is no plugin."""
    if path.suffix == ".py" and path.is_file():
        options = [(path, path.stem)]
    else:
        options = [(path / "spec.py", f"{path.name}.spec"), (path / "__init__.py", path.name)]
        if not (path / "__init__.py").is_file():
            return None
    for file, module in options:
        if file.is_file() and _SPEC.search(file.read_bytes()):
            return module
    return None


def _spec_of(module: str) -> Callable[[], Any]:
    return lambda: importlib.import_module(module).SPEC
