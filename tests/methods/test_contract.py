"""The contract kit: every built-in method passes it, and a plugin that breaks a promise is caught."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.contract.checks import CHECKS, Recorder, Subject, files_of, run_checks
from econgs_bench.methods.gaussian_splatting.method import GaussianSplatting
from econgs_bench.methods.gaussian_splatting.model import GaussianModel
from econgs_bench.methods.gaussian_splatting.spec import SPEC as PLAIN
from econgs_bench.methods.gaussian_splatting.training import Trainer
from econgs_bench.methods.interface import Diverged, Edit, RateKnob
from econgs_bench.methods.options import CONFIGURATION, resolve
from econgs_bench.methods.registry import Registry, load_method

ANCHORS = {"features": 16, "offsets": 4, "voxel": 0.01, "growth_gradient": 0.0}
SMALL = {
    "3dgs": {"background": "random"},
    "scaffold-gs": {**ANCHORS, "background": "random"},
    "hac": {**ANCHORS, "background": "random", "grid": "small", "context_hidden": 24},
    "hac-plus": {**ANCHORS, "background": "random", "grid": "small", "context_hidden": 24},
    "econgs": {**ANCHORS, "hidden": 16, "embedding": 4},
    "3dgs-mcmc": {"cap": 300, "background": "random"},
    "vq-3dgs": {"max_gaussians": 300},
    "3dgs-coded": {"max_gaussians": 300},
    "ivr-gs": {"max_gaussians": 300},
    "veg": {"max_gaussians": 300, "background": "random"},
    "ccnerf": {"density_ranks": 8, "ranks": 8, "first_side": 12, "side": 20, "rays": 128},
    "plenoxels": {"resolution": 24, "rays": 500},
}
"""Small models; growth at every occasion and random backgrounds, so that resuming has more to keep."""


@pytest.fixture(scope="module", params=Registry().built_in())
def subject(request, tmp_path_factory):
    """One examination for all checks of a method: they share its first fit."""
    spec = Registry().spec(request.param)
    folder = tmp_path_factory.mktemp(spec.name)
    return Subject(spec, load_method(spec), folder, iterations=32, overrides=SMALL.get(spec.name))


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_built_in_methods_keep_the_contract(subject, check):
    assert check(subject)


@pytest.mark.parametrize("name", SMALL)
def test_every_option_is_read(name, tmp_path, monkeypatch):
    """An option that nothing reads would stand in tables as if it had acted."""
    spec = Registry().spec(name)
    names, read = {field.name for field in dataclasses.fields(spec.options)}, set()

    def reading(options, attribute):
        read.update({attribute} & names)
        return object.__getattribute__(options, attribute)

    random = {"start": "random", "random_points": 200} if "random_points" in names else {}
    paper = {CONFIGURATION: "paper", **random}
    for i, overrides in enumerate((SMALL[name], SMALL[name] | paper)):
        subject = Subject(spec, load_method(spec), tmp_path / str(i), iterations=32, overrides=overrides)
        scenes = [subject.tiny("one"), subject.tiny("two", 0.15)][: 1 + spec.joint]
        settings = resolve(spec, "quick", overrides)
        with monkeypatch.context() as patch:
            patch.setattr(spec.options, "__getattribute__", reading)
            settings.budget(len(scenes))
            subject.method.partition(scenes, settings.options)
            model = subject.fit(scenes, Recorder())
            subject.saved(model, "model")
    assert read == names


def test_a_changed_byte_is_refused_or_changes_no_picture(subject):
    model, _ = subject.first()
    folder, _ = subject.saved(model, "changed")
    camera = subject.scene.train.cameras[0]
    before = [part.numpy() for part in subject.method.load(folder, "cpu").render(camera)]
    random = np.random.default_rng(0)
    refused = 0
    for file in [path for path in sorted(folder.rglob("*")) if path.is_file()]:
        whole = file.read_bytes()
        for place in random.choice(len(whole), min(20, len(whole)), replace=False):
            file.write_bytes(
                whole[:place] + bytes([whole[place] ^ 1 << random.integers(8)]) + whole[place + 1 :]
            )
            try:
                after = subject.method.load(folder, "cpu").render(camera)
            except DataError:
                refused += 1
            else:
                for one, other in zip(before, after, strict=True):
                    np.testing.assert_array_equal(one, other.numpy(), f"{file.name}, byte {place}")
        file.write_bytes(whole)
    assert refused


def test_another_seed_gives_another_model(subject):
    if subject.spec.needs_volume:
        return  # chance has no part in it
    one, other = (subject.saved(subject.fit(iterations=8, seed=seed), f"seed{seed}")[0] for seed in (7, 8))
    assert files_of(one) != files_of(other)


def test_views_that_are_not_finite_are_called_diverged(subject):
    if subject.spec.needs_volume:
        return  # it does not learn from them
    train = subject.scene.train
    broken = dataclasses.replace(train, images=np.full_like(train.images, np.nan))
    with pytest.raises(Diverged, match=r"image loss.*iteration 1"):
        subject.fit([dataclasses.replace(subject.scene, train=broken)])


# --------------------------------------------------------------------------- what the kit must catch


class Wasteful(GaussianModel):
    def save(self, folder, rate=None):
        ledger = super().save(folder, rate)
        (folder / "more.bin").write_bytes(b"1234")
        return ledger


class Deaf(GaussianModel):
    """Takes every edit and does nothing."""

    def render(self, camera, scenes=None, edit=None, background=None):
        return super().render(camera, scenes, {name: Edit() for name in edit or ()}, background)


class Careless(GaussianModel):
    """Saves at any rate."""

    def save(self, folder, rate=None):
        return super().save(folder)


class Forgetful(GaussianSplatting):
    """Resumes with another order of views."""

    def fit(self, group, options, budget, seed, device, monitor, resume=None):
        if resume is not None:
            resume = dataclasses.replace(resume, scalars={**resume.scalars, "pending": []})
        return super().fit(group, options, budget, seed, device, monitor, resume)


class Whimsical(GaussianSplatting):
    """Draws its seed from the global generator."""

    def fit(self, group, options, budget, seed, device, monitor, resume=None):
        seed = int(torch.randint(1000, ())) if resume is None else seed
        return super().fit(group, options, budget, seed, device, monitor, resume)


class Hoarder(GaussianSplatting):
    """Keeps in its checkpoints what JSON cannot hold."""

    class trainer(Trainer):
        def checkpoint(self):
            state = super().checkpoint()
            return dataclasses.replace(state, scalars={**state.scalars, "views": {1, 2}})


class Amnesiac(GaussianSplatting):
    """Restores the first Gaussian only."""

    def restore(self, *arguments):
        scene = super().restore(*arguments).scene("tiny")
        arrays = {name: v[:1] for name, v in vars(scene).items() if isinstance(v, torch.Tensor)}
        return GaussianModel([dataclasses.replace(scene, **arrays)])


class Gullible(GaussianSplatting):
    """Renders whatever it can read."""

    def load(self, folder, device):
        try:
            return super().load(folder, device)
        except Exception:
            return GaussianModel([])


def with_model(kind):
    class Method(GaussianSplatting):
        def fit(self, *arguments):
            model = super().fit(*arguments)
            return kind([model.scene(name) for name in model.scenes])

    return Method()


KNOB = RateKnob("size", (4.0, 8.0), refit=False)


@pytest.mark.parametrize(
    ("method", "changed", "check", "words"),
    [
        (with_model(Wasteful), {}, "saved_and_loaded", "byte ledger sums to"),
        (with_model(Deaf), {}, "edits", "palette edit: not refused"),
        (with_model(Deaf), {"edits": frozenset(PLAIN.edits | {"palette"})}, "edits", "changes nothing"),
        (with_model(Careless), {}, "rates", "saving at a rate: not refused"),
        (GaussianSplatting(), {"rate_knobs": (KNOB,)}, "rates", "no rate knob"),
        (GaussianSplatting(), {"joint": True}, "joint", "a group of two scenes: refused"),
        (Hoarder(), {}, "fit", "cannot be written as JSON"),
        (GaussianSplatting(), {"composable": False}, "composition", "composing: not refused"),
        (Forgetful(), {}, "resumable", "losses differ after a stop"),
        (Amnesiac(), {}, "restored", "other files"),
        (Whimsical(), {}, "deterministic", "two fits differ"),
        (Gullible(), {}, "bad_files", "not refused"),
        (
            GaussianSplatting(),
            {"needs_volume": True, "volume_scenes": frozenset({"isosurfaces"})},
            "refusals",
            "a scene of transfer: not refused",
        ),
    ],
)
def test_a_broken_promise_is_caught(tmp_path, method, changed, check, words):
    subject = Subject(dataclasses.replace(PLAIN, **changed), method, tmp_path, 24, {"background": "random"})
    (wanted,) = [one for one in CHECKS if one.__name__ == check]
    with pytest.raises(Exception, match=words):
        wanted(subject)


def test_only_a_method_that_reads_volumes_gets_one(tmp_path):
    class Reader(GaussianSplatting):
        def fit(self, group, *arguments):
            assert group[0].volume().normalised().max() == 1.0
            return super().fit(group, *arguments)

    assert Subject(PLAIN, GaussianSplatting(), tmp_path / "a", 2).scene.volume is None
    reads = dataclasses.replace(PLAIN, needs_volume=True)
    reading = Subject(reads, Reader(), tmp_path / "b", 2)
    assert reading.fit().primitives() > 0
    assert reading.scene.scene.transfer is not None
    surfaces = dataclasses.replace(reads, volume_scenes=frozenset({"isosurfaces"}))
    assert len(Subject(surfaces, Reader(), tmp_path / "c", 2).scene.scene.isosurfaces) == 2


def test_no_check_stops_the_others(tmp_path):
    class Broken(GaussianSplatting):
        def fit(self, *arguments):
            raise ZeroDivisionError("no fit at all")

    outcomes = list(run_checks(Subject(PLAIN, Broken(), tmp_path, 5)))
    assert [one.name for one in outcomes] == [check.__name__ for check in CHECKS]
    assert outcomes[0].status == "passed"
    assert {one.status for one in outcomes[2:-1] if one.name != "joint"} == {"error"}
    assert "no fit at all" in outcomes[2].detail
