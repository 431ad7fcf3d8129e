"""The volume itself, compressed: streams against official libraries, pictures against the ground truth."""

import hashlib
import json
import sys
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from econgs_bench.datasets.cloud import PointCloud
from econgs_bench.datasets.edits import Edit
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.render_views import live_renderer, views_of
from econgs_bench.datasets.scene import BasicScene, Dataset, Isosurface, Light
from econgs_bench.datasets.transfer import Bump, TransferFunction
from econgs_bench.datasets.view_cache import ViewCache
from econgs_bench.datasets.views import ViewRequest
from econgs_bench.datasets.volume import Volume
from econgs_bench.methods.contract.checks import Recorder, Subject
from econgs_bench.methods.interface import Budget, Refused, SceneInput
from econgs_bench.methods.options import resolve
from econgs_bench.methods.registry import Registry, load_method
from econgs_bench.methods.volume.codecs import Sz3, Zfp
from econgs_bench.methods.volume.stored import Samples, read

TEST = ViewRequest("test", 12, 3, 32, 32, samples=1)
FOG = TransferFunction("fog", (Bump("b", 0.3, 0.45, 0.6, 0.8, (0.9, 0.4, 0.2), 0.5),), 0.05)
SHELL = TransferFunction("shell", (Bump("c", 0.5, 0.6, 1.0, 1.0, (0.2, 0.5, 0.9), 0.7),), 0.05)
SKINS = (Isosurface("a", 0.4, (0.2, 0.8, 0.3), 0.4), Isosurface("b", 0.7, (0.8, 0.2, 0.3)))
SCENES = (
    BasicScene("fog", "u", FOG, background=(0.1, 0.2, 0.3)),
    BasicScene("shell", "u", SHELL, Light((0.6, 0.0, 0.8)), depth_enhancement=0.5),
    BasicScene("skins", "v", light=Light(model="phong"), isosurfaces=SKINS),
)
COMPOSITIONS = {"all": ("fog", "shell", "skins"), "one": ("fog", "shell")}


def field(seed):
    values = gaussian_filter(np.random.default_rng(seed).standard_normal((18, 20, 22)), 2.0)
    return (values - values.min()) / np.ptp(values)


def volume(name, seed, dtype="uint8"):
    values = field(seed)
    high = {"uint8": 200.0, "uint16": 4000.0, "float32": 1.0}[dtype]
    mask = None if name == "u" else field(seed + 1) > 0.3
    values = np.rint(values * high) if dtype != "float32" else values
    # Values beyond the range count as its ends.
    ends = (0.05 * high, 0.9 * high)
    return Volume(name, values.astype(dtype), (1.0, 1.2, 0.9), ends, "made here", mask)


@pytest.fixture(scope="module", params=["uint8", "float32"])
def data(request):
    volumes = {name: volume(name, seed, request.param) for name, seed in (("u", 1), ("v", 5))}
    return Dataset(
        request.param, "made here", "volume", SCENES, COMPOSITIONS,
        {name: (lambda v=v: v) for name, v in volumes.items()},
    )  # fmt: skip


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return ViewCache(tmp_path_factory.mktemp("views"))


def inputs(data, cache, names=("fog", "shell", "skins")):
    rows = []
    for name in names:
        scene = data.scene(name)
        train = views_of(data, name, replace(TEST, split="trainval"), cache=cache)
        cloud = PointCloud(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.float32))
        read_volume = data.volumes[scene.variable]
        rows.append(SceneInput(scene, train, replace(train, cameras=()), cloud, 3.0, read_volume))
    return rows


def fitted(name, group, **changed):
    spec = Registry().spec(name)
    options = resolve(spec, "quick", changed).options
    return load_method(spec).fit(group, options, Budget(1), 0, "cpu", Recorder())


def far(model, truth, **arguments):
    """Largest difference of a model's pictures from views: as displayed, and of alpha."""
    most = 0.0
    for i, camera in enumerate(truth.cameras):
        rgb, alpha = model.render(camera, background=truth.background, **arguments)
        most = max(most, float(np.abs(rgb.numpy() - truth.composited(i)).max()))
        most = max(most, float(np.abs(alpha.numpy() - truth.images[i, ..., 3]).max()))
    return most


def psnr(model, truth, **arguments):
    squares = [
        np.square(
            model.render(camera, background=truth.background, **arguments)[0].numpy() - truth.composited(i)
        )
        for i, camera in enumerate(truth.cameras)
    ]
    return -10.0 * np.log10(np.mean(squares))


# --------------------------------------------------------------------------- the compressors


def test_streams_of_zfp_are_those_of_zfpy():
    """Lengths and digests by zfpy 1.0.1.post0: compress_numpy(f, tolerance=0.125), and at that rate."""
    z, y, x = np.mgrid[0:5, 0:6, 0:7].astype(np.float32)
    f = ((x * y + z * z) % 11 / np.float32(10)).astype(np.float32)
    streams = [Zfp().compress(f, 0.125), Zfp(fixed_rate=True).compress(f, 0.125)]
    digests = [hashlib.sha256(stream).hexdigest()[:16] for stream in streams]
    assert [len(stream) for stream in streams] == [464, 480]
    assert digests == ["a8d8fdccc035fc6e", "6d6dbca79d36beed"]


@pytest.mark.parametrize("codec", [Sz3(), Zfp()], ids=lambda codec: codec.name)
@pytest.mark.parametrize("bound", [1.0, 1e-3, 1e-6])
@pytest.mark.parametrize("shape", [(2, 2, 2), (17, 33, 12)])
def test_no_error_is_above_its_bound(codec, bound, shape):
    random = np.random.default_rng(3)
    for values in (random.random(shape), np.full(shape, 0.7), np.indices(shape).sum(0) / sum(shape)):
        grid = np.ascontiguousarray(values, np.float32)
        again = codec.restore(codec.compress(grid, bound), shape)
        assert np.abs(again - grid).max() <= bound * (1.0 + 1e-6)
        assert codec.compress(grid, bound) == codec.compress(grid, bound)


def test_fixed_rate_takes_as_many_bytes_and_gives_up_the_bound():
    """On a field that is constant in most places, where fixed accuracy spends nothing."""
    sparse = np.maximum(field(5) - 0.7, 0.0).astype(np.float32)
    samples = Samples.of(Volume("v", sparse, (1.0, 1.0, 1.0), (0.0, 0.3), "made here"))
    one, other = (samples.stored(Zfp(fixed), 0.125) for fixed in (False, True))
    assert len(other.data) == pytest.approx(len(one.data), rel=0.05)
    error = [np.abs(s.volume.normalised() - samples.values).max() for s in (one, other)]
    assert error[1] > 3.0 * error[0]


@pytest.mark.parametrize("codec", [Sz3(), Zfp()], ids=lambda codec: codec.name)
@pytest.mark.parametrize(("dtype", "bound"), [("uint8", 2e-3), ("uint16", 1e-4)])
def test_whole_numbers_are_exact_under_half_a_step(codec, dtype, bound):
    source = volume("v", 5, dtype)
    samples = Samples.of(source)
    exact, tighter, loose = (samples.stored(codec, b) for b in (bound, bound / 10.0, 4.0 * bound))
    assert exact.volume.values.dtype == source.values.dtype
    np.testing.assert_array_equal(exact.volume.values, np.clip(source.values, *source.value_range))
    np.testing.assert_array_equal(exact.volume.mask, source.mask)
    assert exact.parts["volume"] == tighter.parts["volume"]
    assert loose.volume.values.dtype == np.float32
    assert sum(loose.parts.values()) == len(loose.data) < len(exact.data)


def test_every_damaged_byte_is_found():
    data = Samples.of(volume("v", 5)).stored(Zfp(), 1.0).data
    for place in range(0, len(data), 7):
        broken = bytearray(data)
        broken[place] ^= 0x10
        with pytest.raises(DataError, match="there"):
            read(bytes(broken), Zfp(), "there")
    with pytest.raises(DataError, match="compressed by zfp, not by sz3"):
        read(data, Sz3(), "there")


@pytest.mark.parametrize(
    "codec", [Sz3(), pytest.param(Zfp(), marks=pytest.mark.slow)], ids=lambda codec: codec.name
)
def test_damage_with_the_checksum_made_again_is_refused_or_a_volume(codec):
    data = Samples.of(volume("v", 5)).stored(codec, 0.01).data
    refused = 0
    # Each stream is decoded by a process of its own: headers are searched densely, the rest is not.
    for place in (*range(0, 100, 5), *range(100, len(data) - 4, 200)):
        broken = bytearray(data)
        broken[place] ^= 0x10
        broken[-4:] = zlib.crc32(broken[:-4]).to_bytes(4, "little")
        try:
            read(bytes(broken), codec, "there")
        except DataError:
            refused += 1
    assert refused


def test_a_scene_that_shows_nothing_is_refused(tmp_path):
    spec = Registry().spec("zfp")
    subject = Subject(spec, load_method(spec), tmp_path)
    folder, _ = subject.saved(subject.first()[0], "model")
    (file,) = folder.glob("*.json")
    about = json.loads(file.read_text())
    del about["crc32"], about["scene"]["transfer"]
    check = zlib.crc32(json.dumps(about, separators=(",", ":")).encode())
    file.write_text(json.dumps({**about, "crc32": check}, separators=(",", ":")))
    with pytest.raises(DataError, match="it shows nothing of the volume"):
        subject.method.load(folder, "cpu")


# --------------------------------------------------------------------------- pictures


@pytest.mark.parametrize("name", ["sz3", "zfp"])
def test_a_volume_without_loss_gives_the_ground_truth(data, cache, name, tmp_path):
    """Scenes of both kinds, alone, together and edited, from files; the cache of views has 16 bits."""
    groups = load_method(Registry().spec(name)).partition(inputs(data, cache), None)
    assert [[scene.name for scene in group] for group in groups] == [["fog", "shell"], ["skins"]]
    method, models = load_method(Registry().spec(name)), []
    for i, group in enumerate(groups):
        folder = tmp_path / str(i)
        folder.mkdir()
        fitted(name, group, error_bound=1e-6).save(folder)
        models.append(method.load(folder, "cpu"))
    model = method.compose(models)
    tolerance = 1.01 / 65535 if data.name == "uint8" else 3e-4
    for shown in ("fog", "shell", "skins", "one", "all"):
        parts = [scene.name for scene in data.parts(shown)]
        truth = views_of(data, shown, TEST, cache=cache)
        assert truth.images[..., 3].max() > 0.3
        assert far(model, truth, scenes=parts) <= tolerance
    live = live_renderer(data, "all", TEST)
    whole = model.render(live.cameras[0], scenes=COMPOSITIONS["all"], background=(0.0, 0.0, 0.0))
    truth = live.render(live.cameras[0])
    if data.name == "uint8":
        np.testing.assert_array_equal(whole[0].numpy(), truth[..., :3])
        np.testing.assert_array_equal(whole[1].numpy(), truth[..., 3])
    edits = {
        "fog": Edit(transfer=SHELL, opacity=0.5),
        "shell": Edit(light="headlight", specular=2.0, palette=(0.9, 0.1, 0.1)),
        "skins": Edit(opacity=0.5, ambient=0.2),
    }
    truth = views_of(data, "all", TEST, cache=cache, edit=edits)
    assert far(model, truth, scenes=COMPOSITIONS["all"], edit=edits) <= tolerance
    plain = views_of(data, "all", TEST, cache=cache)
    assert far(model, plain, scenes=COMPOSITIONS["all"]) <= tolerance


@pytest.mark.parametrize("name", ["sz3", "zfp"])
def test_more_bytes_are_better_pictures(data, cache, name, tmp_path):
    spec, method = Registry().spec(name), load_method(Registry().spec(name))
    model = fitted(name, inputs(data, cache, ("fog", "shell")))
    truth = views_of(data, "fog", TEST, cache=cache)
    rows = []
    for rate in spec.rate_knobs[0].values:
        folder = tmp_path / f"{rate:g}"
        folder.mkdir()
        ledger = model.save(folder, rate)
        loaded = method.load(folder, "cpu")
        rows.append((sum(ledger[""].values()), psnr(loaded, truth, scenes=["fog"])))
        assert set(ledger) == {"", "fog", "shell"}
        with pytest.raises(Refused, match="no other size"):
            loaded.save(folder, 0.02)
    assert sorted(rows) == rows
    assert [q for _, q in rows] == sorted(q for _, q in rows)
    assert rows[-1][1] > 60.0


def test_without_mitsuba_the_reference_marcher_draws(data, cache, monkeypatch):
    from econgs_bench.datasets.ground_truth.probe import Backend
    from econgs_bench.methods.volume import model as module

    model = fitted("sz3", inputs(data, cache, ("shell",)), error_bound=1e-6)
    monkeypatch.setattr(module, "find_backend", lambda cuda: Backend("none"))
    truth = views_of(data, "shell", TEST, cache=cache, renderer="reference")
    assert far(model, truth) < 2e-3


# --------------------------------------------------------------------------- what is refused


def test_refusals(data, cache):
    (fog,) = inputs(data, cache, ("fog",))
    with pytest.raises(Refused, match="only views"):
        fitted("sz3", [replace(fog, volume=None)])
    with pytest.raises(Refused, match="neither a transfer function nor isosurfaces"):
        fitted("sz3", [replace(fog, scene=replace(fog.scene, transfer=None))])
    model = fitted("sz3", [fog])
    camera = fog.train.cameras[0]
    with pytest.raises(Refused, match="no unit vector"):
        model.render(camera, edit={"fog": Edit(light=(1.0, 1.0, 0.0))})
    method = load_method(Registry().spec("sz3"))
    with pytest.raises(Refused, match="models of its own only"):
        method.compose([model, fitted("zfp", [fog])])
    small = replace(
        fog,
        scene=replace(fog.scene, name="small"),
        volume=lambda: replace(volume("u", 2), spacing=(2.0, 1.0, 1.0)),
    )
    both = method.compose([model, fitted("sz3", [small])])
    assert torch.isfinite(both.render(camera, scenes=["small"])[0]).all()
    with pytest.raises(Refused, match="differ in grid or box"):
        both.render(camera)


def test_scenes_without_a_volume_are_groups_of_their_own(data, cache):
    rows = [replace(scene, volume=None) for scene in inputs(data, cache)]
    groups = load_method(Registry().spec("zfp")).partition(rows, None)
    assert [len(group) for group in groups] == [1, 1, 1]


def test_a_missing_library_comes_with_its_remedy(data, cache, monkeypatch):
    monkeypatch.setitem(sys.modules, "pysz", None)
    with pytest.raises(Refused, match=r"pip install 'econgs-bench\[rivals\]'"):
        fitted("sz3", inputs(data, cache, ("fog",)))
