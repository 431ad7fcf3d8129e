"""A program of the tests, good or hostile, of the standard library alone."""

import json
import os
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path


def png(path, width, height, depth=8, color=6, pixel=b"\x40\x80\xc0\xff", claim=None):
    """A picture of one color; its header may claim another size."""

    def chunk(kind, data):
        whole = kind + data
        return struct.pack(">I", len(data)) + whole + struct.pack(">I", zlib.crc32(whole))

    head = struct.pack(">2I5B", *(claim or (width, height)), depth, color, 0, 0, 0)
    rows = zlib.compress((b"\0" + pixel * (depth // 8) * width) * height)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b""))


def ply(path, value="0"):
    """One Gaussian at the origin."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 1"]
    lines += [f"property float {name}" for name in names] + ["end_header\n"]
    path.write_bytes(
        "\n".join(lines).encode()
        + struct.pack("<14f", *map(float, [value] * 3), *[0.5] * 4, *[-2] * 3, 1, 0, 0, 0)
    )


DAEMON = """
import os, sys, time
if os.fork(): os._exit(0)
os.setsid()
open(sys.argv[1], "w").write(str(os.getpid()))
time.sleep(600)
"""


def daemon():
    """Leave a process behind that left its session and holds the output open."""
    subprocess.run([sys.executable, "-c", DAEMON, sys.argv[-1]], check=True)
    while not (os.path.exists(sys.argv[-1]) and Path(sys.argv[-1]).read_text()):
        time.sleep(0.01)


def train(how, views, out, iterations, seed):
    """Write a model, or misbehave."""
    assert (views / "transforms_train.json").is_file()
    assert not json.loads((views / "transforms_test.json").read_text())["frames"], "test cameras in training"
    assert sorted(path.name for path in out.parent.iterdir()) == ["out", "views"]
    loss = "nan" if how == "nan" else "0.5"
    for iteration in range(1, iterations + 1):
        print(f"it {iteration} loss {loss}", end="\r" if iteration % 2 else "\n", flush=True)
    if how == "hang":
        child = subprocess.Popen(["sleep", "600"], start_new_session=True)
        Path(sys.argv[-1]).write_text(f"{os.getpid()} {child.pid}")
        time.sleep(600)
    if how == "fail":
        sys.exit("no such kernel\n")
    if how == "memory":
        sys.exit("RuntimeError: CUDA out of memory. Tried to allocate 2 GiB")
    if how == "bomb":
        while True:
            (out / f"{time.time_ns()}").write_bytes(b"x" * 2**20)
    if how == "talk":
        for _ in range(200):
            sys.stdout.write("x" * 2**16)
    if how == "daemon":
        daemon()
    if how != "nothing":
        ply(out / "point_cloud.ply", {"ply-nan": "nan"}.get(how, "0"))
        (out / "deep").mkdir()
        (out / "deep" / "model.bin").write_bytes(bytes([seed % 256]) * (2**20 if how == "large" else 100))
    if how == "link":
        (out / "deep" / "secret.bin").symlink_to("/etc/passwd")
    if how == "linked-folder":
        (out / "deep").rename(out.parent / "elsewhere")
        (out / "deep").symlink_to(out.parent / "elsewhere")
    if how == "pipe":
        os.mkfifo(out / "deep" / "pipe.bin")
    (out / "scratch.tmp").write_bytes(b"no part of the model")


def render(how, model, cameras, pictures):
    """Draw a picture of each camera, or misbehave."""
    found = sorted(path.relative_to(model).as_posix() for path in model.rglob("*") if path.is_file())
    assert found == ["deep/model.bin", "point_cloud.ply"], found
    assert sorted(path.name for path in model.parent.iterdir()) == ["cameras", "model", "pictures"]
    frames = json.loads((cameras / "transforms_test.json").read_text())["frames"]
    for index, frame in enumerate(frames):
        size = frame["w"], frame["h"]
        path = pictures / f"{index}.png"  # not padded: 10 comes after 9
        if how == "half" and index % 2:
            continue
        if how == "size":
            size = size[0] + 1, size[1]
        if how == "text":
            path.write_text("a picture")
            continue
        if how == "link":
            png(model.parent / "other.png", *size)
            path.symlink_to(model.parent / "other.png")
            continue
        if how == "opaque":
            png(path, *size, color=2, pixel=bytes([index, 128, 192]))
        else:
            png(
                path,
                *size,
                16 if how == "sixteen" else 8,
                pixel=bytes([index, 128, 192, 255]),
                claim=(60000, 60000) if how == "claim" else None,
            )
        if how != "silent":
            print(f"drawn in {10 + index} ms")
    if how == "more":
        png(pictures / "99.png", 8, 8)
    if how == "cut":
        (pictures / "0.png").write_bytes((pictures / "0.png").read_bytes()[:60])
    if how == "daemon":
        daemon()
    if how == "hang":
        time.sleep(600)
    if how == "fail":
        sys.exit(3)
    if how == "good":
        time.sleep(0.5)  # its memory is looked at ten times a second, on a busy machine less often


if sys.argv[1] == "train":
    train(sys.argv[2], Path(sys.argv[3]), Path(sys.argv[4]), *map(int, sys.argv[5:7]))
else:
    render(sys.argv[2], *map(Path, sys.argv[3:6]))
