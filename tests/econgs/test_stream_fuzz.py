"""Damaged, truncated, foreign and hostile streams: a named error, little memory, never a wrong picture."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.codec.container import Kind, Section, overhead, read_container, write_container
from econgs_bench.econgs.codec.stream import decode_group, encode_group
from tests.econgs.streams import group, with_masks

DATA = encode_group(with_masks(group((30, 12)))).data
SECTIONS = read_container(DATA, "test")
RAW = encode_group(group((5,)).__class__(**{**vars(group((5,))), "context": None})).data
SLOW = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])


def ends() -> list[int]:
    """Offsets at which header, table and sections end."""
    places = [0, 1, 7, 8, 10, 12, 20, overhead(len(SECTIONS)) - 4, overhead(len(SECTIONS))]
    for one in SECTIONS:
        places.append(places[-1] + len(one.payload))
    return places


def test_truncation_at_every_section() -> None:
    assert ends()[-1] == len(DATA)
    for end in ends()[:-1]:
        for cut in {end, max(end - 1, 0), end + 1} - {len(DATA)}:
            with pytest.raises(DataError, match=r"clip\.econgs: "):
                decode_group(DATA[:cut], "clip.econgs")


@SLOW
@given(st.integers(0, len(DATA) - 1))
def test_truncation_anywhere(cut: int) -> None:
    with pytest.raises(DataError):
        decode_group(DATA[:cut])


@settings(SLOW, max_examples=200)
@given(st.integers(0, 8 * len(DATA) - 1))
def test_every_flipped_bit_is_noticed(bit: int) -> None:
    broken = bytearray(DATA)
    broken[bit // 8] ^= 1 << bit % 8
    with pytest.raises(DataError):
        decode_group(bytes(broken))


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (DATA + b"\0", "followed by something else"),
        (b"", "ends after 0 bytes"),
        (b"\x89PNG\r\n\x1a\n" + bytes(50), "not a stream of this program"),
        (b"ply\nformat ascii 1.0\n", "not a stream of this program"),
        (bytes(500), "not a stream of this program"),
    ],
    ids=["longer", "empty", "png", "ply", "zeros"],
)
def test_foreign_files(data: bytes, reason: str) -> None:
    with pytest.raises(DataError, match=reason):
        decode_group(data)


def test_other_versions() -> None:
    for version in (0, 5, 65535):
        other = bytearray(DATA)
        struct.pack_into("<H", other, 8, version)
        with pytest.raises(DataError, match=f"format version {version}; this program reads versions 1 to 4"):
            decode_group(bytes(other))


def with_section(kind: Kind, payload: bytes, scene: int = 0) -> bytes:
    """The stream with another payload of one section, checksums right."""
    return write_container(
        [Section(s.kind, s.scene, payload) if (s.kind, s.scene) == (kind, scene) else s for s in SECTIONS]
    )


def resealed(head: bytearray) -> bytes:
    """A changed table with its checksum made right."""
    start = overhead(len(SECTIONS))
    struct.pack_into("<I", head, start - 4, zlib.crc32(bytes(head[: start - 4])))
    return bytes(head)


def refused(data: bytes, most: int = 8 << 20) -> DataError:
    """The error that a stream gives; its making takes little memory."""
    tracemalloc.start()
    try:
        with pytest.raises(DataError) as caught:
            decode_group(data, "bad.econgs")
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < most
    assert str(caught.value).startswith("bad.econgs: ")
    return caught.value


def test_absurd_lengths() -> None:
    for index in range(len(SECTIONS)):
        for length in (0, 2**31, 2**32 - 1):
            head = bytearray(DATA)
            struct.pack_into("<I", head, 20 + 12 * index + 4, length)
            refused(resealed(head))
    head = bytearray(DATA)
    struct.pack_into("<H", head, 10, 65535)
    refused(bytes(head))
    head = bytearray(DATA)
    struct.pack_into("<Q", head, 12, 2**63)
    assert "announced" in str(refused(resealed(head)))


def payload(kind: Kind, scene: int = 0) -> bytes:
    (payload,) = [one.payload for one in SECTIONS if (one.kind, one.scene) == (kind, scene)]
    return payload


def test_absurd_counts_with_right_checksums() -> None:
    name = payload(Kind.SCENE)[:7]  # 4 bytes of length, "TF0"
    rest = payload(Kind.SCENE)[15:]
    assert name == b"\x03\0\0\0TF0"
    for anchors, length in ((2**32 - 1, 100), (30, 2**32 - 1), (10_000, 0), (29, 10)):
        refused(with_section(Kind.SCENE, name + struct.pack("<2I", anchors, length) + rest))
    refused(with_section(Kind.SCENE, struct.pack("<I", 2**32 - 1) + b"TF0"))
    for place, value in ((0, 65535), (1, 65535), (2, 65535), (3, 7), (4, 0)):
        sizes = bytearray(payload(Kind.GROUP))
        struct.pack_into("<H", sizes, 2 * place, value)
        refused(with_section(Kind.GROUP, bytes(sizes)))
    for place, value in ((2, 65535), (3, 65535), (4, 300), (5, 60), (6, 60), (7, 65535), (8, 1), (8, 65535)):
        sizes = bytearray(payload(Kind.CONTEXT))
        struct.pack_into("<H", sizes, 2 * place, value)
        refused(with_section(Kind.CONTEXT, bytes(sizes)))
    huge = struct.pack("<H", 1) + struct.pack("<BBB", 1, 0, 4) + b"w" + struct.pack("<4I", *[2**32 - 1] * 4)
    refused(with_section(Kind.DECODERS, huge))
    refused(with_section(Kind.DECODERS, struct.pack("<H", 65535)))
    deep = b"[" * 200_000
    head = payload(Kind.GROUP)
    start = 14 + 48
    refused(with_section(Kind.GROUP, head[:start] + struct.pack("<I", len(deep)) + deep))


@pytest.mark.parametrize("kind", list(Kind))
def test_sections_missing_doubled_or_not_asked_for(kind: Kind) -> None:
    others = [one for one in SECTIONS if (one.kind, one.scene) != (kind, 0)]
    assert len(others) == len(SECTIONS) - 1
    refused(write_container(others))
    (one,) = [one for one in SECTIONS if (one.kind, one.scene) == (kind, 0)]
    refused(write_container([*SECTIONS, one]))
    assert "belong to nothing" in str(refused(write_container([*SECTIONS, Section(kind, 77, b"")])))


@settings(SLOW, max_examples=150)
@given(st.sampled_from(SECTIONS), st.binary(max_size=300), st.integers(0, 400))
def test_hostile_sections_with_right_checksums(section: Section, noise: bytes, at: int) -> None:
    """Any bytes anywhere in a section: an error of ours, or a group whose numbers are finite."""
    at = min(at, len(section.payload))
    changed = section.payload[:at] + noise + section.payload[at + len(noise) :]
    finite_or_refused(with_section(section.kind, changed, section.scene))


@settings(SLOW, max_examples=100)
@given(st.sampled_from(SECTIONS), st.integers(0, 10**6), st.integers(1, 255))
def test_one_hostile_byte(section: Section, at: int, flip: int) -> None:
    if not section.payload:
        return
    changed = bytearray(section.payload)
    changed[at % len(changed)] ^= flip
    finite_or_refused(with_section(section.kind, bytes(changed), section.scene))


def finite_or_refused(data: bytes) -> None:
    try:
        decoded: Any = decode_group(data)
    except DataError:
        return
    for scene in decoded.scenes:
        for array in (scene.positions, scene.features, scene.scalings, scene.offsets):
            assert np.isfinite(array).all()


def test_plain_attributes_of_wrong_length() -> None:
    sections = read_container(RAW, "raw")
    for index, one in enumerate(sections):
        if one.kind in (Kind.FEATURES, Kind.SCALINGS, Kind.OFFSETS):
            for changed in (
                one.payload[:-1],
                one.payload + b"\0\0\0\0",
                one.payload[:-4] + b"\xff\xff\xff\x7f",
            ):
                other = [*sections[:index], Section(one.kind, one.scene, changed), *sections[index + 1 :]]
                refused(write_container(other))


def test_too_much_for_a_container() -> None:
    with pytest.raises(ValueError, match="at most"):
        write_container([Section(Kind.SCENE, i, b"") for i in range(5000)])


def test_plain_positions_that_are_none() -> None:
    plain = read_container(encode_group(replace(group((30,)), plain_positions=True)).data, "plain")
    (scene,) = [one for one in plain if one.kind == Kind.SCENE]
    (whole,) = [
        np.frombuffer(one.payload, "<f4").reshape(30, 3) for one in plain if one.kind == Kind.POSITIONS
    ]

    def with_first(value: float) -> bytes:
        changed = whole.copy()
        changed[0, 0] = value
        return changed.tobytes()

    for payload, reason in (
        (whole[:-1].tobytes(), "30 positions were announced"),
        (with_first(np.nan), "not finite"),
        (with_first(whole[0, 0] + 1e-5), "off its grid"),
        (with_first(1e30), "off its grid"),
        (whole[::-1].tobytes(), "out of order"),
    ):
        header = scene.payload[:11] + struct.pack("<I", len(payload)) + scene.payload[15:]
        new = {Kind.SCENE: header, Kind.POSITIONS: payload}
        changed = [Section(one.kind, one.scene, new.get(one.kind, one.payload)) for one in plain]
        assert reason in str(refused(write_container(changed)))
