"""Signatures of the compiled module; tests/econgs/test_native_stub.py compares them with it.

All arrays are C-contiguous and on the CPU. The callers document shapes and meaning: econgs.splat.native,
econgs.anchors.native, econgs.codec.hash_grid, methods.ccnerf and methods.plenoxels.
"""

from collections.abc import Sequence

from numpy import float32, float64, int32, int64, uint8
from numpy.typing import NDArray

Bytes = NDArray[uint8]
Floats = NDArray[float32]
Doubles = NDArray[float64]
Ints = NDArray[int32]
Longs = NDArray[int64]
OutFloats = NDArray[float32]  # written, as all that begins with Out
OutBytes = NDArray[uint8]
OutInts = NDArray[int32]
OutLongs = NDArray[int64]

class Frame:
    @property
    def statistics(self) -> dict[str, float]: ...

class DecodeFrame:
    @property
    def gaussians(self) -> int: ...

class MarchFrame: ...

# fmt: off
def built_isas() -> list[str]: ...
def available_isas(testing: bool) -> list[str]: ...
def isa() -> str: ...
def set_isa(name: str) -> None: ...
def threads() -> int: ...
def set_threads(count: int) -> None: ...
def forward(
    means: Floats, quats: Floats, scales: Floats, opacities: Floats, features: Floats,
    offset: Floats | None, view: Doubles, near: float, low_pass: float, compensated: bool,
    ray_power: float,
    image: OutFloats, alpha: OutFloats, depth: OutFloats, radii: OutInts, keep: bool,
) -> Frame: ...
def backward(
    frame: Frame, means: Floats, quats: Floats, scales: Floats, opacities: Floats, features: Floats,
    image: Floats, alpha: Floats, depth: Floats, grad_image: Floats | None, grad_alpha: Floats | None,
    grad_depth: Floats | None, to_means: OutFloats, to_quats: OutFloats, to_scales: OutFloats,
    to_opacities: OutFloats, to_features: OutFloats, to_offset: OutFloats | None, offset: Floats | None,
) -> None: ...
def sh_forward(
    degree: int, means: Floats, position: Floats, first: Floats, rest: Floats | None, colors: OutFloats,
) -> None: ...
def sh_backward(
    degree: int, means: Floats, position: Floats, first: Floats, rest: Floats | None, colors: Floats,
    grad: Floats, grad_means: OutFloats, grad_first: OutFloats, grad_rest: OutFloats | None,
) -> None: ...
def photometric(
    x: Floats, y: Floats, absolute: float, structural: float, grad: OutFloats | None,
) -> tuple[float, float]: ...
def view_loss(
    color: Floats, alpha: Floats, truth: Floats, back: Floats, absolute: float, structural: float,
    alpha_weight: float, vanishing: float, rescue: float, grad_color: OutFloats | None,
    grad_alpha: OutFloats | None,
) -> tuple[float, float, float]: ...
def adam(
    params: Sequence[OutFloats], grads: Sequence[Floats], first: Sequence[OutFloats],
    second: Sequence[OutFloats], rates: Sequence[float], beta1: float, beta2: float, eps: float,
    step: int,
) -> None: ...
def decode_begin(
    anchors: Floats, features: Floats, scalings: Floats, offsets: Floats, weights: Sequence[Floats],
    embedding: Floats, palette: Floats, eye: Floats, light: Floats | None, factors: Sequence[float],
    directions: bool, sigmoid_color: bool, opacities: OutFloats, keep: bool,
) -> DecodeFrame: ...
def decode_finish(
    frame: DecodeFrame, anchors: Floats, features: Floats, scalings: Floats, offsets: Floats,
    opacities: Floats, means: OutFloats, quats: OutFloats, scales: OutFloats, opaque: OutFloats,
    colors: OutFloats, slots: OutLongs,
) -> None: ...
def shade(
    means: Floats, normals: Floats, base: Floats, coefficients: Floats, eye: Floats, light: Floats | None,
    colors: OutFloats,
) -> None: ...
def decode_backward(
    frame: DecodeFrame, anchors: Floats, features: Floats, scalings: Floats, offsets: Floats,
    weights: Sequence[Floats], embedding: Floats, opacities: Floats, means: Floats | None,
    quats: Floats | None, scales: Floats | None, opaque: Floats | None, colors: Floats | None,
    to_anchors: OutFloats | None, to_features: OutFloats, to_scalings: OutFloats, to_offsets: OutFloats,
    to_weights: Sequence[OutFloats], to_embedding: OutFloats, to_palette: OutFloats,
) -> None: ...
def visible_anchors(
    pose: Floats, near: float, middle: Floats, anchors: Floats, scalings: Floats, shown: OutBytes,
) -> None: ...
def record_view(
    gradients: OutFloats, draws: OutFloats, opacities: OutFloats, visits: OutFloats, rows: Longs,
    opacity: Floats, slots: Longs, pixels: Floats, radii: Ints, half_width: float, half_height: float,
) -> None: ...
def hash_grid(
    table: Floats, index: Ints, weights: Floats, rows: Longs | None, corners: Sequence[int],
    sizes: Sequence[int], out: OutFloats,
) -> list[int]: ...
def hash_grid_backward(
    table: Floats, index: Ints, weights: Floats, rows: Longs | None, corners: Sequence[int],
    sizes: Sequence[int], grad: Floats, constant: Sequence[float], out: OutFloats,
) -> None: ...
def add_noise(
    values: Floats, noise: Floats, steps: Floats, first: int, groups: int, out: OutFloats,
) -> None: ...
def add_noise_backward(
    grad: Floats, noise: Floats, steps: Floats, first: int, groups: int, to_steps: OutFloats,
) -> None: ...
def count_samples(
    corners: Doubles, cells: Bytes, step: float, origins: Doubles, directions: Doubles, shift: Doubles,
    most: int, counts: OutInts,
) -> None: ...
def place_samples(
    corners: Doubles, cells: Bytes, step: float, origins: Doubles, directions: Doubles, shift: Doubles,
    first: Longs, places: OutFloats, rays: OutInts, numbers: OutInts,
) -> None: ...
def ray_weights(depths: Floats, first: Longs, weights: OutFloats) -> None: ...
def ray_weights_backward(depths: Floats, first: Longs, grad: Floats, to: OutFloats) -> None: ...
def ray_sums(rows: Floats, rays: Ints, sums: OutFloats) -> None: ...
def line_products(
    x: Floats, y: Floats, z: Floats, groups: int, mixing: Floats | None, places: Floats, rays: Ints,
    out: OutFloats,
) -> None: ...
def line_products_backward(
    x: Floats, y: Floats, z: Floats, groups: int, mixing: Floats | None, places: Floats, rays: Ints,
    grad: Floats, to_x: OutFloats, to_y: OutFloats, to_z: OutFloats, to_mixing: OutFloats | None,
) -> None: ...
def march(
    links: Sequence[Ints], densities: Sequence[Floats], rows: Sequence[Floats], bricks: Sequence[Bytes],
    placements: Doubles, step: float, origins: Floats, directions: Floats, near: Floats,
    colors: OutFloats, alpha: OutFloats, keep: bool,
) -> MarchFrame: ...
def march_backward(
    frame: MarchFrame, links: Ints, densities: Floats, rows: Floats, bricks: Bytes, placement: Doubles,
    grad_colors: Floats, grad_alpha: Floats, to_densities: OutFloats, to_rows: OutFloats,
) -> None: ...
def voxel_weights(
    links: Ints, densities: Floats, rows: Floats, bricks: Bytes, placement: Doubles, step: float,
    origins: Floats, directions: Floats, near: Floats, most: OutFloats,
) -> None: ...
def voxel_variation(
    links: Ints, densities: Floats, rows: Floats, begin: int, count: int, factors: Floats, spread: float,
    to_densities: OutFloats, to_rows: OutFloats,
) -> float: ...
def voxel_step(
    densities: OutFloats, rows: OutFloats, grad_densities: OutFloats, grad_rows: OutFloats,
    moment_densities: OutFloats, moment_rows: OutFloats, rates: Floats, beta: float, eps: float,
) -> None: ...
def reference_kernel() -> float: ...
def bench_blend(channels: int) -> float: ...
