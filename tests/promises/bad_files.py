"""Files that no reader takes: one table of kind, name, content and a word of the message. Data and builders alone.

``BAD_FILES`` has single files, which readers, the command line and uploads all refuse. ``BAD_FOLDERS`` has what only
a folder can be: models of several files, folders of masks. Bombs are small files that say, or
unpack to, large ones: they are refused without the memory.
"""

from __future__ import annotations

import io
import json
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from safetensors.numpy import save

from tests.tiny_scene import PROPERTIES, cameras_document, cameras_json, ply, splat_rows

SPLATS = Path(__file__).parents[1] / "data" / "splats"
Content = bytes | Callable[[], bytes]


@dataclass(frozen=True)
class BadFile:
    """A file of a kind: splats, cameras, features, masks, table, photos or lift."""

    kind: str
    name: str
    content: Content
    word: str  # in the message
    bomb: bool = False

    def data(self) -> bytes:
        """Return its bytes."""
        return self.content if isinstance(self.content, bytes) else self.content()


@dataclass(frozen=True)
class BadFolder:
    """Files of a folder that a reader refuses: cameras, masks (of `pack_folder`), arrays or a lift."""

    kind: str
    name: str
    files: dict[str, bytes]
    word: str


def zipped(members: dict[str, bytes]) -> bytes:
    """Return a zip of deflated members."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return content.getvalue()


def zip_of_zeros(first: tuple[str, bytes], name: str, megabytes: int) -> bytes:
    """Return a zip of a member and so many zeros, made a megabyte at a time."""
    content = io.BytesIO(zipped(dict([first])))
    with zipfile.ZipFile(content, "a", zipfile.ZIP_DEFLATED) as archive, archive.open(name, "w") as zeros:
        for _ in range(megabytes):
            zeros.write(bytes(1 << 20))
    return content.getvalue()


def patched(archive: bytes, place: int, number: int) -> bytes:
    """Return the zip with another number in the directory entry of its last member."""
    start = archive.rfind(b"PK\x01\x02") + place
    return archive[:start] + struct.pack("<I", number) + archive[start + 4 :]


def safetensors(header: bytes, length: int | None = None) -> bytes:
    """Return a header with its length, or with a lie about it."""
    return struct.pack("<Q", len(header) if length is None else length) + header


def tensor(shape: list[int], first: int, last: int, dtype: str = "F32") -> dict[str, Any]:
    """Return the entry of a tensor in a header."""
    return {"dtype": dtype, "shape": shape, "data_offsets": [first, last]}


def tensors(size: int, **entries: Any) -> bytes:
    """Return a file with those entries, ``__`` for a slash, and so many bytes of data."""
    header = {name if name == "__metadata__" else name.replace("__", "/"): entry for name, entry in entries.items()}
    return safetensors(json.dumps(header).encode()) + bytes(size)


def npy(values: np.ndarray) -> bytes:
    """Return the bytes of numpy.save."""
    content = io.BytesIO()
    np.save(content, values, allow_pickle=True)
    return content.getvalue()


def checkpoint(content: Any) -> Callable[[], bytes]:
    """Return a builder of what torch.save writes."""

    def build() -> bytes:
        torch.save(content, buffer := io.BytesIO())
        return buffer.getvalue()

    return build


class Intruder:
    """Code in a pickle, which marks that it ran."""

    ran = False

    def __reduce__(self) -> tuple[Any, ...]:
        return setattr, (Intruder, "ran", True)


HEADER = b"ply\nformat binary_little_endian 1.0\n"
ROWS = splat_rows()[:5]
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n"
PICKLE = pickle.dumps(Intruder())


def head(*lines: str) -> bytes:
    """Return a PLY header without rows."""
    return HEADER + "\n".join([*lines, "end_header\n"]).encode()


def with_values(name: str, values: float) -> bytes:
    rows = ROWS.copy()
    rows[:, PROPERTIES.index(name)] = values
    return ply(rows)


def without(name: str) -> bytes:
    keep = [k for k, column in enumerate(PROPERTIES) if column != name]
    return ply(ROWS[:, keep], [PROPERTIES[k] for k in keep])


def with_columns(*names: str) -> bytes:
    return ply(np.hstack([ROWS, np.zeros((5, len(names)), np.float32)]), [*PROPERTIES, *names])


def sample(name: str) -> bytes:
    return (SPLATS / name).read_bytes()


def sog_with(name: str, change: Callable[[dict[str, Any]], object]) -> bytes:
    """Return a SOG of the samples whose description was changed."""
    with zipfile.ZipFile(SPLATS / name) as archive:
        members = {member: archive.read(member) for member in archive.namelist()}
    meta = json.loads(members["meta.json"])
    change(meta)
    return zipped(members | {"meta.json": json.dumps(meta).encode()})


def sog(part: str, key: str, value: Any) -> Callable[[], bytes]:
    """Return a builder of a SOG whose description has another value."""
    return lambda: sog_with("degree3.sog", lambda meta: (meta[part] if part else meta).update({key: value}))


def glb_parts(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the document and the buffer of a .glb."""
    (length,) = struct.unpack_from("<I", content, 12)
    return json.loads(content[20 : 20 + length]), content[28 + length :]


def glb_of(document: dict[str, Any], binary: bytes) -> bytes:
    """Return a .glb of a document and a buffer."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary)) + struct.pack("<I4s", len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def glb(place: str, value: Any) -> Callable[[], bytes]:
    """Return a builder of a .glb whose document has another value at a place, such as ``accessors/0/count``."""

    def build() -> bytes:
        document, binary = glb_parts(sample("degree3.glb"))
        node: Any = document
        *way, last = place.split("/")
        for step in way:
            node = node[int(step) if step.isdecimal() else step]
        node[last] = value
        return glb_of(document, binary)

    return build


def spz(version: int, count: int) -> bytes:
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, 0, 12, 0, 0) + bytes(1000)


def sog_of_zeros() -> bytes:
    part = {"files": ["zeros.webp", "zeros.webp"], "mins": [0] * 3, "maxs": [1] * 3}
    meta = {"version": 2, "count": 4, "means": part}
    return zipped({"meta.json": json.dumps(meta).encode(), "zeros.webp": bytes(10_000_000)})


def compressed(old: bytes, new: bytes) -> Callable[[], bytes]:
    def build() -> bytes:
        header, end, body = sample("degree3.compressed.ply").partition(b"end_header\n")
        return header.replace(old, new) + end + body

    return build


SH_HALF = "meshes/0/primitives/0/attributes/KHR_gaussian_splatting:SH_DEGREE_2_COEF_1"
SPLAT_FILES = [
    ("empty", b"", "empty file"),
    ("zeros", bytes(4000), "expected splats"),
    ("truncated", ply(ROWS)[:-1], "truncated"),
    ("rows longer than their properties", ply(ROWS) + b"\1" * 20, "longer"),
    ("empty scene", ply(ROWS[:0]), "empty scene"),
    ("long header", head("element vertex 1", *["comment"] * 5000) + bytes(8), "4096 header lines"),
    ("big-endian", b"ply\nformat binary_big_endian 1.0\nend_header\n", "binary_little_endian"),
    ("list property", head("element vertex 1", "property list uchar int a") + bytes(8), "scalar"),
    ("count of 5,000 digits", head("element vertex " + "9" * 5000), "zero or more"),
    ("count whose bytes overflow", head("element vertex 4611686018427387905", "property float x"), "zero or more"),
    ("no element", head(), "without one"),
    ("property without a width", head("element vertex 1", "property void x"), "parse"),
    ("property twice", head("element vertex 1", "property float x", "property float x"), "same name"),
    ("other element first", head("element camera 1", "property float x"), "'vertex'"),
    ("foreign characters", HEADER + b"element vertex 1\nproperty float \xff\nend_header\n", "ASCII"),
    ("no opacity", without("opacity"), "'opacity'"),
    ("point cloud", ply(ROWS[:, :3], list("xyz")), "point cloud"),
    ("of CloudCompare", ply(ROWS, ["x", "y", "z", *(f"scalar_{n}" for n in PROPERTIES[3:])]), "CloudCompare"),
    ("anchors", with_columns("f_offset_0"), "Scaffold-GS"),
    ("odd number of harmonics", with_columns("f_rest_0"), "f_rest"),
    ("gap in harmonics", with_columns("f_rest_1"), "f_rest_0"),
    ("NaN everywhere", with_values("rot_3", np.nan), "finite"),
    ("Git LFS", POINTER, "git lfs pull"),
    ("pickle", PICKLE, "pickle"),
    ("a pickle of code", checkpoint({"splats": {"means": Intruder()}}), "more than tensors"),
    ("another checkpoint", checkpoint({"model": {"weight": torch.zeros(2)}}), "'model'"),
    ("checkpoint without turns", checkpoint({"splats": {"means": torch.zeros(2, 3)}}), "quats"),
    ("checkpoint of integers", checkpoint({"splats": {"means": torch.zeros(2, 3, dtype=torch.int32)}}), "floats"),
    ("spz of version 9", b"NGSP\x09\0\0\0" + bytes(40), "version 9"),
    ("spz cut", sample("degree3.v4.spz")[:-40], "truncated"),
    ("compressed PLY without bounds", compressed(b"float min_x", b"float mon_x"), "min_x"),
    ("SOG of version 1", sog("", "version", 1), "version 2"),
    ("SOG of more splats than pixels", sog("", "count", 400), "400"),
    ("SOG without places", sog("", "means", None), "'means'"),
    ("SOG of NaN", sog("means", "mins", [float("nan")] * 3), "finite"),
    ("SOG that leads elsewhere", sog("means", "files", ["../x", "y"]), "'../x'"),
    ("SOG of a short palette", sog("scales", "codebook", [0.0] * 255), "256"),
    ("SOG of labels beyond", sog("shN", "count", 1), "labels"),
    ("glb that leads elsewhere", glb("buffers/0/uri", "../../etc/passwd"), "within the file"),
    ("glb of a circle", glb("nodes", [{"mesh": 0, "children": [0]}]), "node twice"),
    ("glb mirrored", glb("nodes/0/scale", [-1, 1, 1]), "reflection"),
    ("glb stretched", glb("nodes/0/scale", [1, 2, 1]), "rotation"),
    ("glb beyond its end", glb("bufferViews/0/byteOffset", 1 << 40), "in the file"),
    ("glb of other counts", glb("accessors/4/count", 39), "rows"),
    ("glb of half a degree", glb(SH_HALF, None), "DEGREE_2_COEF_1"),
    ("glb of other extensions", glb("extensionsRequired", ["EXT_meshopt_compression"]), "EXT_meshopt_compression"),
]
SPLAT_BOMBS = [
    ("header of 64 MB", lambda: b"ply\n" + b"x" * (64 << 20), "end_header"),
    ("spz 3 of 2^30 splats", lambda: zlib.compress(spz(3, 1 << 30), wbits=31), "1073741824"),
    ("SOG of 2^40 splats", zipped({"meta.json": b'{"version": 2, "count": 1099511627776}'}), "1099511627776"),
    ("SOG of zeros", sog_of_zeros, "bytes"),
    ("SOG of a deep description", zipped({"meta.json": b"[" * 100_000}), "meta.json"),
    ("compressed PLY of 10^11 splats", compressed(b"element vertex 40", b"element vertex 99999999999"), "bytes"),
    ("glb of 2^30 splats", glb("accessors/0/count", 1 << 30), "splats"),
    (
        "checkpoint of a stretched number",
        checkpoint({"splats": {"means": torch.zeros(1).expand(1 << 30, 3)}}),
        "stored",
    ),
]


def with_camera(**values: Any) -> bytes:
    """Return transforms.json with other values; None takes a key away."""
    document = cameras_document() | values
    return json.dumps({name: value for name, value in document.items() if value is not None}).encode()


def with_pose(matrix: Any) -> bytes:
    return with_camera(frames=[{"file_path": "a.png", "transform_matrix": matrix}])


EYE = np.eye(4).tolist()
TWICE = cameras_document()["frames"][:1] * 2
MODEL = {
    "cameras.txt": b"1 PINHOLE 64 48 50 50 32 24\n",
    "images.txt": b"1 1 0 0 0 0 0 1 1 a.png\n\n2 1 0 0 0 0 0 1 1 b.png\n1 2 -1\n",
}
TWO_DISKS = struct.pack("<4sLQL", b"PK\6\7", 0, 0, 2)  # before the end record of a zip
IN_ZIP = {f"sparse/0/{name}": content for name, content in MODEL.items()}
BINARY = {
    "cameras.bin": struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 50.0, 50.0, 32.0, 24.0),
    "images.bin": struct.pack("<QI7dI", 1, 1, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1) + b"a.png\0" + bytes(8),
}
MANY_ROWS = struct.pack("<Q", 2**63)
CAMERA_FILES = [
    ("empty", b"", "empty file"),
    ("text", b"hello", "'hello'"),
    ("COLMAP's half", BINARY["cameras.bin"], "together"),
    ("not UTF-8", b'{"a": "\xff\xfe"}', "parse"),
    ("no frames", with_camera(frames=None), "'frames'"),
    ("empty list", b"[]", "at least one view"),
    ("list of nothing", b"[{}]", "'img_name'"),
    ("list of annotations", b'[{"bbox": [1, 2]}]', "a list with {'bbox'"),
    ("frames of numbers", with_camera(frames=[1]), "objects"),
    ("frame without a name", with_camera(frames=[{}]), "'file_path'"),
    ("frame of no name", with_camera(frames=[{"file_path": None}]), "as file_path, got None"),
    ("views twice", with_camera(frames=TWICE), "one view a name"),
    ("no size", with_camera(w=None), "size"),
    ("size of half a pixel", with_camera(w=9.5), "whole number"),
    ("10^18 pixels", with_camera(w=10**18), "size"),
    ("focal length of zero", with_camera(fl_x=0), "focal"),
    ("NaN", with_camera(fl_x=float("nan")), "finite"),
    ("4,000 digits", cameras_json().replace(b"30.0", b"9" * 4000), "finite"),
    ("scaled pose", with_pose(np.diag([2.0, 2, 2, 1]).tolist()), "scaled by 2"),
    ("mirroring pose", with_pose(np.diag([1.0, -1, 1, 1]).tolist()), "mirrors (determinant -1)"),
    ("intrinsics by the size", with_camera(fl_x=0.94, fl_y=1.25, cx=0.5, cy=0.5), "multiply fx and cx by 32"),
    ("VGGT's predictions", zipped({"extrinsic.npy": b"\x93NUMPY", "intrinsic.npy": b"\x93NUMPY"}), "COLMAP model"),
    ("3D Tiles", b'{"asset": {"version": "1.1"}, "geometricError": 1, "root": {}}', "tileset"),
    ("pose of texts", with_pose([["1", "0", "0", "0"], *EYE[1:]]), "'1'"),
    ("pose of three rows", with_pose([*EYE[:3], [1]]), "4x4"),
    ("pose of another scale", with_pose((2 * np.eye(4)).tolist()), "last row"),
    ("lens beyond the model", with_camera(camera_model="FISHEYE624"), "FISHEYE624"),
    ("lens that folds", with_camera(k1=-9), "distortion"),
    ("lens of two models", with_camera(camera_model="OPENCV_FISHEYE", p1=0.1), "fisheye"),
    ("half of a pair in a name", cameras_json().replace(b"images/left", b"images/\\ud800left"), "name"),
    ("zero byte in a name", cameras_json().replace(b"images/left", b"images/\\u0000left"), "printable"),
    ("zip of two disks", zipped(IN_ZIP)[:-22] + TWO_DISKS + zipped(IN_ZIP)[-22:], "zip"),
    ("zip in a zip", zipped({"sparse/0/model.zip": zipped(IN_ZIP)}), "zip"),
    ("zip of another size", patched(zipped(IN_ZIP), 24, 10), "zip"),
    ("zip of overlapping members", patched(zipped(IN_ZIP), 42, 0), "zip"),
    ("zip of a long name", zipped({f"sparse/0/{'x' * 300}.txt": b"x", **MODEL, "images.txt": b"x" * 9}), "image"),
]
CAMERA_BOMBS = [
    ("deep array", b"[" * 100_000, "parse"),
    ("deep object", b'{"a":' * 100_000, "parse"),
    ("5,000 digits", b"[" + b"1" * 5000 + b"]", "parse"),
    ("many numbers", b"[" + b"1," * 100_000 + b"1]", "list"),
    (
        "zip of 600 MB",
        lambda: zip_of_zeros(("cameras.txt", MODEL["cameras.txt"]), "images.txt", 600),
        "unzipped",
    ),
    ("2^63 cameras", zipped({"cameras.bin": MANY_ROWS, "images.bin": MANY_ROWS}), "9223372036854775808"),
]  # fmt: skip

SHAPE = b"{'descr': '<f8', 'fortran_order': False, 'shape': (500000000000,), }"
ONES, BOOK, LABELS = np.ones((2, 2, 3), np.float32), np.ones((4, 3), np.float32), np.zeros((1, 2, 2), np.int16)
REGIONS = {"v/labels": LABELS, "v/codebook": BOOK}
FEATURE_FILES = [
    ("empty", b"", "empty file"),
    ("text", b"short", "begins with"),
    ("truncated", save({"v/grid": ONES})[:-1], "not fully covered"),
    (
        "one of many names twice",
        safetensors(b'{"1":0,%s}' % b",".join(b'"%d":0' % k for k in range(400_000))),
        "twice",
    ),
    ("no channels", tensors(0, v__grid=tensor([1, 1, 0], 0, 0)), "empty"),
    ("no views", save({}), "no tensor"),
    ("unknown part", save({"v/depth": ONES}), "'v/depth'"),
    ("codebook alone", save({"v/codebook": BOOK}), "codebook"),
    ("labels beside a grid", save(REGIONS | {"v/grid": ONES}), "with grid"),
    ("grid of two sides", save({"v/grid": BOOK}), "[h w F]"),
    ("labels of floats", save({"v/labels": ONES, "v/codebook": BOOK}), "u1 i2 i4"),
    ("views of other channels", save({"v/grid": ONES, "w/grid": np.ones((1, 1, 4), np.float32)}), "channels"),
    ("label beyond the codebook", save(REGIONS | {"v/labels": LABELS + 4}), "the label 4"),
    ("NaN in a codebook", save(REGIONS | {"v/codebook": BOOK * np.nan}), "finite"),
    ("zip of a pickle", zipped({"archive/data.pkl": b"\x80\x02."}), "code"),
    ("pickle", PICKLE, "pickle"),
]
FEATURE_BOMBS = [
    ("header of 2^63 bytes", safetensors(b"{}", 2**63), "header"),
    ("deep header", safetensors(b'{"a":' * 100_000), "recursion limit"),
]

WORD = {"embeddings": tensor([1, 1], 0, 4)}


def table_of(words: Any, rows: Any = ((1.0,),)) -> bytes:
    """Return a text table whose words are this text or JSON."""
    text = words if isinstance(words, str) else json.dumps(words)
    return save({"embeddings": np.array(rows, np.float32)}, metadata={"words": text})


TABLE_FILES = [
    ("empty", b"", "empty file"),
    ("vectors alone", npy(np.eye(3)), "safetensors.numpy.save_file({'embeddings': array}"),
    ("no words", tensors(4, **WORD), "words"),
    ("zeros", table_of(["a"], [[0.0]]), "zero"),
    ("NaN", table_of(["a"], [[np.nan]]), "finite"),
    ("more words than rows", table_of(["a", "b"]), "words"),
    ("half of a pair as a word", table_of('["\\ud800"]'), "words"),
    (
        "more tensors",
        save({"embeddings": np.ones((1, 2)), "more": np.ones(2)}, metadata={"words": '["a"]'}),
        "'more'",
    ),
]
TABLE_BOMBS = [
    ("deep words", table_of("[" * 100_000), "words"),
    (
        "100,000 sides",
        tensors(4, embeddings=tensor([1] * 100_000, 0, 4), __metadata__={"words": '["a"]'}),
        "embeddings",
    ),
]
MASK_FILES = [
    ("fractions", tensors(24, v__mask=tensor([2, 3], 0, 24)), "mask"),
    ("class below none", save({"v/mask": np.full((2, 3), -2, np.int16)}), "-2"),
    ("no name", save({"v": np.zeros((2, 3), np.int16)}), "mask"),
    ("empty side", tensors(0, v__mask=tensor([10**9, 0], 0, 0, "I32")), "mask"),
    ("empty", b"", "empty file"),
]


def photo(side: int) -> bytes:
    """Return the head of a PNG of that many pixels a side."""
    start = b"IHDR" + struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + start + struct.pack(">I", zlib.crc32(start))


PHOTO_FILES = [
    ("no zip", b"photos", "zip"),
    ("another format", zipped({"a.jpg": photo(2)}), "JPEG"),
    ("name of two lines", zipped({"a\n.png": photo(2)}), "name"),
]
PHOTO_BOMBS = [
    ("zeros", lambda: zip_of_zeros(("a.png", photo(2)), "b.jpg", 200), "twice the zip"),
    ("many", lambda: zipped({f"{number}.jpg": b"" for number in range(10_001)}), "10000"),
    ("10^12 pixels", zipped({"a.png": photo(1_000_000)}), "PNG"),
    ("names of 9 MB", lambda: zipped({f"{k}{'x' * 60_000}.png": b"" for k in range(150)}), "directory"),
]
LIFT_FILES = [
    ("empty", b"", "empty file"),
    ("tensors of no lift", save({"a": ONES}), "lift"),
    ("metadata of no lift", save({"features": ONES[0]}, metadata={"splatlift": "{"}), "lift"),
]
BAD_FILES = [
    BadFile(kind, name, content, word, bomb)
    for kind, bomb, rows in (
        ("splats", False, SPLAT_FILES), ("splats", True, SPLAT_BOMBS),
        ("cameras", False, CAMERA_FILES), ("cameras", True, CAMERA_BOMBS),
        ("features", False, FEATURE_FILES), ("features", True, FEATURE_BOMBS),
        ("table", False, TABLE_FILES), ("table", True, TABLE_BOMBS),
        ("masks", False, MASK_FILES), ("photos", False, PHOTO_FILES), ("photos", True, PHOTO_BOMBS),
        ("lift", False, LIFT_FILES),
    )
    for name, content, word in rows
]  # fmt: skip


def binary_image(camera: int = 1, quaternion: tuple[float, ...] = (1, 0, 0, 0)) -> bytes:
    return struct.pack("<QI7dI", 1, 1, *quaternion, 0.0, 0.0, 1.0, camera) + b"a.png\0" + bytes(8)


def binary_camera(model: int, *values: float) -> bytes:
    return struct.pack(f"<QIiQQ{len(values)}d", 1, 1, model, 64, 48, *values)


PINHOLE = b"1 PINHOLE 64 48 50 50 32 24\n"
LINE = b"1 1 0 0 0 0 0 1 1 a.png\n"
MODELS = [
    ("no images", BINARY | {"images.bin": b""}, "ends after 0"),
    ("2^62 images", BINARY | {"images.bin": struct.pack("<Q", 2**62)}, "4611686018427387904"),
    ("unknown model", BINARY | {"cameras.bin": binary_camera(99, 1, 1, 1, 1)}, "model id 99"),
    ("model that is not read", BINARY | {"cameras.bin": binary_camera(7, 50, 50, 32, 24, 0)}, "FOV"),
    ("unknown camera", BINARY | {"images.bin": binary_image(9)}, "camera 9"),
    ("quaternion of zeros", BINARY | {"images.bin": binary_image(quaternion=(0, 0, 0, 0))}, "zero"),
    ("quaternion of NaN", BINARY | {"images.bin": binary_image(quaternion=(np.nan, 0, 0, 0))}, "finite"),
    ("half a model", {"cameras.bin": BINARY["cameras.bin"]}, "images.bin"),
    ("pointer", BINARY | {"images.bin": POINTER}, "git lfs pull"),
    ("width of letters", MODEL | {"cameras.txt": b"1 PINHOLE wide 48 1 1 1 1\n"}, "CAMERA_ID"),
    ("parameters missing", MODEL | {"cameras.txt": b"1 PINHOLE 64 48 1 1 1\n"}, "4 parameters"),
    ("pose of letters", MODEL | {"images.txt": b"0 1 0 0 0 0 0 zwei 1 a.jpg\n\n"}, "IMAGE_ID"),
    ("no empty lines", MODEL | {"images.txt": LINE + LINE}, "empty line"),
]
VECTORS = np.arange(15, dtype=np.float32).reshape(3, 5)
IDS = np.array([[-1, 0, 0, 2], [1, 1, -1, 2], [1, 1, -1, -1]])
MASKS = np.stack([k == IDS for k in range(3)])
OBJECTS = np.array([Intruder()], dtype=object)


def png(values: np.ndarray | Image.Image) -> bytes:
    """Return a PNG."""
    image = values if isinstance(values, Image.Image) else Image.fromarray(values)
    image.save(content := io.BytesIO(), format="PNG")
    return content.getvalue()


def with_vectors(**files: bytes) -> dict[str, bytes]:
    """Return the files of a view of three vectors, ``_`` for the last dot, with others in place of its masks."""
    return {"a.npy": npy(VECTORS)} | {".".join(name.rsplit("_", 1)): content for name, content in files.items()}


GREY = (IDS + 1).astype(np.uint8)
MASK_FOLDERS = [
    ("vectors of one axis", {"a.npy": npy(np.zeros(3)), "a.png": png(GREY)}, "[M, F]"),
    ("vectors of objects", {"a.npy": npy(OBJECTS), "a.png": png(GREY)}, "code"),
    ("fewer vectors than ids", {"a.npy": npy(VECTORS[:2]), "a_masks.npy": npy(IDS)}, "labels"),
    ("fewer masks than vectors", with_vectors(a_masks_npy=npy(MASKS[:2])), "3 masks"),
    ("masks of no axis", with_vectors(a_masks_npy=npy(MASKS[0])), "[M, H, W]"),
    ("ids of halves", with_vectors(a_masks_npy=npy(np.full((3, 4), 0.5))), "whole numbers"),
    ("masks of text", with_vectors(a_masks_npy=npy(np.array(["a"]))), "numbers"),
    ("JSON too deep", with_vectors(a_json=b"[" * 100_000), "JSON"),
    ("JSON of a number", with_vectors(a_json=b"3"), "list of masks"),
    ("picture of nothing", with_vectors(a_png=png(GREY * 0)), "values"),
    ("picture in colours", with_vectors(a_png=png(Image.new("RGB", (4, 3)))), "colours"),
    ("picture cut", with_vectors(a_png=png(GREY)[:40]), "PNG"),
]
ARRAY_FOLDERS = [
    ("no arrays", {"notes.txt": b"x"}, "files"),
    ("pickles", {"a.pkl": PICKLE}, "pickles"),
    ("four axes", {"a.npy": npy(np.zeros((5, 2, 3, 4), np.float32))}, "[h, w, F]"),
    ("4 TB, as it says", {"a.npy": b"\x93NUMPY\x01\x00v\x00" + SHAPE.ljust(117) + b"\n"}, "a.npy"),
]
BAD_FOLDERS = [
    BadFolder(kind, name, files, word)
    for kind, rows in (("cameras", MODELS), ("masks", MASK_FOLDERS), ("npy", ARRAY_FOLDERS))
    for name, files, word in rows
]
