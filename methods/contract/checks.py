"""The contract kit: checks of a plugin's promises on a tiny scene.

``bench check-plugin`` runs it, and so do the tests of the methods that come with the harness. Each check is a
function that takes a :class:`Subject` and returns its findings in a few words, or raises :class:`Broken`
with what is wrong.
"""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from traceback import format_exc
from typing import Any, Literal, get_args

import numpy as np
import torch
from safetensors.torch import load, save

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.transfer import Bump, TransferFunction
from econgs_bench.econgs.splat.composite import over
from econgs_bench.econgs.splat.rasterise import rasterise
from econgs_bench.methods.contract.scene import away, cameras, tiny_scene
from econgs_bench.methods.failures import Failure, Fault, failure
from econgs_bench.methods.interface import (
    PRESETS,
    Budget,
    Checkpoint,
    Decoding,
    DrawnHere,
    DrawsTogether,
    Edit,
    HasDecoders,
    HasGaussians,
    Method,
    MethodSpec,
    Model,
    OptionValue,
    Refused,
    RunsPrograms,
    SceneInput,
    check_ledger,
)
from econgs_bench.methods.options import CONFIGURATION, declared, resolve
from econgs_bench.methods.registry import check_spec

TOLERANCE = 1e-6  # of colors and alpha: a model must not depend on the process that renders it
_DECODED = 1e-5
"""The same for networks that run elsewhere: sums in float32 have another order."""
_OTHER_BUMP = Bump("other", 0.1, 0.3, 0.5, 0.8, (0.1, 0.8, 0.2), 0.6)
EDITS: Mapping[str, tuple[Edit, ...]] = {
    "palette": (Edit(palette=(0.9, 0.1, 0.1)),),
    "opacity": (Edit(opacity=0.3),),
    "light": (Edit(light=(0.0, 0.6, 0.8)),),
    "shading": (Edit(ambient=0.5), Edit(diffuse=0.5), Edit(specular=3.0), Edit(shininess=0.5)),
    "transfer": (
        Edit(transfer=TransferFunction("other", (_OTHER_BUMP,), 0.05)),
        Edit(shift=0.5),
        Edit(width=2.0),
    ),
}


Kind = Literal["transfer", "isosurfaces"]
KINDS: frozenset[Kind] = frozenset({"transfer", "isosurfaces"})
"""What scenes with a volume show of it."""


class Broken(AssertionError):
    """A promise of the contract is broken.

    Attributes:
        failure: what another process said about its cause.
    """

    def __init__(self, problem: str, failure: Failure | None = None) -> None:
        super().__init__(problem)
        self.failure = failure


def expect(holds: object, problem: str) -> None:
    """Raise :class:`Broken` unless the promise holds; unlike ``assert`` also under ``python -O``."""
    if not holds:
        raise Broken(problem)


class Recorder:
    """A monitor that keeps every report, and checkpoints after certain iterations."""

    def __init__(self, checkpoint_at: Sequence[int] = ()) -> None:
        self.stops = set(checkpoint_at)
        self.iterations: list[int] = []
        self.losses: list[float] = []
        self.checkpoints: dict[int, Checkpoint] = {}

    def progress(self, iteration: int, losses: Mapping[str, float], primitives: int) -> None:
        self.iterations.append(iteration)
        if losses:
            self.losses.append(losses["loss"])

    def due(self, iteration: int) -> bool:
        return iteration in self.stops

    def pause(self, iteration: int, model: Callable[[], Model], checkpoint: Callable[[], Checkpoint]) -> None:
        model().primitives()
        state = checkpoint()
        # Written and read: training must not share the checkpoint's tensors.
        arrays = load(save({name: values.cpu().contiguous() for name, values in state.arrays.items()}))
        try:
            scalars = json.loads(json.dumps(state.scalars))
        except TypeError as error:
            raise Broken(f"a checkpoint's scalars cannot be written as JSON: {error}") from error
        self.checkpoints[iteration] = Checkpoint(state.iteration, arrays, scalars)

    def stage(self, name: str) -> None:
        pass


class Subject:
    """A plugin under examination.

    Args:
        spec: the method's spec.
        method: its implementation.
        folder: empty, for models.
        iterations: of each fit.
        overrides: options that differ from those of the preset "quick".
        plugins: folders that a new process must know to find the method.
        device: "cpu" or "cuda".
    """

    def __init__(
        self,
        spec: MethodSpec,
        method: Method,
        folder: Path,
        iterations: int = 60,
        overrides: Mapping[str, OptionValue] | None = None,
        plugins: Sequence[Path] = (),
        device: str = "cpu",
    ) -> None:
        self.spec, self.method, self.folder, self.device = spec, method, folder, device
        self.iterations, self.plugins = iterations, tuple(plugins)
        self.overrides = dict(overrides or {})
        self.scene = self.tiny("tiny")
        self.camera = self.scene.validation.cameras[0]
        self.stops = sorted({max(1, iterations * part // 8) for part in (1, 3, 5, 7)} | {iterations})
        self._first: tuple[Model, Recorder] | None = None

    def tiny(self, name: str, turn: float = 0.0, swapped: bool = False) -> SceneInput:
        """The tiny scene; it has a volume only if the method says that it reads one."""
        if not self.spec.needs_volume:
            return tiny_scene(name, turn)
        kind: Kind = "transfer" if "transfer" in self.spec.volume_scenes else "isosurfaces"
        return tiny_scene(name, turn, kind, swapped)

    def pair(self) -> list[SceneInput]:
        """Two scenes of a group; those of a volume show the same one in other colors."""
        reads = self.spec.needs_volume
        return [self.tiny("tiny"), self.tiny("other", turn=0.0 if reads else 1.0, swapped=reads)]

    def fit(
        self,
        scenes: Sequence[SceneInput] | None = None,
        recorder: Recorder | None = None,
        resume: Checkpoint | None = None,
        iterations: int | None = None,
        seed: int = 7,
        **changed: OptionValue,
    ) -> Model:
        """A fit; of the tiny scene where no other is given."""
        options = resolve(self.spec, "quick", self.overrides | changed).options
        return self.method.fit(
            [self.scene] if scenes is None else scenes,
            options,
            Budget(self.iterations if iterations is None else iterations),
            seed,
            self.device,
            Recorder() if recorder is None else recorder,
            resume,
        )

    def restore(self, checkpoint: Checkpoint) -> Model:
        """The model of a finished fit's checkpoint."""
        options = resolve(self.spec, "quick", self.overrides).options
        return self.method.restore(checkpoint, options, self.device)

    def first(self) -> tuple[Model, Recorder]:
        """The fit that most checks look at."""
        if self._first is None:
            recorder = Recorder(self.stops)
            self._first = self.fit(recorder=recorder), recorder
        return self._first

    def saved(self, model: Model, name: str, rate: float | None = None) -> tuple[Path, Mapping[str, Any]]:
        """A new folder with the model, and the ledger."""
        folder = self.folder / name
        folder.mkdir(parents=True)
        return folder, model.save(folder, rate)


def files_of(folder: Path) -> dict[str, bytes]:
    """Name -> content of every file under a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def _picture(model: Model, camera: Camera, **arguments: Any) -> tuple[torch.Tensor, torch.Tensor]:
    rgb, alpha = model.render(camera, **arguments)
    return rgb.cpu(), alpha.cpu()


def _same(one: tuple[torch.Tensor, ...], other: tuple[torch.Tensor, ...], what: str) -> None:
    for a, b in zip(one, other, strict=True):
        far = float((a - b).abs().max())
        expect(far <= TOLERANCE, f"{what}: pictures differ by up to {far:.2g}")


def _check_ledger(ledger: Mapping[str, Mapping[str, int]], folder: Path, model: Model) -> int:
    total = sum(len(data) for data in files_of(folder).values())
    try:
        check_ledger(ledger, total, model.scenes)
    except RuntimeError as error:
        raise Broken(str(error)) from error
    return total


def _refused(what: str, call: Callable[[], object], *kinds: type[Exception]) -> str:
    kinds = kinds or (Refused,)
    try:
        call()
    except kinds as error:
        reason = str(error).strip()
    except Exception as error:
        raise Broken(f"{what}: {type(error).__name__} ({error}) instead of a refusal") from error
    else:
        raise Broken(f"{what}: not refused")
    expect(reason, f"{what}: refused without a reason")
    return reason


# --------------------------------------------------------------------------- the checks


def specification(subject: Subject) -> str:
    """The spec is sound; every preset, configuration and refitting rate knob resolves."""
    spec = subject.spec
    check_spec(spec, spec.name)
    for preset in PRESETS:
        for name in ("", *spec.configurations):
            resolve(spec, preset, {CONFIGURATION: name} if name else {})
        for knob in spec.rate_knobs:
            expect(knob.values, f"the rate knob {knob.name!r} has no values")
            if knob.refit:
                for value in knob.values:
                    resolve(spec, preset, {knob.name: value})
    return f"{len(declared(spec.options))} options, {len(spec.configurations)} configurations"


def partition(subject: Subject) -> str:
    """Every scene lies in one group; a method that is not joint refuses a group of two."""
    scenes = [subject.tiny(name) for name in ("a", "b", "c")]
    options = resolve(subject.spec, "quick", subject.overrides).options
    groups = subject.method.partition(scenes, options)
    names = [scene.name for group in groups for scene in group]
    expect(sorted(names) == ["a", "b", "c"], f"the groups hold {names}")
    if not subject.spec.joint:
        expect(len(groups) == 3, "a method that is not joint put scenes together")
        _refused("a group of two scenes", lambda: subject.fit(scenes[:2], iterations=2))
    return f"{len(groups)} groups of 3 scenes"


def fit(subject: Subject) -> str:
    """Every iteration is reported, losses are finite, and the pictures are pictures."""
    model, recorder = subject.first()
    expect(
        recorder.iterations == list(range(1, subject.iterations + 1)),
        f"progress was reported {len(recorder.iterations)} times in {subject.iterations} iterations",
    )
    expect(np.isfinite(recorder.losses).all(), "a loss is not finite")
    expect(model.scenes == ("tiny",), f"the model holds {model.scenes}")
    expect(
        model.primitives() == model.primitives("tiny") > 0,
        f"{model.primitives()} primitives in all, {model.primitives('tiny')} of the only scene",
    )
    camera = subject.camera
    white, alpha = _picture(model, camera, background=(1.0, 1.0, 1.0))
    expect(white.shape == (camera.height, camera.width, 3), f"rgb has shape {tuple(white.shape)}")
    expect(alpha.shape == (camera.height, camera.width), f"alpha has shape {tuple(alpha.shape)}")
    for name, values in (("rgb", white), ("alpha", alpha)):
        expect(float(values.min()) >= 0.0, f"{name} goes down to {float(values.min())}")
        expect(float(values.max()) <= 1.0, f"{name} goes up to {float(values.max())}")
    _same(_picture(model, camera), (white, alpha), "the default is not the scene's background")
    black, again = _picture(model, camera, background=(0.0, 0.0, 0.0))
    _same((again,), (alpha,), "alpha depends on the background")
    composited = (black + (1.0 - alpha[..., None])).clamp(0.0, 1.0)
    far = float((composited - white).abs().max())
    expect(far < 1e-3, f"the background is not composited with 1 - alpha: {far:.2g} apart")
    times = model.timings(camera)
    expect(min(times.values()) >= 0.0, f"timings are {times}")
    return f"{model.primitives()} primitives, loss {recorder.losses[0]:.3f} to {recorder.losses[-1]:.3f}"


def saved_and_loaded(subject: Subject) -> str:
    """The ledger sums to the files; a new process that loads them renders the same picture."""
    model, _ = subject.first()
    folder, ledger = subject.saved(model, "model")
    total = _check_ledger(ledger, folder, model)
    camera = subject.camera
    np.savez(
        subject.folder / "view.npz",
        pose=camera.camera_to_world,
        fov=camera.fov_x,
        width=camera.width,
        height=camera.height,
        near=camera.near,
    )
    plugins = (str(Path(folder).resolve()) for folder in subject.plugins)
    arguments = [subject.spec.name, subject.device, str(subject.folder), *plugins]
    done = subprocess.run(
        [sys.executable, "-m", "econgs_bench.methods.contract.fresh", *arguments],
        cwd=subject.folder,
        capture_output=True, encoding="utf-8", check=False,
    )  # fmt: skip
    if done.returncode != 0:
        raise _elsewhere(done, subject.folder / "failure.json")
    with np.load(subject.folder / "picture.npz") as out:
        pictures = torch.from_numpy(out["rgb"]), torch.from_numpy(out["alpha"])
    _same(pictures, _picture(model, camera), "a new process renders something else")
    again, _ = subject.saved(subject.method.load(folder, subject.device), "again")
    expect(files_of(again) == files_of(folder), "saving what was loaded gives other files")
    return f"{total} bytes"


def _elsewhere(done: subprocess.CompletedProcess[str], file: Path) -> Broken:
    """What went wrong in a process of its own that wrote ``file``, if it could."""
    problem = "a new process cannot load and render it"
    if file.is_file():
        facts = json.loads(file.read_text(encoding="utf-8"))
        return Broken(f"{problem}: {facts.pop('error')}", Failure(**facts))
    if done.returncode < 0:
        name = signal.Signals(-done.returncode).name
        fault: Fault = "machine" if name == "SIGKILL" else "plugin"
        return Broken(f"{problem}: it was ended by {name}", Failure(fault))
    return Broken(f"{problem}:\n{done.stderr[-2000:]}", Failure("harness"))


def numbering(subject: Subject) -> str:
    """The Gaussians of a view give its picture, and each keeps its number where fewer are in view."""
    model, _ = subject.first()
    if not isinstance(model, HasGaussians):
        return "no Gaussians"
    camera, (scene,) = subject.camera, model.scenes
    with torch.inference_mode():
        views = [(one, *model.splats(scene, one)) for one in (camera, replace(camera, width=6, height=6))]
        for view, splats, numbers in views:
            images = rasterise(*splats[:5], view, low_pass=splats.low_pass)
            picture = over(images.features, images.alpha, subject.scene.train.background)
            pair = picture.clamp(0.0, 1.0).cpu(), images.alpha.clamp(0.0, 1.0).cpu()
            _same(pair, _picture(model, view), "what is splatted")
            expect(len(numbers.unique()) == len(numbers), "two Gaussians of a view have one number")
    (_, whole, every), (_, part, some) = views
    places = dict(zip(every.tolist(), whole.means.tolist(), strict=True))
    for number, place in zip(some.tolist(), part.means.tolist(), strict=True):
        known = places.get(number, place)  # what fades with the direction may be missing
        expect(math.dist(known, place) <= TOLERANCE, f"Gaussian {number} is another one in another view")
    return f"{len(every)} Gaussians, {len(some)} in a corner"


def decoders(subject: Subject) -> str:
    """A model whose networks run for each frame gives the same pictures."""
    model, _ = subject.first()
    if not isinstance(model, HasDecoders):
        return "no networks"
    decoding = model.decoding(model.scenes)
    expect(decoding in get_args(Decoding), f"decoding is {decoding!r}")
    each, names = model.decoding_each_frame(), list(model.scenes)
    expect(
        isinstance(each, HasDecoders) and each.decoding(names) == "per frame", "it does not decode each frame"
    )
    for before, after in zip(_picture(model, subject.camera), _picture(each, subject.camera), strict=True):
        far = float((after - before).abs().max())
        expect(far <= _DECODED, f"decoded for each frame, a picture is {far:.2g} apart")
    return f"decoded {decoding}"


def edits(subject: Subject) -> str:
    """Declared edits change the picture, the others are refused, and so are bad values and names."""
    model, _ = subject.first()
    camera = subject.camera
    plain = _picture(model, camera)
    _same(_picture(model, camera, edit={"tiny": Edit()}), plain, "an edit of nothing")
    for kind, examples in EDITS.items():
        declared = kind in subject.spec.edits
        changed = False
        for example in examples:
            render = partial(model.render, camera, edit={"tiny": example})
            if declared:
                changed |= not torch.equal(render()[0].cpu(), plain[0])
            else:
                _refused(f"the undeclared {kind} edit", render)
        expect(changed or not declared, f"the declared {kind} edit changes nothing")
    if "opacity" in subject.spec.edits:
        same = _picture(model, camera, edit={"tiny": Edit(opacity=1.0)})
        _same(same, plain, "an opacity factor of 1 changes something")
        none = _picture(model, camera, edit={"tiny": Edit(opacity=0.0)})[1]
        expect(not none.any(), "an opacity factor of 0 leaves something")
        fainter = _picture(model, camera, edit={"tiny": Edit(opacity=0.3)})[1]
        expect(fainter.sum() < plain[1].sum(), "a smaller opacity does not make it fainter")
        _refused("a negative opacity factor", lambda: model.render(camera, edit={"tiny": Edit(opacity=-1.0)}))
    _refused(
        "an edit of a scene that is not there",
        lambda: model.render(camera, edit={"other": Edit()}),
        Refused,
        DataError,
    )
    _same(_picture(model, camera), plain, "the model remembers an edit")
    return ", ".join(sorted(subject.spec.edits)) or "none"


def nothing_visible(subject: Subject) -> str:
    """A camera that sees nothing shows the background, and views of nothing can be learned from."""
    model, _ = subject.first()
    camera = away(subject.camera)
    rgb, alpha = _picture(model, camera, background=(0.25, 0.5, 1.0))
    expect(float(alpha.max()) == 0.0, f"alpha is up to {float(alpha.max())} where nothing is")
    _same((rgb,), (torch.tensor([0.25, 0.5, 1.0]).expand_as(rgb),), "the background")
    train = subject.scene.train
    empty = replace(subject.scene, train=replace(train, images=np.zeros_like(train.images)))
    faded = subject.fit([empty])
    camera = subject.camera
    pictures = _picture(faded, camera)
    expect(all(bool(torch.isfinite(one).all()) for one in pictures), "views of nothing give NaN")
    folder, ledger = subject.saved(faded, "faded")
    _check_ledger(ledger, folder, faded)
    _same(_picture(subject.method.load(folder, subject.device), camera), pictures, "what is left, loaded")
    return f"{faded.primitives()} primitives are left of an empty scene"


def deterministic(subject: Subject) -> str:
    """One seed gives the same files, whatever the global generators hold."""
    folders = []
    for run in range(2):
        torch.manual_seed(run)
        np.random.seed(run)  # noqa: NPY002
        folders.append(subject.saved(subject.fit(), f"run{run}")[0])
    one, other = map(files_of, folders)
    expect(one == other, f"two fits differ in {[n for n in one if one[n] != other.get(n)]}")
    return "same files"


def resumable(subject: Subject) -> str:
    """Interrupted and resumed is uninterrupted."""
    whole, recorder = subject.first()
    expected = files_of(subject.saved(whole, "whole")[0])
    expect(
        sorted(recorder.checkpoints) == subject.stops,
        f"asked to pause after {subject.stops}, it did after {sorted(recorder.checkpoints)}",
    )
    for stop in subject.stops[:-1]:
        rest = Recorder()
        checkpoint = recorder.checkpoints[stop]
        expect(checkpoint.iteration == stop, f"a checkpoint at {stop} is of iteration {checkpoint.iteration}")
        resumed = subject.fit(recorder=rest, resume=checkpoint)
        expect(rest.losses == recorder.losses[stop:], f"losses differ after a stop at {stop}")
        files = files_of(subject.saved(resumed, f"resumed{stop}")[0])
        expect(files == expected, f"the model differs after a stop at {stop}")
    return f"stopped at {', '.join(map(str, subject.stops[:-1]))}"


def restored(subject: Subject) -> str:
    """The checkpoint of a finished fit gives the same model, at every rate, without scenes and views."""
    whole, recorder = subject.first()
    expect(recorder.checkpoints, "no checkpoint after the last iteration")
    model = subject.restore(recorder.checkpoints[subject.iterations])
    knobs = [knob for knob in subject.spec.rate_knobs if not knob.refit]
    rates = [None, *(value for knob in knobs for value in knob.values)]
    for rate in rates:
        files = [
            files_of(subject.saved(one, f"{name}{rate}", rate)[0])
            for name, one in (("fitted", whole), ("restored", model))
        ]
        expect(files[0] == files[1], f"the restored model has other files (rate {rate})")
    return f"same files at {len(rates)} rates" if knobs else "same files"


def joint(subject: Subject) -> str:
    """A method that is joint fits two scenes as one group, saves, loads and resumes them."""
    if not subject.spec.joint:
        return "each scene on its own"
    pair = subject.pair()
    stop = subject.stops[len(subject.stops) // 2]
    recorder = Recorder([stop, subject.iterations])
    try:
        model = subject.fit(pair, recorder)
    except Refused as error:
        raise Broken(f"a group of two scenes: refused ({error})") from error
    expect(sorted(model.scenes) == ["other", "tiny"], f"the model holds {model.scenes}")
    counts = [model.primitives(name) for name in model.scenes]
    expect(
        model.primitives() == sum(counts), f"{model.primitives()} primitives in all, {counts} of the scenes"
    )
    folder, ledger = subject.saved(model, "joint")
    total = _check_ledger(ledger, folder, model)
    loaded = subject.method.load(folder, subject.device)
    camera = subject.camera
    pictures = {name: _picture(model, camera, scenes=[name]) for name in model.scenes}
    for name, pictured in pictures.items():
        _same(_picture(loaded, camera, scenes=[name]), pictured, f"scene {name}, loaded")
    expect(not torch.equal(pictures["tiny"][0], pictures["other"][0]), "both scenes look the same")
    expect(recorder.checkpoints, f"asked to pause after {stop}, it did not")
    resumed = subject.fit(pair, resume=recorder.checkpoints[stop])
    model = subject.restore(recorder.checkpoints[subject.iterations])
    for name, one in (("resumed", resumed), ("restored", model)):
        files = files_of(subject.saved(one, f"joint-{name}")[0])
        expect(files == files_of(folder), f"the {name} model of two scenes differs")
    return f"2 scenes in {total} bytes"


def composition(subject: Subject) -> str:
    """Models of two groups render together, and each alone as before; or composing is refused."""
    one, _ = subject.first()
    other = subject.fit([subject.tiny("other", turn=1.0)])
    if not subject.spec.composable:
        _refused("composing", lambda: subject.method.compose([one, other]))
        return "refused"
    both = subject.method.compose([one, other])
    expect(both.scenes == ("tiny", "other"), f"the composed model holds {both.scenes}")
    counts = [one.primitives(), other.primitives()]
    expect(both.primitives() == sum(counts), f"{both.primitives()} primitives in all, {counts} of the models")
    camera = subject.camera
    alone = _picture(one, camera)
    _same(_picture(both, camera, scenes=["tiny"]), alone, "the first scene, alone")
    _same(_picture(both, camera, scenes=["other"]), _picture(other, camera), "the second scene, alone")
    together = _picture(both, camera)
    expect(float((together[1] - alone[1]).min()) > -0.01, "together they hide less than one alone")
    expect(not torch.equal(together[0], alone[0]), "the second scene does not show")
    folder, ledger = subject.saved(both, "composed")
    _check_ledger(ledger, folder, both)
    loaded = subject.method.load(folder, subject.device)
    _same(_picture(loaded, camera, scenes=list(both.scenes)), together, "the composed model, loaded")
    _refused("composing two scenes of one name", lambda: subject.method.compose([one, one]))
    _refused(
        "rendering a scene that is not there",
        lambda: both.render(camera, scenes=["nowhere"]),
        Refused,
        DataError,
    )
    return "2 scenes together"


def rates(subject: Subject) -> str:
    """Every value of every rate knob gives a model that loads; without one, saving at a rate is refused."""
    model, _ = subject.first()
    rows = []
    camera = subject.camera
    for knob in subject.spec.rate_knobs:
        for value in knob.values:
            fitted = model
            if knob.refit:
                setting: dict[str, Any] = {knob.name: value}
                fitted = subject.fit(iterations=min(20, subject.iterations), **setting)
            saved_at = None if knob.refit else value
            folder, ledger = subject.saved(fitted, f"rate-{knob.name}-{value:g}", saved_at)
            rows.append(f"{knob.name} {value:g}: {_check_ledger(ledger, folder, fitted)} bytes")
            rgb, _ = _picture(subject.method.load(folder, subject.device), camera)
            expect(bool(torch.isfinite(rgb).all()), f"NaN at {knob.name} {value:g}")
    if all(knob.refit for knob in subject.spec.rate_knobs):
        _refused("saving at a rate", lambda: subject.saved(model, "rate", 1.0))
    return "; ".join(rows) or "one size"


def bad_files(subject: Subject) -> str:
    """Missing, truncated and foreign files are named, never rendered."""
    model, _ = subject.first()
    folder, _ = subject.saved(model, "broken")
    read = subject.method.load
    _refused("a folder that is not there", lambda: read(folder / "nowhere", subject.device), DataError)
    count = 0
    for file in [path for path in sorted(folder.rglob("*")) if path.is_file()]:
        whole = file.read_bytes()
        for broken in (
            b"",
            whole[: len(whole) // 2],
            whole[: max(0, len(whole) - 5)],
            b"nothing of the kind" * 50,
        ):
            file.write_bytes(broken)
            reason = _refused(
                f"{file.name} cut to {len(broken)} of {len(whole)} bytes",
                lambda: read(folder, subject.device),
                DataError,
            )
            expect(file.stem in reason, f"the error does not name {file.name}: {reason}")
            count += 1
        file.write_bytes(whole)
    read(folder, subject.device)
    return f"{count} damaged files named"


def refusals(subject: Subject) -> str:
    """A scene that cannot be learned is refused; one point and one view are not too few.

    Without training views there is nothing to learn, unless the method reads the volume. Such a method
    refuses the kinds of scenes that it does not take.
    """
    scene, train = subject.scene, subject.scene.train
    if subject.spec.needs_volume:
        others = KINDS - subject.spec.volume_scenes
        unfit = {f"a scene of {kind}": tiny_scene("tiny", volume=kind) for kind in sorted(others)}
    else:
        blind = replace(train, cameras=(), images=train.images[:0])
        unfit = {"a scene without training views": replace(scene, train=blind)}
    for what, other in unfit.items():
        _refused(what, partial(subject.fit, [other], iterations=2))
    cloud = replace(scene.cloud, points=scene.cloud.points[:1], colors=scene.cloud.colors[:1])
    single = replace(
        scene, cloud=cloud, train=replace(train, cameras=train.cameras[:1], images=train.images[:1])
    )
    model = subject.fit([single], iterations=min(20, subject.iterations))
    for camera in cameras(2):
        expect(bool(torch.isfinite(_picture(model, camera)[0]).all()), "one point and one view give NaN")
    return f"{', '.join(unfit) or 'nothing'} refused; one point and one view trained"


def environment(subject: Subject) -> str:
    """What the commands need is there."""
    method = subject.method
    expect(isinstance(method, RunsPrograms), "it runs no programs")
    if isinstance(method, RunsPrograms):
        method.prepare([subject.scene], subject.device)
    return "interpreter, folder and check"


def trained(subject: Subject) -> str:
    """Training ends with 0, tells its iterations and leaves the files of a model."""
    model, recorder = subject.first()
    expect(model.scenes == ("tiny",), f"the model holds {model.scenes}")
    expect(np.isfinite(recorder.losses).all(), "a loss is not finite")
    expect(subject.iterations in recorder.checkpoints, "there is no model after the last iteration")
    arrays = recorder.checkpoints[subject.iterations].arrays
    told = f", loss {recorder.losses[0]:.3g} to {recorder.losses[-1]:.3g}" if recorder.losses else ""
    seen = len(set(recorder.iterations) - {subject.iterations})
    return f"{len(arrays)} files of {sum(map(len, arrays.values()))} bytes, {seen} iterations seen{told}"


def pictures(subject: Subject) -> str:
    """One process draws a picture of each camera, on the background if without alpha; they show the scene."""
    model, _ = subject.first()
    train = subject.scene.train
    chosen = range(0, len(train), max(1, len(train) // 4))
    views = [train.cameras[place] for place in chosen]
    if not isinstance(model, DrawsTogether):
        return "drawn here"
    drawn = model.draw_all(views, background=train.background)
    errors, blank, has_alpha = [], [], True
    for index, place in enumerate(chosen):
        rgb, alpha = drawn[index]
        has_alpha &= alpha is not None
        truth = train.composited(place)
        errors.append(float(np.square(rgb - truth).mean()))
        blank.append(float(np.square(np.asarray(train.background) - truth).mean()))
    expect(np.mean(errors) < np.mean(blank), "training views are farther from the truth than a blank picture")
    frames = f", {1e3 * float(np.median(drawn.frame_seconds)):.3g} ms a frame" if drawn.frame_seconds else ""
    psnr = -10.0 * math.log10(max(float(np.mean(errors)), 1e-12))
    kind = "RGBA" if has_alpha else "without alpha"
    return f"{len(views)} {kind}, {psnr:.1f} dB{frames}"


def gaussians(subject: Subject) -> str:
    """Where it writes Gaussians, they can be drawn here."""
    model, _ = subject.first()
    if not subject.spec.drawn_here or not isinstance(model, DrawnHere):
        return "none"
    here = model.drawn_here()
    rgb, alpha = _picture(here, subject.camera)
    expect(bool(torch.isfinite(rgb).all() and torch.isfinite(alpha).all()), "drawn here, a picture has NaN")
    own, _ = _picture(model, subject.camera)
    far = -10.0 * math.log10(max(float((rgb - own).square().mean()), 1e-12))
    return f"{here.primitives()} Gaussians, {far:.1f} dB between both drawings"


CHECKS: tuple[Callable[[Subject], str], ...] = (
    specification,
    partition,
    fit,
    saved_and_loaded,
    numbering,
    decoders,
    edits,
    nothing_visible,
    deterministic,
    resumable,
    restored,
    joint,
    composition,
    rates,
    bad_files,
    refusals,
)


COMMAND_CHECKS: tuple[Callable[[Subject], str], ...] = (
    specification,
    environment,
    partition,
    trained,
    pictures,
    saved_and_loaded,
    gaussians,
    edits,
    restored,
    composition,
    rates,
)
"""Those of a method that other programs carry out: how these train and draw is their own."""


@dataclass(frozen=True)
class Outcome:
    """How a check went.

    Attributes:
        name: the check's name.
        status: "passed", "failed" (the promise is broken) or "error" (something else was raised).
        detail: the findings, or what is wrong.
        seconds: it took.
        promise: what was checked.
        failure: whose fault it is, if it did not pass.
        traceback: all of it, if it did not pass.
    """

    name: str
    status: Literal["passed", "failed", "error"]
    detail: str
    seconds: float
    promise: str
    failure: Failure | None = None
    traceback: str = ""


def run_checks(subject: Subject) -> Iterator[Outcome]:
    """Every check in turn; none stops the others."""
    for check in CHECKS if subject.spec.resumable else COMMAND_CHECKS:
        start = time.perf_counter()
        status: Literal["passed", "failed", "error"] = "passed"
        fault: Failure | None = None
        whole = ""
        try:
            detail = check(subject)
        except Broken as error:
            status, detail, whole = "failed", str(error), format_exc()
            fault = error.failure or failure(error, subject.spec)
            if fault.fault == "harness" and error.failure is None:  # a broken promise without an exception
                fault = Failure("plugin")
        except Exception as error:
            status, detail, whole = "error", f"{type(error).__name__}: {error}", format_exc()
            fault = failure(error, subject.spec)
        seconds = time.perf_counter() - start
        yield Outcome(check.__name__, status, detail, seconds, check.__doc__ or "", fault, whole)
