"""A corpus of hostile files, made by code: kind -> name -> bytes. None of them may be taken."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from functools import cache
from typing import Any

from tests.tiny_scene import cameras_document, cameras_json

PLY = b"ply\nformat binary_little_endian 1.0\n"
CAMERA = "1 PINHOLE 32 24 30 30 16 12\n"
CENTRAL = b"PK\x01\x02"  # begins a member's entry in a zip's directory


def vertices(count: bytes, properties: bytes = b"property float x\n") -> bytes:
    """A PLY with a count of vertices and no data."""
    return PLY + b"element vertex " + count + b"\n" + properties + b"end_header\n"


@cache
def splats() -> dict[str, bytes]:
    """Bombs for the reader of splats."""
    return {
        "header of 64 MB without a line end": b"ply\n" + b"x" * (64 << 20),
        "list property": vertices(b"1", b"property list int float x\n") + bytes(8),
        "100,000 properties": vertices(b"1", b"".join(b"property float p%d\n" % k for k in range(100_000))),
        "200,000 comments": PLY + b"comment\n" * 200_000 + b"end_header\n",
        "negative count": vertices(b"-1"),
        "count beyond 64 bits": vertices(b"18446744073709551617"),
        "count whose bytes overflow": vertices(b"4611686018427387905"),
        "count of 5,000 digits": vertices(b"9" * 5000),
        "count that is no integer": vertices(b"1e9"),
        "property without a width": vertices(b"1", b"property void x\n"),
        "zip of pictures with a deep description": zipped([("meta.json", b"[" * 100_000)]),
    }


@cache
def cameras() -> dict[str, bytes]:
    """Bombs for the readers of cameras."""
    return camera_documents() | camera_archives()


def camera_documents() -> dict[str, bytes]:
    """Those in JSON."""
    document, frames = cameras_document(), cameras_json()
    first = document["frames"][0]
    return {
        "deep array": b"[" * 100_000,
        "deep object": b'{"a":' * 100_000,
        "deep array that ends": b"[" * 50_000 + b"]" * 50_000,
        "NaN": json.dumps(document | {"fl_x": float("nan")}).encode(),
        "Infinity": json.dumps(document | {"fl_x": float("inf")}).encode(),
        "number beyond every float": frames.replace(b"30.0", b"1e999"),
        "integer of 4,000 digits": frames.replace(b"30.0", b"9" * 4000),
        "integer of 5,000 digits": frames.replace(b"30.0", b"9" * 5000),
        "an image of 10^18 pixels": json.dumps(document | {"w": 10**18}).encode(),
        "negative size": json.dumps(document | {"w": -5}).encode(),
        "half a surrogate pair in a name": frames.replace(b"images/left", b"images/\\ud800left"),
        "zero byte in a name": frames.replace(b"images/left", b"images/\\u0000left"),
        "half a surrogate pair as a key": b'{"\\ud800": 1, "frames": []}',
        "not UTF-8": b'{"a": "\xff\xfe"}',
        "10,000 names in emoji": json.dumps(
            document | {"frames": [first | {"file_path": f"{k}" + "\U0001f600" * 490} for k in range(10_000)]}
        ).encode(),
        "a million numbers": b"[" + b"1," * 1_000_000 + b"1]",
    }


def camera_archives() -> dict[str, bytes]:
    """Those in zips."""
    model = [("sparse/0/cameras.txt", CAMERA.encode()), ("sparse/0/images.txt", b"x" * 1000)]
    count = struct.pack("<Q", 2**63)
    return {
        "zip of 600 MB of zeros": zip_of_zeros(model[0], "sparse/0/images.txt", 600),
        "zip that says too small a size": patched(zipped(model), 24, 10),
        "zip that says too large a size": patched(zipped(model), 24, 0xFFFFFFFE),
        "zip whose members overlap": patched(zipped(model), 42, 0),
        "zip of 110,000 members": zipped([(f"f{k}", b"") for k in range(110_000)]),
        "member whose name no file system takes": zipped([(f"sparse/0/{'x' * 300}.txt", b"x"), *model]),
        "zip in a zip": zipped([("sparse/0/model.zip", zipped(model))]),
        "zip without its end": zipped(model)[:-30],
        "model of 2^63 cameras": zipped([("cameras.bin", count), ("images.bin", count)]),
    }


def zipped(members: list[tuple[str, bytes]]) -> bytes:
    """A zip of deflated members."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, member in members:
            archive.writestr(name, member)
    return content.getvalue()


def zip_of_zeros(first: tuple[str, bytes], name: str, megabytes: int) -> bytes:
    """A zip of a member and so many zeros, made a megabyte at a time."""
    content = io.BytesIO(zipped([first]))
    with zipfile.ZipFile(content, "a", zipfile.ZIP_DEFLATED) as archive, archive.open(name, "w") as zeros:
        for _ in range(megabytes):
            zeros.write(bytes(1 << 20))
    return content.getvalue()


def patched(archive: bytes, place: int, number: int) -> bytes:
    """The zip with another number in the directory entry of its last member."""
    start = archive.rfind(CENTRAL) + place
    return archive[:start] + struct.pack("<I", number) + archive[start + 4 :]


def safetensors(header: bytes, length: int | None = None) -> bytes:
    """A header with its length, or with a lie about it."""
    return struct.pack("<Q", len(header) if length is None else length) + header


def pack(tensors: dict[str, Any], size: int) -> bytes:
    """A file with that header and so many bytes of data."""
    return safetensors(json.dumps(tensors).encode()) + bytes(size)
