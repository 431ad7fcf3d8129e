"""Triangle meshes against the marcher of the ground truth, exact geometry and other readers."""

import json
import os
import subprocess
import sys
from collections import Counter
from dataclasses import replace

import DracoPy
import numpy as np
import pytest
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOPLY import vtkPLYReader

from econgs_bench.datasets.edits import Edit, edited
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.ground_truth.model import Layer
from econgs_bench.datasets.ground_truth.reference import ReferenceMarcher
from econgs_bench.datasets.scene import BasicScene, Isosurface, Light
from econgs_bench.datasets.volume import Volume
from econgs_bench.methods.contract.scene import look_at, tiny_scene
from econgs_bench.methods.interface import Budget, Refused, SceneInput
from econgs_bench.methods.mesh.geometry import decimated, distance, extracted, level_of
from econgs_bench.methods.mesh.method import MeshMethod
from econgs_bench.methods.mesh.spec import MeshOptions

EXACT = MeshOptions(kept=1.0, coding="ply")
BALL = Isosurface("ball", 0.5, (0.9, 0.5, 0.2))
SHELL = Isosurface("shell", 0.3, (0.2, 0.5, 0.9), 0.4)
CORE = replace(BALL, opacity=0.7)
LAMP = Light((0.0, 0.6, 0.8), ambient=0.2, diffuse=0.6, specular=0.5, shininess=12.0)


def ball(size=64, middle=(0.0, 0.0, 0.0), spacing=(1.0, 1.0, 1.0), mask=None):
    """Values whose level v is a sphere of radius (1 - v) / 2 around a point."""
    counts = np.array([size, size, size]) // np.array([1, 1, 1 if spacing[2] == 1.0 else 2])
    volume = Volume("ball", np.zeros(counts[::-1]), spacing, (0.0, 1.0), "test", mask)
    axes = [np.linspace(low, high, n) for low, high, n in zip(*volume.box, counts, strict=True)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    far = np.linalg.norm(np.stack([x, y, z], -1) - middle, axis=-1)
    return replace(volume, values=1.0 - 2.0 * far)


def given(volume, *surfaces, light=Light(), **more):  # noqa: B008  (frozen)
    scene = BasicScene("one", volume.name, light=light, isosurfaces=surfaces, **more)
    return replace(tiny_scene("one"), scene=scene, volume=lambda: volume)


class Quiet:
    """A monitor that wants nothing."""

    def progress(self, *report):
        pass

    def due(self, iteration):
        return False

    def stage(self, name):
        pass


def fitted(scene: SceneInput, options=EXACT):
    return MeshMethod().fit([scene], options, Budget(1), 0, "cpu", Quiet())


def camera(size=128, **changed):
    return replace(look_at((1.3, -1.1, 0.8), size=size, fov=0.7), **changed)


def decibels(picture, truth):
    """PSNR of colors on white and of alpha, of premultiplied pictures."""
    pairs = (picture[0], truth[..., :3] + 1.0 - truth[..., 3:]), (picture[1], truth[..., 3])
    errors = [float(np.square(one.numpy() - other).mean()) for one, other in pairs]
    return [10.0 * np.log10(1.0 / max(error, 1e-12)) for error in errors]


def truth(volume, scene, view):
    return ReferenceMarcher(volume).compose((view,), [Layer.of(scene, volume)])[0]


# --------------------------------------------------------------------------- pictures


@pytest.mark.parametrize(
    ("surfaces", "light", "least"),
    [
        ((BALL,), Light(), 50.0),
        ((BALL,), LAMP, 50.0),
        ((BALL,), replace(LAMP, model="phong"), 50.0),
        ((BALL,), replace(Light(), model="phong"), 50.0),
        ((BALL,), None, 50.0),
        ((BALL, SHELL), Light(), 45.0),  # depth peeling has 8 bits a channel
        ((SHELL, CORE), LAMP, 45.0),
    ],
    ids=["headlight", "lamp", "phong lamp", "phong headlight", "unshaded", "shell", "both translucent"],
)
def test_the_undecimated_mesh_has_the_picture_of_the_ground_truth(surfaces, light, least):
    volume = ball()
    scene = given(volume, *surfaces, light=light)
    view = camera(fx=170.0, cx=70.0, cy=60.0)  # neither square pixels nor a centred principal point
    picture = fitted(scene).render(view, background=(1.0, 1.0, 1.0))
    expected = truth(volume, scene.scene, view)
    assert 0.1 < expected[..., 3].mean() < 0.9
    # Pixels whose centres lie within a hundredth of a pixel of an outline may fall on either side.
    edge = np.abs(picture[1].numpy() - expected[..., 3]) > 0.1
    assert edge.sum() <= 3
    expected[edge] = 0.0
    rgb, alpha = (one.clone() for one in picture)
    rgb[edge], alpha[edge] = 1.0, 0.0
    assert min(decibels((rgb, alpha), expected)) > least


@pytest.mark.parametrize(
    "edit",
    [
        Edit(palette=(0.1, 0.7, 0.3)),
        Edit(opacity=0.5),
        Edit(opacity=3.0),
        Edit(light=(0.6, 0.0, -0.8)),
        Edit(light="headlight"),
        Edit(ambient=0.3, diffuse=1.2, specular=2.0, shininess=0.4),
    ],
    ids=lambda edit: next(name for name, value in vars(edit).items() if value is not None),
)
def test_edits_are_those_of_the_ground_truth(edit):
    volume = ball()
    scene = given(volume, BALL, SHELL, light=LAMP)
    expected = truth(volume, edited(scene.scene, edit), camera())
    picture = fitted(scene).render(camera(), edit={"one": edit}, background=(1.0, 1.0, 1.0))
    assert min(decibels(picture, expected)) > 40.0


def test_scenes_together_are_ordered_along_each_ray():
    volumes = ball(middle=(0.15, 0.0, 0.0)), ball(middle=(-0.1, 0.1, 0.05))
    ones = [given(volumes[0], SHELL), given(volumes[1], CORE, light=LAMP)]
    ones[1] = replace(ones[1], scene=replace(ones[1].scene, name="two"))
    both = MeshMethod().compose([fitted(one) for one in ones])
    layers = [Layer.of(one.scene, volume) for one, volume in zip(ones, volumes, strict=True)]
    expected = ReferenceMarcher(volumes).compose((camera(),), layers)[0]
    for names in (["one", "two"], ["two", "one"]):
        picture = both.render(camera(), scenes=names, background=(1.0, 1.0, 1.0))
        assert min(decibels(picture, expected)) > 40.0


# --------------------------------------------------------------------------- geometry


def test_a_sphere_is_closed_and_as_large_as_it_should_be():
    volume = ball(spacing=(1.0, 1.0, 2.0))
    (mesh,) = extracted(volume, [BALL])
    sides = np.sort(np.concatenate([mesh.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), axis=1)
    edges = Counter(map(tuple, sides.tolist()))
    assert set(edges.values()) == {2}
    assert len(mesh.points) - len(edges) + len(mesh.faces) == 2
    a, b, c = (mesh.points[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    assert area == pytest.approx(4.0 * np.pi * 0.25**2, rel=0.01)
    assert np.linalg.norm(mesh.points, axis=1) == pytest.approx(0.25, abs=0.1 * volume.voxel)
    radial = mesh.points / np.linalg.norm(mesh.points, axis=1, keepdims=True)
    assert np.abs((mesh.normals() * radial).sum(axis=1)).min() > np.cos(np.radians(8.0))


def test_a_masked_surface_ends_with_the_mask():
    mask = np.ones((32, 32, 32), bool)
    mask[:, :, 16:] = False
    (mesh,) = extracted(ball(32, mask=mask), [BALL])
    assert mesh.points[:, 0].max() == pytest.approx(0.0, abs=1e-6)  # between samples 15 and 16
    assert mesh.points[:, 0].min() == pytest.approx(-0.25, abs=0.005)


def test_distance_is_that_of_a_plane_moved_aside():
    x = np.broadcast_to(np.linspace(0.0, 1.0, 17), (9, 9, 17)).astype(np.float32)
    volume = Volume("x", x, (1.0, 1.0, 1.0), (0.0, 1.0), "test")
    plane = replace(BALL, value=0.4)
    (mesh,) = extracted(volume, [plane])
    assert distance(volume, level_of(plane), mesh) < 1e-4
    moved = replace(mesh, points=mesh.points + np.float32([0.3 * volume.voxel, 0.0, 0.0]))
    assert distance(volume, level_of(plane), moved) == pytest.approx(0.3, abs=1e-4)


def test_decimation_keeps_its_share_and_stays_near():
    volume = ball()
    (mesh,) = extracted(volume, [BALL])
    for share, most in ((0.5, 0.05), (0.1, 0.2), (0.02, 1.0)):
        fewer = decimated(mesh, share)
        assert len(fewer) == pytest.approx(share * len(mesh), rel=0.02)
        assert distance(volume, level_of(BALL), fewer) < most
    assert decimated(mesh, 1.0) is mesh


# --------------------------------------------------------------------------- files


def test_files_open_in_other_readers_and_ledgers_count_them(tmp_path):
    model = fitted(given(ball(), BALL, SHELL), MeshOptions())
    ledger = model.save(tmp_path)
    files = {path.name: path.stat().st_size for path in tmp_path.iterdir()}
    assert set(files) == {"one.json", "one.0.drc", "one.1.drc"}
    assert ledger == {
        "one": {"triangles": files["one.0.drc"] + files["one.1.drc"], "metadata": files["one.json"]}
    }
    meshes = [DracoPy.decode((tmp_path / f"one.{n}.drc").read_bytes()) for n in range(2)]
    assert sum(len(mesh.faces) for mesh in meshes) == model.primitives()
    far = np.linalg.norm(meshes[0].points, axis=1) - 0.25
    step = MeshOptions().step * ball().voxel
    assert np.abs(far).max() < 0.1 * ball().voxel + step

    plain = tmp_path / "plain"
    plain.mkdir()
    fitted(given(ball(), BALL)).save(plain)
    reader = vtkPLYReader()
    reader.SetFileName(str(plain / "one.0.ply"))
    reader.Update()
    found = reader.GetOutput()
    (mesh,) = extracted(ball(), [BALL])
    assert (vtk_to_numpy(found.GetPoints().GetData()) == mesh.points).all()
    assert (vtk_to_numpy(found.GetPolys().GetConnectivityArray()).reshape(-1, 3) == mesh.faces).all()


def test_fewer_triangles_take_fewer_bytes(tmp_path):
    model = fitted(given(ball(), BALL), MeshOptions())
    sizes = []
    for share in (1.0, 0.5, 0.1, 0.02):
        folder = tmp_path / str(share)
        folder.mkdir()
        sizes.append(model.save(folder, share)["one"]["triangles"])
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < 0.1 * sizes[0]
    loaded = MeshMethod().load(folder, "cpu")
    with pytest.raises(Refused, match="was loaded"):
        loaded.save(tmp_path, 0.5)
    with pytest.raises(Refused, match=r"share of triangles in \(0, 1\]"):
        model.save(tmp_path, 1.5)


def test_a_level_that_nothing_reaches_is_an_empty_mesh(tmp_path):
    volume = replace(ball(), value_range=(-10.0, 10.0))
    model = fitted(given(volume, replace(BALL, value=0.9)), MeshOptions())
    assert model.primitives() == 0
    model.save(tmp_path)
    rgb, alpha = MeshMethod().load(tmp_path, "cpu").render(camera(16), background=(0.2, 0.4, 0.6))
    assert not alpha.any()
    assert np.allclose(rgb, [0.2, 0.4, 0.6])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "another"}, "format 'another'"),
        ({"coding": "zip"}, "coding 'zip'"),
        ({"background": [1.0]}, "not a scene of meshes"),
        ({"light": {"ambient": 1.0}}, "not a scene of meshes"),
    ],
)
def test_damaged_definitions_are_named(tmp_path, change, words):
    fitted(given(ball(16), BALL)).save(tmp_path)
    file = tmp_path / "one.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(DataError, match=words):
        MeshMethod().load(tmp_path, "cpu")


# --------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (tiny_scene("seen"), "'seen' has only views"),
        (tiny_scene("foggy", volume="transfer"), "'foggy' has a transfer function"),
        (given(ball(16), BALL, depth_enhancement=0.5), "no depth enhancement"),
    ],
    ids=["views", "transfer", "enhanced"],
)
def test_scenes_that_are_no_surfaces_are_refused_by_name(scene, words):
    with pytest.raises(Refused, match=words):
        fitted(scene)


@pytest.mark.parametrize("package", ["DracoPy", "fast_simplification"])
def test_a_missing_package_is_refused_with_the_remedy(monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(Refused, match=rf"{package.partition('_')[0]}.*rivals"):
        fitted(given(ball(16), BALL), MeshOptions())


def test_a_machine_without_egl_is_refused_with_the_remedy():
    code = "from econgs_bench.methods.mesh.canvas import Canvas; Canvas()"
    hidden = dict.fromkeys(("__EGL_VENDOR_LIBRARY_DIRS", "__EGL_VENDOR_LIBRARY_FILENAMES"), "/nowhere")
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | hidden,
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == 1
    assert "Refused" in done.stderr
    assert "apt-get install libegl1" in done.stderr
