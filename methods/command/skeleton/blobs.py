"""Isotropic Gaussians as a PLY of 3DGS, and their picture as a product of matrices; imports numpy alone."""

import numpy as np

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
NAMES += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
DC = 0.28209479177387814  # of the constant spherical harmonic


def save(path, points, sigma, depth, colors):
    """Write (n, 3) points of one size, optical depths (n,) and colors (n, 3)."""
    opacity = np.clip(-np.expm1(-depth), 1e-6, 0.99)
    rows = np.zeros((len(points), len(NAMES)), "<f4")
    rows[:, :3], rows[:, 3:6], rows[:, 6] = points, (colors - 0.5) / DC, np.log(opacity / (1 - opacity))
    rows[:, 7:10], rows[:, 10] = np.log(sigma), 1.0
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    head += [f"property float {name}" for name in NAMES]
    with open(path, "wb") as file:
        file.write(("\n".join([*head, "end_header"]) + "\n").encode() + rows.tobytes())


def load(path):
    """Read what :func:`save` wrote."""
    with open(path, "rb") as file:
        while file.readline().strip() != b"end_header":
            pass
        rows = np.frombuffer(file.read(), "<f4").reshape(-1, len(NAMES)).astype(np.float64)
    return rows[:, :3], np.exp(rows[0, 7]), np.log1p(np.exp(rows[:, 6])), rows[:, 3:6] * DC + 0.5


def footprints(points, sigma, frame):
    """Values of each blob along the rows (height, n) and the columns (width, n) of a picture."""
    pose = np.array(frame["transform_matrix"])
    x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T  # looking along -z, +y up
    spread = frame["fl_x"] * sigma / -z
    spread = np.hypot(spread, 0.5)  # a pixel is an area
    u, v = frame["cx"] - frame["fl_x"] * x / z, frame["cy"] + frame["fl_y"] * y / z
    columns, rows = np.arange(frame["w"]) + 0.5, np.arange(frame["h"]) + 0.5
    return [np.exp(-0.5 * ((a[:, None] - b) / spread) ** 2) for a, b in ((rows, v), (columns, u))]


def picture(depth, colors, rows, columns):
    """Optical depth (height, width) and mean colors (height, width, 3) of blobs, in any order."""
    total = (rows * depth) @ columns.T
    mean = [(rows * (depth * channel)) @ columns.T / (total + 1e-9) for channel in colors.T]
    return total, np.stack(mean, axis=-1)
