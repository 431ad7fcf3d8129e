"""Compositions, masks, isosurfaces, depth enhancement: closed forms, and Mitsuba against the oracle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from econgs_bench.datasets.ground_truth.model import Layer, MarchSettings
from econgs_bench.datasets.ground_truth.occlusion import RADII, bake
from econgs_bench.datasets.scene import Isosurface, Light
from econgs_bench.datasets.transfer import Bump, TransferFunction
from econgs_bench.datasets.volume import Volume
from tests.datasets import marching
from tests.datasets.marching import FIXED, HEAD, PHONG, around, camera_at, mitsuba, noise, volume


def transfer(*bumps):
    return TransferFunction("t", tuple(Bump("b", *b) for b in bumps))


LOW = transfer((0.3, 0.36, 0.4, 0.45, (0.9, 0.5, 0.1), 0.4))
HIGH = transfer((0.6, 0.65, 0.7, 0.75, (0.1, 0.5, 0.9), 0.6), (0.8, 0.85, 1.0, 1.0, (0.4, 0.9, 0.2), 0.9))
EVERYTHING = transfer((0.0, 0.0, 1.0, 1.0, (0.5, 0.3, 0.7), 0.02))
LEVELS = (Isosurface("a", 0.55, (0.9, 0.5, 0.2), 0.4), Isosurface("b", 0.7, (0.2, 0.6, 0.9), 0.8))


A = volume(noise((30, 40, 35), 2.5), (1.0, 1.2, 0.9))
B = volume(noise((30, 40, 35), 3.5, seed=1), (1.0, 1.2, 0.9))
FROM_MIDDLE = np.linalg.norm(np.moveaxis(np.indices((30, 40, 35)), 0, -1) - (15.0, 20.0, 17.0), axis=-1)
BALL = FROM_MIDDLE < 14.3
MASKED = replace(A, mask=BALL)

SCENES = {
    "composition on one volume": [Layer(A, LOW, HEAD), Layer(A, HIGH, PHONG)],
    "composition on two volumes": [Layer(A, LOW, HEAD), Layer(B, HIGH, FIXED), Layer(A, HIGH, None)],
    "mask": [Layer(MASKED, EVERYTHING, HEAD)],
    "composition with mask": [Layer(MASKED, LOW, FIXED), Layer(B, HIGH, HEAD)],
    "depth-enhanced": [Layer(A, HIGH, HEAD, (), 0.8)],
    "depth-enhanced composition": [Layer(MASKED, LOW, HEAD, (), 0.5), Layer(B, HIGH, FIXED, (), 1.0)],
    "isosurfaces": [Layer(A, None, HEAD, LEVELS)],
    "isosurfaces, phong, masked, enhanced": [Layer(MASKED, None, PHONG, LEVELS, 0.7)],
    "isosurfaces of two volumes and a volume": [
        Layer(A, None, HEAD, LEVELS[:1]),
        Layer(B, None, None, LEVELS[1:]),
        Layer(B, LOW, FIXED),
    ],
}


@pytest.mark.parametrize("name", SCENES)
def test_mitsuba_agrees_with_the_oracle_and_bricks_change_nothing(name):
    layers = SCENES[name]
    error = marching.errors(layers)
    good = np.ones(error.shape, dtype=bool)
    if any(layer.isosurfaces for layer in layers):
        # A ray that grazes a surface may cross it twice, or not at all, by the last bit.
        good = error < 0.02
        assert (~good).mean() < 2e-3
        assert np.sqrt((error**2).mean()) <= 5e-3
    assert np.sqrt((error[good] ** 2).mean()) <= 5e-5
    assert error[good].max() <= 2e-4


def slab(shape=(9, 9, 33)):
    """Rising linearly along x from 0 to 1, and the camera that looks along x."""
    return volume(np.broadcast_to(np.linspace(0.0, 1.0, shape[2]), shape)), camera_at([3.0, 0.0, 0.0])


def picture(renderer, camera, *layers):
    """(height, width, 4) of one view."""
    return renderer.compose((camera,), layers)[0]


def density(opacity):
    return -np.log1p(-opacity) / 0.01


def test_extinctions_of_a_composition_add_and_colors_are_weighted_by_them(marcher):
    a, b = volume(np.full((11, 16, 7), 0.3)), volume(np.full((11, 16, 7), 0.8))
    first = transfer((0.2, 0.2, 0.4, 0.4, (0.9, 0.4, 0.2), 0.01))
    second = transfer((0.7, 0.7, 1.0, 1.0, (0.1, 0.3, 0.8), 0.03))
    layers = [Layer(a, first, None), Layer(b, second, None), Layer(b, first, HEAD)]
    image = marcher([a, b]).compose((camera_at([0.0, 5.0, 0.0]),), layers)[0, 16, 16]
    s, t = density(0.01), density(0.03)
    alpha = 1.0 - np.exp(-(s + t) * a.extent[1])
    np.testing.assert_allclose(image[3], alpha, atol=3e-6)
    expected = alpha * (s * np.array([0.9, 0.4, 0.2]) + t * np.array([0.1, 0.3, 0.8])) / (s + t)
    np.testing.assert_allclose(image[:3], expected, atol=3e-6)


def test_each_layer_is_shaded_by_its_own_gradient_and_light(marcher):
    """One rises along x, the other along z: under lights along x and z both face theirs."""
    x = np.linspace(0.0, 1.0, 25)
    a, b = volume(np.broadcast_to(x, (25, 25, 25))), volume(np.broadcast_to(x[:, None, None], (25, 25, 25)))
    everywhere = transfer((-1.0, 0.0, 1.0, 2.0, (0.8, 0.8, 0.8), 0.05))
    along_x, along_z = (Light(d, 0.0, 1.0, 0.0) for d in ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    camera, both = camera_at([0.0, 4.0, 0.0], fov=0.1), marcher([a, b])
    facing = picture(both, camera, Layer(a, everywhere, along_x), Layer(b, everywhere, along_z))
    np.testing.assert_allclose(facing[..., :3] / facing[..., 3:], 0.8, atol=1e-4)
    aside = picture(both, camera, Layer(a, everywhere, along_x), Layer(b, everywhere, along_x))
    np.testing.assert_allclose(aside[..., :3] / aside[..., 3:], 0.4, atol=1e-4)


def test_layers_of_one_volume_that_share_a_transfer_function_are_one():
    halves = transfer((0.6, 0.65, 0.7, 0.75, (0.1, 0.5, 0.9), 0.3))
    whole = replace(halves, reference_length=0.5 * halves.reference_length)
    one, two = (
        mitsuba(A).compose(around(A, size=48), layers)
        for layers in ([Layer(A, whole, FIXED)], [Layer(A, halves, FIXED)] * 2)
    )
    assert one[..., 3].max() > 0.5
    np.testing.assert_allclose(one, two, atol=2e-5)


def test_a_mask_fades_within_the_cell_of_its_border(marcher):
    mask = np.zeros((9, 9, 33), dtype=bool)
    mask[:, :, :17] = True
    v = volume(np.full(mask.shape, 0.5), mask=mask)
    image = marcher(v, MarchSettings(step_voxels=0.01)).render(
        (camera_at([3.0, 0.0, 0.0]),), EVERYTHING, None
    )
    alpha = 1.0 - np.exp(-density(0.02) * 16.5 / 32)  # 16 whole cells and the mean of a fading one
    np.testing.assert_allclose(image[0, 16, 16, 3], alpha, atol=2e-5)


def test_what_lies_beyond_a_mask_is_never_seen(marcher):
    """No shell of other values: a border cell and its gradient reach two voxels beyond the mask."""
    far = FROM_MIDDLE > 14.3 + 2 * 3**0.5
    values = A.values.copy()
    values[far] = np.random.default_rng(3).random(far.sum())
    for layer in (Layer(MASKED, EVERYTHING, HEAD), Layer(MASKED, None, HEAD, LEVELS)):
        other = replace(layer, volume=replace(MASKED, values=values))
        one, two = (marcher(each.volume).compose(around(A, size=24), [each]) for each in (layer, other))
        assert one[..., 3].max() > 0.3
        np.testing.assert_array_equal(one, two)


def test_a_plane_is_hit_where_it_is_whatever_the_step(marcher):
    """A level of a linear field, in front of and behind a homogeneous medium."""
    v, camera = slab()
    medium = volume(np.full((9, 9, 33), 0.5))
    plane = Layer(v, None, None, (Isosurface("p", 0.67, (0.2, 0.8, 0.4), 0.6),))
    direction = camera.rays()[1][16, 16]
    for step in (0.3, 0.7, 3.0):
        settings = MarchSettings(step_voxels=step)
        alone = marcher(v, settings).compose((camera,), [plane])[0, 16, 16]
        np.testing.assert_allclose(alone, 0.6 * np.array([0.2, 0.8, 0.4, 1.0]), atol=1e-6)
        for order in (1, -1):
            layers = [plane, Layer(medium, EVERYTHING, None)][::order]
            pixel = marcher([v, medium], settings).compose((camera,), layers)[0, 16, 16]
            before = 1.0 - np.exp(-density(0.02) * 0.33 / -direction[0])
            behind = 1.0 - np.exp(-density(0.02) * 0.67 / -direction[0])
            through = before + 0.4 * (1.0 - before) * behind
            surface = 0.6 * (1.0 - before)
            np.testing.assert_allclose(pixel[3], through + surface, atol=1e-5)
            expected = through * np.array([0.5, 0.3, 0.7]) + surface * np.array([0.2, 0.8, 0.4])
            np.testing.assert_allclose(pixel[:3], expected, atol=1e-5)


def test_levels_are_met_in_order_from_either_side(marcher):
    v, _ = slab()
    red, green = Isosurface("r", 0.5, (1.0, 0.0, 0.0), 0.5), Isosurface("g", 0.505, (0.0, 1.0, 0.0), 0.5)
    front = marcher(v).compose((camera_at([3.0, 0.1, 0.1]),), [Layer(v, None, None, (red, green))])[0, 16, 16]
    np.testing.assert_allclose(front, (0.25, 0.5, 0.0, 0.75), atol=1e-6)
    back = marcher(v).compose((camera_at([-3.0, 0.1, 0.1]),), [Layer(v, None, None, (green, red))])[0, 16, 16]
    np.testing.assert_allclose(back, (0.5, 0.25, 0.0, 0.75), atol=1e-6)


def test_a_plateau_at_the_level_is_inside(marcher):
    """8-bit values make plateaus at exactly the level; rounding must not draw surfaces within."""
    values = np.full((17, 17, 17), 51, dtype=np.uint8)
    values[:, :, :8] = 7
    v = Volume("v", values, (1.0, 1.0, 1.0), (0.0, 255.0), "made here")
    level = Layer(v, None, None, (Isosurface("s", 51 / 255, (1.0, 1.0, 1.0), 0.5),))
    image = picture(marcher(v), camera_at([3.0, 0.4, 0.3]), level)
    assert set(np.unique(image[8:25, 8:25, 3])) == {np.float32(0.5)}


def sphere(n=49, radius=0.35):
    """Level 0.5 is a sphere; the field is quadratic."""
    x = np.linspace(-0.5, 0.5, n)
    square = x[:, None, None] ** 2 + x[:, None] ** 2 + x**2
    return volume(np.clip(0.5 + radius**2 - square, 0.0, 1.0))


def test_a_sphere_has_its_silhouette_and_its_normals(marcher):
    v, radius = sphere(), 0.35
    light = Light((0.0, 0.6, 0.8), 0.1, 0.9, 0.0)
    camera = camera_at([1.5, -1.2, 0.9], size=80, fov=0.5)
    image = picture(marcher(v), camera, Layer(v, None, light, (Isosurface("s", 0.5, (0.9, 0.6, 0.3)),)))
    origin, direction = camera.rays()
    along = -(direction @ origin)
    nearest = np.linalg.norm(origin + along[..., None] * direction, axis=-1)
    voxel = 1.0 / 48
    clear = np.abs(nearest - radius) > 0.02 * voxel  # trilinear interpolation cuts chords off the sphere
    np.testing.assert_array_equal(image[..., 3][clear], (nearest < radius)[clear] * 1.0)
    inner = nearest < 0.97 * radius
    assert inner.sum() > 1000
    hit = origin + (along - np.sqrt(np.maximum(radius**2 - nearest**2, 0.0)))[..., None] * direction
    lit = 0.1 + 0.9 * np.abs(hit @ np.array(light.direction)) / radius
    expected = np.clip(lit[..., None] * (0.9, 0.6, 0.3), 0.0, 1.0)
    np.testing.assert_allclose(image[inner][:, :3], expected[inner], atol=3e-3)


def test_silhouettes_are_those_of_marching_cubes():
    from PIL import Image, ImageDraw
    from skimage.measure import marching_cubes

    v = A
    vertices, faces, _, _ = marching_cubes(v.values, 0.55)
    points = vertices[:, ::-1] / (np.array(v.dims) - 1.0) * v.extent - 0.5 * v.extent
    camera = around(v, size=120, pick=(3,))[0]
    image = picture(mitsuba(v), camera, Layer(v, None, None, (Isosurface("s", 0.55, (1.0, 1.0, 1.0)),)))
    rotation, fine = camera.camera_to_world[:3, :3], 8
    local = (points - camera.position) @ rotation
    x = fine * (camera.fx * local[:, 0] / local[:, 2] + camera.cx) - 0.5
    y = fine * (camera.fy * local[:, 1] / local[:, 2] + camera.cy) - 0.5
    canvas = Image.new("L", (120 * fine, 120 * fine))
    draw = ImageDraw.Draw(canvas)
    for face in faces:
        draw.polygon([(x[i], y[i]) for i in face], fill=255, outline=255)
    covered = np.asarray(canvas).reshape(120, fine, 120, fine).mean(axis=(1, 3)) / 255
    clear = (covered == 0.0) | (covered == 1.0)
    assert 0.1 < covered.mean() < 0.9
    wrong = image[..., 3][clear] != covered[clear]
    # Marching cubes cuts corners in ambiguous cells.
    assert wrong.mean() < 2e-3


def test_isosurfaces_do_not_depend_on_the_step():
    layers = [Layer(A, None, HEAD, LEVELS)]
    images = {
        s: mitsuba(A, MarchSettings(step_voxels=s)).compose(around(A, size=96), layers)
        for s in (1.0, 0.5, 0.125)
    }
    for step, allowed in ((1.0, 0.02), (0.5, 0.01)):
        differs = np.abs(images[step] - images[0.125]).max(axis=-1) > 1e-3
        assert differs.mean() < allowed  # double crossings within a step, at silhouettes


def plain_occlusion(extinction, spacing):
    """The formula of the model's docstring, neighbour by neighbour in double precision."""
    result = np.zeros(extinction.shape)
    for radius in RADII:
        reach = [int(np.rint(radius / h)) for h in spacing[::-1]]
        opaque = np.pad(1.0 - np.exp(-radius * extinction), [(r, r) for r in reach])
        total, count = np.zeros(extinction.shape), 0
        for offset in np.ndindex(*(2 * r + 1 for r in reach)):
            total += opaque[tuple(slice(o, o + n) for o, n in zip(offset, extinction.shape, strict=True))]
            count += 1
        result += total / count / len(RADII)
    return result


def test_occlusion_is_baked_as_written():
    layers = [Layer(MASKED, LOW, None, (), 1.0), Layer(B, HIGH, None)]
    size = 4096
    baked = bake(layers, [A.values, B.values], size)
    assert baked.cube == 1
    entries = [np.rint(each.values * np.float32(size - 1)).astype(int) / (size - 1) for each in (A, B)]
    extinction = LOW.classify(entries[0])[..., 3] * BALL + HIGH.classify(entries[1])[..., 3]
    spacing = A.extent / (np.array(A.dims) - 1)
    np.testing.assert_allclose(baked.values, plain_occlusion(extinction, spacing), atol=2e-6)
    assert np.ptp(baked.values) > 0.3

    coarse = bake(layers, [A.values, B.values], size, most=14)  # cubes of 3, the last ones cut off
    assert (coarse.cube, coarse.values.shape) == (3, (10, 14, 12))
    blocks = np.full((30, 42, 36), np.nan)
    blocks[:, :40, :35] = extinction
    means = np.nanmean(blocks.reshape(10, 3, 14, 3, 12, 3), axis=(1, 3, 5))
    # Means of means weigh alike only in whole cubes.
    expected = plain_occlusion(means, 3 * spacing)
    np.testing.assert_allclose(coarse.values, expected, atol=2e-6)
    # The centre of the first cube is voxel 1, that of the second voxel 4.
    assert coarse.scale * 1 + coarse.offset == pytest.approx(0.0)
    assert coarse.scale * 4 + coarse.offset == pytest.approx(1.0)


def test_isosurfaces_occlude_as_thin_shells():
    v, _ = slab()
    surface = (Isosurface("s", 0.5 + 1e-4, (1.0, 1.0, 1.0), 1.0),)
    baked = bake([Layer(v, None, None, surface, 1.0)], [v.values], 64)
    extinction = np.zeros(v.values.shape)
    extinction[:, :, 16:18] = -np.log(0.01) / (2 * v.voxel)
    np.testing.assert_allclose(
        baked.values, plain_occlusion(extinction, v.extent / (np.array(v.dims) - 1)), atol=2e-6
    )


def test_depth_enhancement_darkens_by_the_occlusion_and_off_is_off(marcher):
    v = volume(np.full((9, 17, 33), 0.5))
    camera = camera_at([3.0, 0.0, 0.0])
    color = np.array([0.5, 0.3, 0.7])
    plain, off, half = (
        picture(marcher(v), camera, Layer(v, EVERYTHING, None, (), strength)) for strength in (0.0, 0.0, 0.5)
    )
    np.testing.assert_array_equal(plain, off)
    np.testing.assert_array_equal(plain[..., 3], half[..., 3])
    baked = bake([Layer(v, EVERYTHING, None)], [v.normalised()], 16384).values[4, 8]
    steps = 64
    along = (np.arange(steps) + 0.5) / steps * 32
    occlusion = np.interp(along, np.arange(33), baked)
    alpha = 1.0 - np.exp(-density(0.02) / steps)
    weight = alpha * (1.0 - alpha) ** np.arange(steps)
    expected = (weight * (1.0 - 0.5 * occlusion[::-1])).sum() * color
    np.testing.assert_allclose(half[16, 16, :3], expected, rtol=2e-3)
    assert (half[16, 16, :3] < 0.95 * plain[16, 16, :3]).all()


def test_a_composition_compiles_once_for_all_its_scenes():
    fast = mitsuba([A, B])

    def launched(*layers):
        return marching.kernels(lambda: fast.compose(around(A, size=24), layers))

    first = launched(Layer(A, LOW, HEAD), Layer(B, HIGH, FIXED))
    assert first
    assert launched(Layer(A, HIGH, FIXED), Layer(B, EVERYTHING, HEAD)) <= first
    surfaces = launched(Layer(A, None, HEAD, LEVELS))
    assert launched(Layer(A, None, FIXED, LEVELS[:1])) <= surfaces
