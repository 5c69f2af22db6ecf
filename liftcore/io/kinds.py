"""The kind of any file or folder, and what to do with one that no reader takes. Loads no torch.

`identify` reads the beginning of a file, or the names in a zip or a folder, and a name's suffix last: files are
renamed, and their names are lost on the way to a server. It reads a bounded number of bytes. Readers, the command
line, the check of uploads and `inspect` all use it; the page has its table of suffixes (`page_table`).
"""

from __future__ import annotations

import json
import os
import re
import stat
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import IO, Any, TypeVar

from liftcore.errors import InvalidInput
from liftcore.io.colmap import MODEL_FILES
from liftcore.io.files import (
    BROKEN_ZIP,
    LFS_HINT,
    LFS_POINTER,
    files_in_zip,
    first_bytes,
    is_system_file,
    is_zip,
    open_regular,
    open_zip,
)
from liftcore.io.formats import HTTP_SUFFIXES, SplatFormat
from liftcore.io.json_file import MAX_JSON_BYTES
from liftcore.io.ply import EXPORT_PLY, MAX_HEADER_BYTES, TRAINED, cloud_without_splats
from liftcore.io.sog import META, is_sog_document, sog_folder
from liftcore.io.splat import looks_like_splat
from liftcore.io.spz import begins_like_spz
from liftcore.io.transforms import FRAME_FILE
from liftcore.runtime.arguments import as_path
from liftcore.scene.views import IMAGE_SUFFIXES

LIFT_KEY = "splatlift"  # of the metadata of a lift
PARTS = {"labels", "codebook", "grid"}  # of a feature pack's views
CAMERA_FILES = re.compile(
    r"(^|/)((cameras|images|frames|rigs)\.(bin|txt)|(dataparser_)?transforms[^/]*\.json|cameras\.json)$"
)
HEAD_BYTES = 4096  # of files recognised by their beginning
DEPTH = 5  # folders down
MAX_FOLDERS = 2_000
MAX_NAMES = 50_000  # of files in a folder
MOST_HEADERS = 32  # of PLYs in a folder or zip that are read, the likeliest first
TEXT_SHOWN = 60  # characters

CONVERT = "convert it with PlayCanvas's splat-transform: npx @playcanvas/splat-transform IN OUT.ply"
NOT_CONVERTED = (
    "splat-transform does not read it: export the splats as .ply, .spz or .sog from the program that has them"
)
UNPACK = "unpack it and give the splats in it"
DOWNLOAD = "the download went wrong: fetch the file itself"
PICKLED = (".pt", ".pth", ".ckpt", ".pkl")
LOD_META = "lod-meta.json"  # of a streamed SOG


@dataclass(frozen=True)
class FileKind:
    """The kind of a file or folder, in the words of an error."""

    name: str  # as errors have it behind "got"
    hint: str = ""  # remedy
    kind: str | None = None  # splats, cameras, photos (a zip or folder), features, masks, table, lift; None: no such
    format: SplatFormat | None = None  # of splats
    splats: tuple[str, ...] = ()  # splat files in a folder or zip, the one to give first
    recognised: bool = True  # False: only its first bytes are known

    @property
    def suffix(self) -> str:
        """Of splats, the usual suffix of their format; empty of others."""
        return self.format.suffix if self.format else ""


_WEB_PAGE = FileKind(
    "a web page", f"{DOWNLOAD}; of a viewer export the splats as .ply or .sog, from SuperSplat's editor"
)
_PICKLE = FileKind("a Python pickle, which may run code when it is opened", EXPORT_PLY)
_GLTF = FileKind("a glTF model without splats (KHR_gaussian_splatting)", f"a mesh has none: {NOT_CONVERTED}")
_USD = FileKind("a USD scene", "USD is written and not read: give the splats as .ply or .glb")
_STREAMED = FileKind(
    "a streamed SOG, whose levels of detail lie in many files", "give the .ply or .sog that it was made of"
)
_PICTURE = FileKind("a picture")
_VIDEO = FileKind("a video", "take frames of it, reconstruct their cameras with COLMAP, and train splats on them")
_MESH = FileKind("a mesh", TRAINED)
_ARCHIVE = FileKind("an archive", UNPACK)
_PACK_ARRAYS = "of features, 'splatlift pack npy' makes a pack of a folder of them"
_ARRAY = FileKind("a NumPy array", f"{_PACK_ARRAYS}; of splats, export PLY")
_ARRAYS = FileKind("NumPy arrays (.npz)", f"save each as .npy; {_PACK_ARRAYS}")
_OF_ARRAYS = {  # by the kind that was expected, what to do with arrays in its place
    "cameras": "of VGGT give the COLMAP model (demo_colmap.py writes it), of others a transforms.json of the poses; "
    "in Python Camera(viewmat, K, width, height) takes them as they are",
    "table": "make a table in Python, a row a word: safetensors.numpy.save_file({'embeddings': array}, "
    "'table.safetensors', {'words': json.dumps(words)})",
    "features": f"save each as .npy; {_PACK_ARRAYS}",
    "masks": f"save each as .npy; {_PACK_ARRAYS}",
}
_TILES = FileKind(
    "a tileset of 3D Tiles, which lists the tiles of a scene for a map",
    "give the splats, a .glb of its tiles, and the cameras that they were trained with",
)
_REPLACEMENTS = {  # by the kind that was expected and the one that came, what to do
    ("features", "photos"): "'splatlift encode IMAGES -o PACK' makes a feature pack of photos",
    ("features", "masks"): "masks to judge by have no vectors; 'splatlift pack' makes feature packs",
    ("features", "table"): "a table of text embeddings belongs to a query, as --table",
    ("features", "lift"): "a lift belongs to 'splatlift query'; give the feature packs that it was made of",
    ("cameras", "photos"): "give the COLMAP model, transforms.json or cameras.json of these photos",
    ("lift", "features"): "'splatlift lift SPLATS CAMERAS FEATURES -o LIFT' makes a lift of them",
    ("lift", "splats"): "'splatlift lift SPLATS CAMERAS FEATURES -o LIFT' makes a lift of them",
}
# By the bytes at a place of a file. Of two that fit the first counts.
_MAGIC: tuple[tuple[int, bytes, FileKind], ...] = (
    (0, LFS_POINTER, FileKind("a Git LFS pointer, which stands for the file", LFS_HINT)),
    *((0, magic, _ARCHIVE) for magic in (
        b"\x1f\x8b", b"7z\xbc\xaf\x27\x1c", b"Rar!\x1a\x07", b"\xfd7zXZ\x00", b"BZh", b"\x28\xb5\x2f\xfd",
    )),
    (257, b"ustar", _ARCHIVE),
    *((0, bytes((0x80, protocol)), _PICKLE) for protocol in (2, 3, 4, 5)),
    (0, b"\x93NUMPY", _ARRAY),
    (0, b"glTF", _GLTF),
    (0, b"PXR-USDC", _USD),
    (0, b"#usda", _USD),
    *((0, magic, _PICTURE) for magic in (
        b"\xff\xd8\xff", b"\x89PNG\r\n", b"GIF8", b"II*\x00", b"MM\x00*", b"\x76\x2f\x31\x01",
    )),
    *((8, magic, _PICTURE) for magic in (b"WEBP", b"heic", b"heix", b"mif1", b"avif")),
    (4, b"ftyp", _VIDEO),
)  # fmt: skip
# By the suffix, if the content is ambiguous.
_BY_SUFFIX: dict[str, FileKind] = {
    ".ksplat": FileKind("splats in GaussianSplats3D's .ksplat format", CONVERT),
    **dict.fromkeys((".usdz", ".usdc", ".usda", ".usd"), _USD),
    **dict.fromkeys((".html", ".htm"), _WEB_PAGE),
    **dict.fromkeys((".obj", ".fbx", ".stl"), _MESH),
    **dict.fromkeys((".mp4", ".mov", ".avi", ".mkv", ".webm"), _VIDEO),
    **dict.fromkeys((".pkl", ".pickle"), _PICKLE),
    **dict.fromkeys((".gz", ".tgz", ".bz2", ".xz", ".zst", ".tar", ".7z", ".rar"), _ARCHIVE),
}
# By keys of a JSON object. Of two that fit the first counts.
_BY_KEYS = (
    ({"tree", "filenames"}, _STREAMED),
    ({"frames"}, FileKind("cameras", kind="cameras")),
    (
        {"transform", "scale"},
        FileKind(f"the frame of a nerfstudio run ({FRAME_FILE})", "give the cameras that it belongs to"),
    ),
    ({"asset", "accessors"}, FileKind("a .gltf, which is not one file", "make one .glb of it")),
    ({"root", "geometricError"}, _TILES),
    (
        {"annotations", "images"},
        FileKind("masks as JSON (COCO)", "'splatlift pack prompts' makes a feature pack of its folder"),
    ),
)
_COLMAP_POINTS = ("points3D.bin", "points3D.txt", "frames.bin", "rigs.bin", "frames.txt", "rigs.txt")
_STEP = re.compile(r"(?:iteration|point_cloud|export|step|ckpt|splat)s?[_-]?0*([0-9]+)")
_CHECKPOINT = re.compile(  # splat-distiller puts features beside it
    r"(^|/)(ckpt_[0-9]+[^/]*(?<!_features)(?<!_filtered)(?<!_labels)\.pt|step-[0-9]+\.ckpt)$"
)
Fault = TypeVar("Fault", bound=InvalidInput)


def wrong_kind(
    path: Path | str, kind: str, fault: type[Fault], *, argument: str = "", expected: str = ""
) -> Fault | None:
    """Return the error for a file or folder of another kind than expected; None if it may be of that kind.

    Args:
        path: the file or folder. kind: of `FileKind.kind`. fault: the error's type. argument: its name there, the
        path if empty. expected: of the error, ``kind`` if empty.
    """
    identified = identify(path)
    if identified.kind == kind or not identified.recognised:
        return None
    hint = identified.hint
    if identified in (_ARRAY, _ARRAYS) or identified.format is SplatFormat.CHECKPOINT:
        hint = _OF_ARRAYS.get(kind, hint)
    elif kind == "splats" and identified.splats:
        first = identified.splats[0]
        hint = f"give {Path(path) / first}" if Path(path).is_dir() else f"unzip it and give {first}"
    elif identified.kind is not None:
        hint = _REPLACEMENTS.get((kind, identified.kind), hint)
    return fault(argument or str(path), expected=expected or kind, got=identified.name, hint=hint)


def identify(path: Path | str) -> FileKind:
    """Identify a file or folder, without an error: one that does not open has a name that says so."""
    path = as_path(path)
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            return _folder(path)
        if not stat.S_ISREG(mode):
            return FileKind("no regular file (a device, pipe or socket)", "give the file itself")
        return _file(path)
    except FileNotFoundError:
        return FileKind("no such file or folder", recognised=False)
    except (OSError, ValueError) as error:
        return FileKind(f"one that does not open ({getattr(error, 'strerror', None) or error})", recognised=False)


# ---- files


def _file(path: Path) -> FileKind:  # noqa: PLR0911 - a rule each
    with open_regular(path) as handle:
        head, size = handle.read(MAX_HEADER_BYTES), handle.seek(0, 2)
    suffix = path.suffix.lower()
    if not head:
        return FileKind("an empty file", "copy or export it again")
    if path.name in (*MODEL_FILES, *_COLMAP_POINTS):
        return _colmap_part(path)
    if head[:4] in (b"ply\n", b"ply\r"):
        return _ply(head)
    if begins_like_spz(head):
        return _splats_as(SplatFormat.SPZ)
    if head[:2] == b"PK" and is_zip(path):
        return _zip(path)
    if head[:4] == b"PK\3\4":
        return FileKind("a zip that is cut short or damaged", "copy or download it again")
    if suffix == ".safetensors" or (head[8:9] == b"{" and int.from_bytes(head[:8], "little") < size):
        return _safetensors(path)
    is_text = not any(byte < 9 or 13 < byte < 32 for byte in head[:HEAD_BYTES])
    by_content = _by_magic(head) or (_by_text(path, head, size) if is_text else None)
    is_unknown = by_content is None and suffix not in _BY_SUFFIX
    if suffix == ".splat" or (is_unknown and looks_like_splat(head, size)):
        return _splats_as(SplatFormat.SPLAT)
    unknown = FileKind(f"a file that begins with {first_bytes(head)}", recognised=False)
    return by_content or _BY_SUFFIX.get(suffix, unknown)


def _splats_as(splat_format: SplatFormat) -> FileKind:
    pickled = "a checkpoint or another Python pickle, which may run code when it is opened"
    name = pickled if splat_format is SplatFormat.CHECKPOINT else "splats"
    return FileKind(name, kind="splats", format=splat_format)


def _ply(head: bytes) -> FileKind:
    lines = head.partition(b"end_header")[0].decode("latin1").splitlines()
    if cloud := cloud_without_splats(lines):
        return FileKind(*cloud)
    first = next((line.split()[1:2] for line in lines if line.startswith("element ")), [])
    return _splats_as(SplatFormat.COMPRESSED_PLY if first == ["chunk"] else SplatFormat.PLY)


def _safetensors(path: Path) -> FileKind:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="np") as handle:
            keys, metadata = set(handle.keys()), handle.metadata() or {}
    except (SafetensorError, OSError) as error:
        return FileKind(f"one that does not open ({str(error)[:120]})", recognised=False)
    parts = {key.rpartition("/")[2] for key in keys}
    signs = {
        "lift": LIFT_KEY in metadata, "table": keys == {"embeddings"}, "masks": "mask" in parts,
        "features": bool(parts & PARTS),
    }  # fmt: skip
    kind = next((kind for kind, fits in signs.items() if fits), None)
    if kind is not None:
        return FileKind(kind, kind=kind)
    tensors = ", ".join(repr(key[:40]) for key in sorted(keys)[:3]) or "no tensor"
    hint = "weights of an encoder go to --weights or the encoder's name; 'splatlift pack' makes feature packs"
    return FileKind(f"a safetensors file of {tensors}", hint)


def _by_magic(head: bytes) -> FileKind | None:
    identified = next((kind for place, magic, kind in _MAGIC if head.startswith(magic, place)), None)
    if identified is _GLTF and b"KHR_gaussian_splatting" in head:
        return _splats_as(SplatFormat.GLTF)
    return identified


def _by_text(path: Path, head: bytes, size: int) -> FileKind | None:
    """Return the kind of a text: JSON, a page, a mesh, COLMAP's text, or a server's error."""
    start = head[:HEAD_BYTES].lstrip(b"\xef\xbb\xbf \t\r\n")
    lower = start.lower()
    if start[:1] in (b"{", b"["):
        return _json(path, size)
    if lower.startswith((b"<!doctype html", b"<html", b"<head", b"<!--")):
        return _WEB_PAGE
    if re.match(rb"#[^\n]*list with one line of data per", lower):
        return _colmap_part(path)
    return None


def _colmap_part(path: Path) -> FileKind:
    kind = "cameras" if path.name in MODEL_FILES else None
    return FileKind("a part of a COLMAP model", "give the folder that it lies in", kind)


def _json(path: Path, size: int) -> FileKind:
    if size > MAX_JSON_BYTES:
        return FileKind(f"a JSON file of {size} bytes", recognised=False)
    try:
        with open_regular(path) as handle:
            document = json.loads(handle.read(MAX_JSON_BYTES))
    except (ValueError, RecursionError, MemoryError):
        return FileKind("JSON that does not parse", kind="cameras", recognised=False)
    return _document(document, path)


def _document(document: Any, path: Path) -> FileKind:
    """Return the kind of a JSON document, by its keys."""
    if isinstance(document, list):
        first = document[0] if document and isinstance(document[0], dict) else {}
        if not document or first.keys() & {"img_name", "transform", "file_path"}:
            return FileKind("cameras", kind="cameras")
        if "segmentation" in first:
            hint = "'splatlift pack masks' or 'splatlift pack prompts' makes a feature pack of its folder"
            return FileKind("masks as JSON", hint)
        return FileKind("a JSON list of something else", recognised=False)
    if not isinstance(document, dict):
        return FileKind(f"JSON ({str(document)[:TEXT_SHOWN]!r})", recognised=False)
    if is_sog_document(document):
        return _splats_as(SplatFormat.SOG)
    listing = ", ".join(map(str, list(document)[:5]))[:TEXT_SHOWN]
    unknown = FileKind(f"a JSON object with {listing or 'nothing'}", recognised=False)
    by_suffix = _BY_SUFFIX.get(path.suffix.lower(), unknown)
    return next((kind for keys, kind in _BY_KEYS if document.keys() >= keys), by_suffix)


# ---- zips


def _zip(path: Path) -> FileKind:
    try:
        with open_zip(path) as archive:
            files = files_in_zip(archive)
            splats = _splat_files(files, lambda name: _begins_with_splats(archive.open(files[name])))
            return _of_names_in_zip([*files], splats)
    except BROKEN_ZIP as error:
        return FileKind(f"a zip that does not open ({str(error)[:120]})", recognised=False)


def _of_names_in_zip(names: list[str], splats: tuple[str, ...]) -> FileKind:  # noqa: PLR0911 - a rule each
    lasts = {name.rpartition("/")[2] for name in names}
    suffixes = {PurePosixPath(last).suffix.lower() for last in lasts}
    if not names:
        return FileKind("a zip without a file", "zip or export it again")
    if LOD_META in lasts:
        return _STREAMED
    if sog_folder(names) is not None:
        return _splats_as(SplatFormat.SOG)
    if any(name.endswith("/data.pkl") for name in names):
        return _splats_as(SplatFormat.CHECKPOINT)
    if names[0].lower().endswith((".usd", ".usda", ".usdc")):
        return _USD
    if suffixes == {".npy"}:
        return _ARRAYS
    if any(CAMERA_FILES.search(name) for name in names):
        return FileKind("a zip of cameras", kind="cameras", splats=splats)
    if not splats and suffixes & IMAGE_SUFFIXES:
        return FileKind("photos", kind="photos")
    if interesting := splats or tuple(name for name in names if name.endswith(".safetensors")):
        return _zip_with(interesting)
    return replace(_zip_with(names), hint="unzip it and give the file itself")


def _zip_with(names: Sequence[str]) -> FileKind:
    """Return a zip with files of interest, the first of which is the one to give."""
    several = f" and {len(names) - 1} more" if len(names) > 1 else ""
    splats = tuple(name for name in names if name.lower().endswith((*HTTP_SUFFIXES, *PICKLED)))
    return FileKind(f"a zip with {names[0]}{several} in it", f"unzip it and give {names[0]}", splats=splats)


def _begins_with_splats(file: IO[bytes]) -> bool:
    """Return True if a file, which is closed, is a PLY of splats by its first bytes."""
    with file:
        head = file.read(MAX_HEADER_BYTES)
    return head[:3] == b"ply" and _ply(head).kind == "splats"


def _splat_files(names: Iterable[str], has_splats: Callable[[str], bool]) -> tuple[str, ...]:
    """Splat files among names of a folder or zip: those of the last step, plain files before checkpoints, first."""

    def order(name: str) -> tuple[int, bool, int, str]:
        steps = [int(step) for step in _STEP.findall(name.lower())] or [-1]
        return -max(steps), name.lower().endswith(PICKLED), name.count("/"), name

    likely = [name for name in names if name.lower().endswith(HTTP_SUFFIXES) or _CHECKPOINT.search(name)]
    likely.sort(key=order)
    plys = [name for name in likely if name.lower().endswith(".ply")]
    wrong = {name for name in plys[:MOST_HEADERS] if not has_splats(name)}
    return tuple(name for name in likely if name not in wrong)


# ---- folders


def _folder(path: Path) -> FileKind:  # noqa: PLR0911 - a rule each
    if (path / META).is_file() and _file(path / META).format is SplatFormat.SOG:
        return _splats_as(SplatFormat.SOG)
    if (path / LOD_META).is_file():
        return _STREAMED
    names = _names_below(path)
    splats = _splat_files(names, lambda name: _has_splats(path / name))
    label = f"a folder with {len(splats)} files of splats in it" if len(splats) > 1 else ""
    if _has_cameras(path):
        return FileKind(label or "a folder of cameras", kind="cameras", splats=splats)
    if splats:
        return FileKind(label or "a folder of splats", f"give {path / splats[0]}", splats=splats)
    suffixes = {PurePosixPath(name).suffix.lower() for name in names}
    if all(any(name.endswith(end) for name in names) for end in ("_f.npy", "_s.npy")):
        hint = f"'splatlift pack langsplat {path} -o PACK.safetensors' makes a feature pack of it"
        return FileKind("a folder of LangSplat's features", hint)
    if ".npy" in suffixes:
        hint = f"'splatlift pack npy {path}' or 'splatlift pack masks {path}' makes a feature pack of it"
        return FileKind("a folder of NumPy arrays", hint)
    if tensors := [path / name for name in names if name.endswith(".safetensors")]:
        return FileKind("a folder with safetensors files in it", f"give the file itself, such as {tensors[0]}")
    if suffixes & IMAGE_SUFFIXES:
        return FileKind("a folder of photos", kind="photos")
    return FileKind("a folder without any of them" if names else "an empty folder", recognised=False)


def _has_cameras(path: Path) -> bool:
    from liftcore.io.cameras import camera_source  # which imports `wrong_kind`

    try:
        return bool(camera_source(path).files)
    except InvalidInput:  # several models, of which one is to be named
        return True


def _has_splats(path: Path) -> bool:
    with suppress(OSError):
        return _begins_with_splats(open_regular(path))
    return False


def _names_below(folder: Path) -> list[str]:
    """Return the files below a folder, relative to it, without hidden ones; links are not followed."""
    names: list[str] = []
    for parent, inner, files in islice(os.walk(folder), MAX_FOLDERS):
        relative = Path(parent).relative_to(folder)
        names += [(relative / name).as_posix() for name in sorted(files) if not is_system_file(Path(name))]
        if len(names) > MAX_NAMES:
            break
        inner[:] = [name for name in sorted(inner) if len(relative.parts) < DEPTH and not is_system_file(Path(name))]
    return names


# ---- the page


def page_table() -> dict[str, Any]:
    """Return the suffixes of files that the page sends, and those that it refuses, with the hints above."""
    return {
        "kinds": {
            **dict.fromkeys(HTTP_SUFFIXES, "splats"),
            ".json": "cameras", ".safetensors": "features", ".zip": "cameras",
        },
        "images": sorted(IMAGE_SUFFIXES),
        "cameras": CAMERA_FILES.pattern,
        "others": {
            suffix: {"got": kind.name, "hint": kind.hint}
            for suffix, kind in sorted((_BY_SUFFIX | dict.fromkeys(PICKLED, _PICKLE)).items())
        },
    }  # fmt: skip
