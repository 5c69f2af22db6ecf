"""A corpus of hostile files, made by code: kind -> name -> bytes. None of them may be taken."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
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


def features() -> dict[str, bytes]:
    """Bombs for the reader of feature packs."""
    deep = b'{"a":' * 100_000
    grid = '"v/grid":{"dtype":"F32","shape":[1,1,2],"data_offsets":[0,8]}'
    shape = b"{'descr': '<f8', 'fortran_order': False, 'shape': (500000000000,), }"
    return {
        "header of 2^63 bytes": safetensors(b"{}", 2**63),
        "header beyond the end": safetensors(b"{}", 1000),
        "header beyond its limit": safetensors(b"{", 33 << 20),
        "overlapping offsets": pack({"v/grid": tensor([1, 1, 2], 0, 8), "w/grid": tensor([1, 1, 2], 4, 12)}, 12),
        "offsets beyond the end": pack({"v/grid": tensor([1000, 1000, 1000], 0, 4 * 10**9)}, 8),
        "offsets backwards": pack({"v/grid": tensor([1, 1, 2], 8, 0)}, 8),
        "shape beyond 64 bits": pack({"v/grid": tensor([2**40, 2**40, 2], 0, 8)}, 8),
        "shape that wraps to nothing": pack({"v/grid": tensor([2**63, 2, 2], 0, 0)}, 0),
        "negative shape": pack({"v/grid": tensor([-1, -1, 2], 0, 8)}, 8),
        "no channels": pack({"v/grid": tensor([1, 1, 0], 0, 0)}, 0),
        "a tensor twice": safetensors(f"{{{grid},{grid}}}".encode()) + bytes(8),
        "metadata twice": safetensors(f'{{"__metadata__":{{"a":"1","a":"2"}},{grid}}}'.encode()) + bytes(8),
        "half a surrogate pair in a name": safetensors(f"{{{grid}}}".replace("v/", "\\ud800/").encode()) + bytes(8),
        "deep header": safetensors(deep),
        "deep metadata": safetensors(b'{"__metadata__":' + deep),
        "npy that asks for 3.64 TiB": b"\x93NUMPY\x01\x00v\x00" + shape.ljust(117) + b"\n",
        "pickle": b"\x80\x04\x95" + bytes(100),
        "zip": zipped([("v.npy", b"x")]),
    }


def masks() -> dict[str, bytes]:
    """Bombs for the reader of masks: those of packs, which hold none, and some of its own."""
    fractions = {"v/mask": {**tensor([2, 3], 0, 24), "dtype": "F32"}}
    below = {"v/mask": {**tensor([1, 1], 0, 2), "dtype": "I16"}}
    return features() | {
        "fractions": pack(fractions, 24),
        "a number below that of no class": safetensors(json.dumps(below).encode()) + struct.pack("<h", -2),
        "no masks": pack({"v": {**tensor([2, 3], 0, 12), "dtype": "I16"}}, 12),
        "no sides": pack({"v/mask": tensor([], 0, 4)}, 4),
        "an empty side": pack({"v/mask": tensor([10**9, 0], 0, 0)}, 0),
        "100,000 sides": pack({"v/mask": tensor([1] * 100_000, 0, 4)}, 4),
    }


def table() -> dict[str, bytes]:
    """Bombs for the reader of text tables, likewise."""
    row = {"embeddings": tensor([1, 1], 0, 4)}
    two_tensors = {
        "embeddings": tensor([1, 1], 0, 4),
        "v/mask": tensor([1, 1], 4, 8),
        "__metadata__": {"words": '["a"]'},
    }
    headers_with_words = {name: {**row, "__metadata__": {"words": words}} for name, words in WORDS.items()}
    return (
        features()
        | {
            name: safetensors(json.dumps(header).encode()) + struct.pack("<f", 1)
            for name, header in headers_with_words.items()
        }
        | {
            "no words": pack(row, 4),
            "zeros": pack({**row, "__metadata__": {"words": '["apple"]'}}, 4),
            "a word of a megabyte": safetensors(
                json.dumps(row | {"__metadata__": {"words": json.dumps(["x" * 10**6])}}).encode()
            )
            + struct.pack("<f", 1),
            "masks too": safetensors(json.dumps(two_tensors).encode()) + struct.pack("<ff", 1, 1),
            "a long word without a direction": pack({**row, "__metadata__": {"words": json.dumps(["x" * 10**6])}}, 4),
            "100,000 sides": pack(
                {"embeddings": tensor([1] * 100_000, 0, 4), "__metadata__": {"words": '["apple"]'}}, 4
            ),
        }
    )


WORDS = {
    "deep words": "[" * 100_000,
    "a word that is a number of 5,000 digits": "[" + "9" * 5000 + "]",
    "half a surrogate pair as a word": '["\\ud800"]',
    "words in an object": '{"apple": 0}',
    "a word that is none": "[null]",
}


def photos() -> dict[str, bytes]:
    """Zips of photos that are none, too many, or larger than they look."""

    def png(side: int) -> bytes:
        head = b"IHDR" + struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
        return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))

    return {
        "no zip": b"photos",
        "nothing": zipped([]),
        "no photo": zipped([("notes.txt", b"x")]),
        "zeros": zip_of_zeros(("a.png", png(2)), "b.jpg", 200),
        "many": zipped([(f"{number}.jpg", b"") for number in range(10_001)]),
        "sides": zipped([("a.png", png(1_000_000))]),
        "names of 9 MB": zipped([(f"{number}{'x' * 60_000}.png", b"") for number in range(150)]),
        "another format": zipped([("a.jpg", png(2))]),
        "cut": zipped([("a.png", png(2))])[:-9],
        "a name of two lines": zipped([("a\n.png", png(2))]),
    }


CORPUS = {
    "splats": splats, "cameras": cameras, "features": features, "masks": masks, "table": table, "photos": photos
}  # fmt: skip


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


def tensor(shape: list[int], first: int, last: int) -> dict[str, Any]:
    """Return the entry of a tensor in a header."""
    return {"dtype": "F32", "shape": shape, "data_offsets": [first, last]}


def pack(tensors: dict[str, Any], size: int) -> bytes:
    """A file with that header and so many bytes of data."""
    return safetensors(json.dumps(tensors).encode()) + bytes(size)
