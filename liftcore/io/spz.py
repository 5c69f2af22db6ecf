"""Niantic's ``.spz`` of versions 1 to 4: quantised splats, compressed by gzip or, from version 4 on, by zstd.

One section an attribute: means (three f16 in version 1, then 24-bit fixed point), opacities u8, colours u8, log
scales u8 (v / 16 - 10), quaternions (x y z u8; from version 3 the smallest three parts in 10 bits each, sign and
magnitude, behind two bits for the largest of x y z w) and higher harmonics u8, coefficient by coefficient. To version
3 all is one gzip stream with a header of 16 bytes. Version 4 has a plain header of 32, then extensions, then the
sizes of the sections' zstd streams, then these.

The frame is right, up, back (RUB) unless an extension declares another of 8. PLYs and cameras are in right, down,
front (RDF): axes are turned, and quaternions and harmonics with them. A flag records that the splats were trained
antialiased. The format is of nianticlabs/spz. What is written has version 3, which every reader knows.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidSplats
from liftcore.io.quantised import (
    MOST_GROWTH,
    REST_INDICES,
    Fields,
    GaussianRows,
    decoded,
    gaussian_rows,
    logits,
    smallest_three,
)
from liftcore.scene.harmonics import SH_C0
from liftcore.scene.render_mode import RenderMode, RenderModel

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

MAGIC = b"NGSP"
VERSIONS = (1, 2, 3, 4)
HEADER = "<4sIIBBBB"  # magic, version, count, SH degree, fractional bits, flags; then the number of streams, or zero
HEADER_BYTES = struct.calcsize(HEADER)
STREAMS_HEADER_BYTES = 32  # of version 4, which also has the place of the sizes
MAX_EXTENSION_BYTES = 1 << 16  # that version 3 may have behind the sections
MAX_DEGREE = 4
MAX_FRACTIONAL_BITS = 24
COLOUR_SCALE = 0.15  # of the constant term
FRAME_EXTENSION = 0xADBE0003
# Frames as spz numbers them, by what x, y and z point to: left or right, down or up, back or front.
FRAMES = ("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF")
RUB = FRAMES.index("RUB") + 1
ANTIALIASED, HAS_EXTENSIONS = 0x1, 0x2  # flags
FLAG = "the flag 'antialiased' of the .spz"
WRITTEN_VERSION, WRITTEN_DEGREE = 3, 3  # and the highest degree of harmonics, as of 3DGS
WRITTEN_BITS = 20  # fractional bits of means at most: a millionth of a scene unit
LARGEST_MEAN = (1 << 23) - 1  # of 24 bits with their sign
# Which axes' signs change a harmonic of degree 1 to 4; the last as the library has it that writes these files.
SH_AXES = (
    *("y", "z", "x"),
    *("xy", "yz", "", "xz", ""),
    *("y", "xyz", "y", "z", "x", "z", "x"),
    *("xy", "yz", "xy", "yz", "", "xz", "", "xz", "y"),
)


def begins_like_spz(head: bytes) -> bool:
    """Return True if these first bytes are of the format, of any version."""
    if head[:2] != b"\x1f\x8b":
        return head[:4] == MAGIC
    try:
        return zlib.decompressobj(31).decompress(head, 4) == MAGIC
    except zlib.error:
        return False


def read_spz(path: Path, *, colour: bool) -> Fields:
    """Return the fields of an ``.spz`` file, in the frame of PLYs and cameras."""
    content = path.read_bytes()
    is_plain, unpacking = content[:4] == MAGIC, zlib.decompressobj(31)
    start = content[:STREAMS_HEADER_BYTES] if is_plain else _inflate(unpacking, content, HEADER_BYTES)
    version, count, degree, bits, flags, streams = _header(start)
    if is_plain != (version >= 4):
        raise ValueError(f"gzip for versions 1 to 3 and a plain header for 4, got the other for {version}")
    sizes = _section_bytes(version, count, degree)
    if sum(sizes) > MOST_GROWTH * len(content):
        raise ValueError(f"as many splats as the file's size can be of, got {count} in {len(content)} bytes")
    if is_plain:
        (table,) = struct.unpack_from("<I", start, HEADER_BYTES)
        zone = content[STREAMS_HEADER_BYTES : max(table, STREAMS_HEADER_BYTES)]
        frame, sections = _declared_frame(zone), _streams(content, table, streams, sizes)
    else:
        body = np.frombuffer(_inflate(unpacking, unpacking.unconsumed_tail, sum(sizes)), np.uint8)
        behind = _inflate(unpacking, unpacking.unconsumed_tail, 0)
        frame = _declared_frame(behind) if flags & HAS_EXTENSIONS else RUB
        sections = np.split(body, np.cumsum(sizes)[:-1])
    fields = _decode(sections, version, degree if colour else 0, 2.0**-bits, frame, colour=colour)
    fields["render_mode"] = RenderMode(RenderModel.ANTIALIASED, FLAG) if flags & ANTIALIASED else None
    return fields


def spz_blocks(splats: Splats) -> Iterator[bytes]:
    """Yield the bytes of an ``.spz`` file of any splats (`gaussian_rows`), in blocks, in the format's frame.

    Means have as many fractional bits as their reach leaves, 20 at most. Harmonics above degree 3 are left out.
    """
    reach = float(splats.means.abs().amax())
    bits = int(np.clip(np.floor(np.log2(LARGEST_MEAN / max(reach, 1e-9))), 0, WRITTEN_BITS))
    if bits < 1:
        got = f"one at {reach:.3g}"
        raise InvalidSplats("means", expected=f"centres within {LARGEST_MEAN // 2} of the origin", got=got)
    degree = min(splats.sh_degree or 0, WRITTEN_DEGREE)
    sections: list[list[bytes]] = [[] for _ in range(6)]
    for block in gaussian_rows(splats):
        for section, part in zip(sections, _encode(block, bits, (degree + 1) ** 2 - 1), strict=True):
            section.append(part.tobytes())
    flags = ANTIALIASED if splats.antialiased else 0
    packing = zlib.compressobj(wbits=31)
    header = struct.pack(HEADER, MAGIC, WRITTEN_VERSION, splats.count, degree, bits, flags, 0)
    for part in (header, *(part for section in sections for part in section)):
        yield packing.compress(part)
    yield packing.flush()


def _encode(rows: GaussianRows, bits: int, higher: int) -> tuple[np.ndarray, ...]:
    """Return the sections of some splats, as `_decode` reads those of version 3."""
    means = np.round(rows.means * (1.0, -1.0, -1.0) * 2.0**bits).astype(np.int32)
    with np.errstate(divide="ignore"):
        scales = np.round((np.log(rows.scales.astype(np.float64)) + 10) * 16)
    signs = np.array([np.prod([-1.0 if axis in "yz" else 1.0 for axis in axes]) for axes in SH_AXES[:higher]])
    return (
        means.astype("<i4").view(np.uint8).reshape(-1, 3, 4)[:, :, :3],
        _bytes(np.round(255 * rows.opacities)),
        _bytes(np.round(255 * ((rows.colours - 0.5) / SH_C0 * COLOUR_SCALE + 0.5))),
        _bytes(scales),
        _packed_quats(rows.quats * (1, 1, -1, -1)),
        _bytes(np.round(128 * (rows.sh[:, :higher] * signs[:, None] + 1))) if higher else np.empty(0, np.uint8),
    )


def _bytes(values: np.ndarray) -> np.ndarray:
    return values.clip(0, 255).astype(np.uint8)


def _packed_quats(quats: np.ndarray) -> np.ndarray:
    """Pack unit quaternions [n, 4] w x y z to [n] u32: the largest's index, then the smallest three of x y z w."""
    parts = np.roll(quats, -1, axis=1)
    largest = np.abs(parts).argmax(axis=1)
    largest_part = np.take_along_axis(parts, largest[:, None], axis=1)
    parts = np.where(largest_part < 0, -parts, parts)
    smallest_parts = np.take_along_axis(parts, REST_INDICES[largest], axis=1)
    sizes = np.round(np.abs(smallest_parts) / np.sqrt(0.5) * 511).clip(0, 511).astype(np.uint32)
    words = sizes | np.where(smallest_parts < 0, 512, 0).astype(np.uint32)
    return (largest.astype(np.uint32) << 30 | words[:, 0] << 20 | words[:, 1] << 10 | words[:, 2]).astype("<u4")


def _header(start: bytes) -> tuple[int, int, int, int, int, int]:
    """Version, number of splats, degree of the harmonics, fractional bits of means, flags, number of streams."""
    if len(start) < HEADER_BYTES or (start[4:8] == b"\4\0\0\0" and len(start) < STREAMS_HEADER_BYTES):
        raise ValueError(f"a whole header, got {len(start)} bytes")
    magic, version, count, degree, bits, flags, streams = struct.unpack_from(HEADER, start)
    if magic != MAGIC or version not in VERSIONS:
        got = f"version {version}" if magic == MAGIC else repr(magic)
        raise ValueError(f"an .spz of version 1 to 4, got {got}")
    if degree > MAX_DEGREE or (version > 1 and not 1 <= bits <= MAX_FRACTIONAL_BITS):
        expected = f"harmonics of degree 0..{MAX_DEGREE} and 1..{MAX_FRACTIONAL_BITS} fractional bits"
        raise ValueError(f"{expected}, got {degree} and {bits}")
    if count == 0:
        raise ValueError("at least one splat, got an empty scene")
    return version, count, degree, bits, flags, streams


def _section_bytes(version: int, count: int, degree: int) -> list[int]:
    """Return the bytes of means, opacities, colours, log scales, quaternions and harmonics."""
    higher = (degree + 1) ** 2 - 1
    return [count * size for size in (6 if version == 1 else 9, 1, 3, 3, 4 if version >= 3 else 3, 3 * higher)]


def _inflate(unpacking: zlib._Decompress, content: bytes, size: int) -> bytes:
    """Return the next ``size`` bytes of a gzip stream; with 0 the rest, up to its checksum."""
    try:
        block = unpacking.decompress(content, size or MAX_EXTENSION_BYTES)
    except zlib.error as error:
        raise ValueError(f"a whole gzip stream, got {error}") from None
    if len(block) < size:
        raise ValueError(f"{size} bytes in the gzip stream, got {len(block)}")
    return block


def _streams(content: bytes, table: int, streams: int, sizes: list[int]) -> list[np.ndarray]:
    """Return the sections of version 4, each u8; those of no bytes have no stream."""
    import zstandard

    stream_sizes = [size for size in sizes if size]
    offset = table + 16 * streams
    if streams != len(stream_sizes) or table < STREAMS_HEADER_BYTES or offset > len(content):
        raise ValueError(f"{len(stream_sizes)} streams whose sizes lie in the file, got {streams} at {table}")
    sections = []
    for place, size in enumerate(stream_sizes):
        packed, announced_size = struct.unpack_from("<QQ", content, table + 16 * place)
        if announced_size != size or offset + packed > len(content):
            got = f"{announced_size} in {packed} of {len(content) - offset} left"
            raise ValueError(f"a stream of {size} bytes, got {got}")
        stream = content[offset : offset + packed]
        try:
            section = zstandard.ZstdDecompressor().stream_reader(stream).read(size + 1)  # a bomb stays small
        except zstandard.ZstdError as error:
            raise ValueError(f"a whole zstd stream, got {error}") from None
        if len(section) != size:
            raise ValueError(f"a stream of {size} bytes, got one of another size")
        sections.append(np.frombuffer(section, np.uint8))
        offset += packed
    return sections + [np.empty(0, np.uint8)] * (len(sizes) - len(stream_sizes))


def _declared_frame(extensions: bytes) -> int:
    """Return the frame that one of these extensions declares; RUB if none does."""
    at = 0
    while at + 8 <= len(extensions):
        kind, size = struct.unpack_from("<II", extensions, at)
        payload = extensions[at + 8 : at + 8 + size]
        if kind == FRAME_EXTENSION and len(payload) == 4:
            (frame,) = struct.unpack("<I", payload)
            if frame > len(FRAMES):
                raise ValueError(f"one of the {len(FRAMES)} frames of the format, got frame {frame}")
            return frame or RUB
        at += 8 + size
    return RUB


def _decode(
    sections: list[np.ndarray], version: int, degree: int, step: float, frame: int, *, colour: bool
) -> Fields:
    means, opacities, colours, scales, quats, harmonics = sections
    count, higher = len(opacities), (degree + 1) ** 2 - 1
    # 1 where an axis points right, down or to the front, as those of PLYs and cameras
    x, y, z = flips = np.array([1.0 if letter in "RDF" else -1.0 for letter in FRAMES[frame - 1]])
    signs = {"x": x, "y": y, "z": z}
    sh_signs = np.array([np.prod([signs[axis] for axis in axes]) for axes in SH_AXES[:higher]])
    stored = harmonics.reshape(count, -1, 3)

    def decode(rows: slice) -> Fields:
        if version == 1:
            places = means.view("<f2").reshape(count, 3)[rows].astype(np.float64)
        else:
            low, middle, high = (means.reshape(count, 3, 3)[rows, :, i].astype(np.int32) for i in range(3))
            places = (low | middle << 8 | high << 16).astype(np.float64)
            places = np.where(places >= 1 << 23, places - (1 << 24), places) * step
        places, rotations = places * flips, _quats(quats.reshape(count, -1)[rows]) * (1, y * z, x * z, x * y)
        fields = {
            "means": places,
            "log_scales": scales.reshape(count, 3)[rows] / 16.0 - 10,
            "quats": rotations,
            "opacity_logits": logits(opacities[rows] / 255.0),
        }
        if colour:
            fields["sh"] = np.empty((len(places), 1 + higher, 3))
            fields["sh"][:, 0] = (colours.reshape(count, 3)[rows] / 255.0 - 0.5) / COLOUR_SCALE
            if higher:
                fields["sh"][:, 1:] = (stored[rows] / 128.0 - 1) * sh_signs[:, None]
        return fields

    return decoded(count, decode)


def _quats(stored: np.ndarray) -> np.ndarray:
    """Decode quaternions [n, 4] w x y z, of x y z [n, 3] u8 or of the smallest three of x y z w [n, 4] u8."""
    if stored.shape[1] == 3:
        parts = stored / 127.5 - 1
        return np.column_stack([np.sqrt(np.maximum(0.0, 1 - (parts**2).sum(axis=1))), parts])
    packed = np.ascontiguousarray(stored).view("<u4")[:, 0]
    parts = np.stack([packed >> 20, packed >> 10, packed], axis=1) & 1023
    values = (parts & 511) / 511 * np.sqrt(0.5) * np.where(parts & 512, -1, 1)
    return np.roll(smallest_three(values, (packed >> 30).astype(np.int64)), 1, axis=1)
