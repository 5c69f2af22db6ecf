"""glTF 2.0 with ``KHR_gaussian_splatting`` (release candidate of 2026): a point primitive with splat attributes.

Positions, linear scales, linear opacities, quaternions x y z w and spherical harmonics of degree 0 to 3, which are
ordered and signed as 3DGS has them. The frame is +Y up, +Z forward, -X right (LUF); PLYs and cameras are in right,
down, front (RDF): a rotation by 180 degrees about z, which is baked in, as few readers rotate harmonics by a node.
The node's transform has the origin of scenes in map coordinates, and the transform to +Y up and metres, where these
are known (`liftcore.scene.world`). ``asset.extras`` stores the same, by which our reader undoes that transform. In
files of other programs +Y is up and a unit is a metre, as the format defines.

Labels are feature ids (``EXT_mesh_features``): ``_FEATURE_ID_0`` is the instance, ``_FEATURE_ID_1`` the class, 0 is
none. ``asset.extras`` has the document that describes them. Other columns of splats are attributes with an underscore
before their name.

Only the file itself is read, a .glb with its buffer in it.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidSplats
from liftcore.io.labels import COLUMN, IDS, stored_columns
from liftcore.io.ply import MODEL
from liftcore.io.quantised import MOST_GROWTH, Fields, gaussians_in, logits
from liftcore.runtime.version import __version__
from liftcore.scene.harmonics import rotate_bands
from liftcore.scene.kernel import Kernel
from liftcore.scene.origin import FILE_ORIGIN
from liftcore.scene.quaternions import product_matrix, rotation_matrices
from liftcore.scene.render_mode import mode_of_word
from liftcore.scene.similarity import similarity_named
from liftcore.scene.world import UPRIGHT, world_of

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

EXTENSION = "KHR_gaussian_splatting"
FEATURES = "EXT_mesh_features"
SUPPORTED_EXTENSIONS = {EXTENSION, FEATURES, "EXT_structural_metadata", "KHR_mesh_quantization"}
MAGIC, JSON_CHUNK, BINARY_CHUNK = b"glTF", b"JSON", b"BIN\0"
MAX_JSON_BYTES = 64 << 20
MAX_DEGREE = 3  # of harmonics
MAX_NODES = 100_000
FEATURE_ID = "_FEATURE_ID_"  # and a number: an attribute of ids
MAX_ATTRIBUTES = 320  # of a primitive: those of splats, and MAX_COLUMNS others
SPLAT_BYTES = 56  # of a decoded splat without its colours
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
TO_FILE = np.diag([-1.0, -1.0, 1.0])  # RDF to LUF, and back
TRANSFORM = {"matrix", "rotation", "scale", "translation"}  # of a node
RENDER_MODE = "SplatRenderMode"
WORLD, LABELS = "splatlift_world", "splatlift_labels"  # of asset.extras
METRES = UPRIGHT.model_copy(update={"metres_per_unit": 1.0})  # of a file without ``WORLD``
SRGB = "srgb_rec709_display"
LARGEST_FILE = (1 << 32) - 1  # bytes; a .glb stores its size in 32 bits
IDENTITY = [1.0, 0.0, 0.0, 0.0]  # w x y z
CODES = {np.dtype(code): number for number, code in COMPONENTS.items()}
NEAREST = "{kernel} splats as the nearest Gaussians: the format has the kernel 'ellipse' alone"


def read_gltf(path: Path, *, colour: bool) -> Fields:
    """Read the fields of all splats in a ``.glb``, node by node, in the frame of PLYs and cameras.

    Feature ids come as ``instance_id`` and ``class_id`` with 0 for none, other attributes with an underscore by their
    names, in lower case.
    """
    try:
        asset = _Asset(path)
        parts = [asset.fields(matrix, primitive, colour=colour) for matrix, primitive in asset.splats()]
    except (AttributeError, LookupError, TypeError) as error:
        raise ValueError(f"a document of glTF 2.0, got one with parts that do not fit ({error})") from None
    return (parts[0] if len(parts) == 1 else _join_primitives(parts)) | {"world": asset.world}


def _join_primitives(parts: Sequence[Fields]) -> Fields:
    """Concatenate splats of primitives: the first's render mode, the largest degree, and 0 in missing columns."""
    warnings = dict.fromkeys(text for part in parts for text in part["warnings"])
    fields: Fields = {"render_mode": parts[0]["render_mode"], "warnings": tuple(warnings), "extras": {}}
    for name in dict.fromkeys(name for part in parts for name in part["extras"]):
        columns = [part["extras"].get(name, np.zeros(len(part["means"]), np.int32)) for part in parts]
        fields["extras"][name] = np.concatenate(columns)
    for name in parts[0].keys() - fields.keys():
        arrays = [part[name] for part in parts]
        if name == "sh":
            sh_rows = max(sh.shape[1] for sh in arrays)
            arrays = [np.pad(sh, ((0, 0), (0, sh_rows - sh.shape[1]), (0, 0))) for sh in arrays]
        fields[name] = np.concatenate(arrays)
    return fields


def _hint_of(extension: str) -> str:
    """Return the advice for a file that needs an extension that is not read."""
    if "spz" in extension.lower():
        return "export its splats as .spz, which is read, as .ply, or as .glb without compression"
    return "export the splats again, as .ply"


class _Asset:
    """An open file: its JSON, and its bytes as they lie in the file."""

    def __init__(self, path: Path) -> None:
        content = np.memmap(path, np.uint8, "r")
        self.size, head = len(content), content[:20].tobytes()
        if len(head) < 20 or head[16:20] != JSON_CHUNK or struct.unpack_from("<I", head, 4)[0] != 2:
            raise ValueError(f"a glTF 2.0 file that begins with JSON, got {head[4:20]!r}")
        end = 20 + int.from_bytes(head[12:16], "little")
        if end > min(MAX_JSON_BYTES, self.size):
            raise ValueError(f"at most {MAX_JSON_BYTES} bytes of JSON in the file, got {end}")
        is_binary = content[end + 4 : end + 8].tobytes() == BINARY_CHUNK
        self.binary = content[end + 8 :][: int.from_bytes(content[end : end + 4].tobytes(), "little") * is_binary]
        self.json: Any = json.loads(content[20:end].tobytes())
        for name in self.json.get("extensionsRequired", ()):
            if name not in SUPPORTED_EXTENSIONS:
                hint = _hint_of(str(name))
                raise ValueError(f"a file without other required extensions, got {str(name)[:80]!r}; {hint}")
        extras = self.json["asset"].get("extras", {})
        self.world = world_of(extras[WORLD]) if WORLD in extras else METRES

    def splats(self) -> list[tuple[np.ndarray, dict[str, Any]]]:
        """Return the primitives of splats with their nodes' matrices [4, 4] f64, as the scene has them."""
        nodes = self.json["nodes"]
        inner = {child for node in nodes for child in node.get("children", ())}
        roots = [place for place in range(len(nodes)) if place not in inner]
        if self.json.get("scenes"):
            roots = self.json["scenes"][self.json.get("scene", 0)].get("nodes", [])
        origin = np.linalg.inv(self.world.placement(TO_FILE, in_metres=True))
        primitives, queue, visited = [], [(root, origin) for root in reversed(roots)], set[int]()
        while queue:
            place, above = queue.pop()
            if place in visited or max(len(visited), len(primitives)) >= MAX_NODES:
                got = "one that meets a node twice, or has more nodes"
                raise ValueError(f"a tree of at most {MAX_NODES} nodes with splats, got {got}")
            visited.add(place)
            node = nodes[place]
            matrix = above @ _matrix(node) if TRANSFORM & node.keys() else above
            queue += [(child, matrix) for child in reversed(node.get("children", []))]
            if "mesh" in node:
                items = self.json["meshes"][node["mesh"]]["primitives"]
                primitives += [(matrix, item) for item in items if EXTENSION in item.get("extensions", {})]
        if not primitives:
            raise ValueError(f"splats ({EXTENSION}), got a glTF model without any")
        total = sum(self._count(primitive) for _, primitive in primitives)
        if not 0 < total * SPLAT_BYTES <= MOST_GROWTH * self.size:
            raise ValueError(f"as many splats as the file's size can be of, got {total}")
        return primitives

    def fields(self, matrix: np.ndarray, primitive: dict[str, Any], *, colour: bool) -> Fields:
        """Return the fields of one primitive, with its extras and warnings."""
        attributes, warnings = primitive["attributes"], _kernel_warnings(primitive)
        count = self._count(primitive)
        move = similarity_named("a node's transform", matrix)
        rotation = TO_FILE @ move.rotation

        def read(name: str, width: int) -> np.ndarray:
            return self._attribute(attributes.get(name), name, width, count)

        places = read("POSITION", 3).astype(np.float64) @ (move.scale * rotation).T + TO_FILE @ move.translation
        quats = np.roll(read(f"{EXTENSION}:ROTATION", 4).astype(np.float64), 1, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            scales = np.log(read(f"{EXTENSION}:SCALE", 3).astype(np.float64)) + np.log(move.scale)
        fields: Fields = {
            "means": places,
            "quats": (quats @ product_matrix(rotation).T).astype(np.float32),
            "log_scales": scales.astype(np.float32),
            "opacity_logits": logits(read(f"{EXTENSION}:OPACITY", 1)[:, 0]).astype(np.float32),
        }
        extras, mode, odd = primitive.get("extras", {}), None, ()
        if RENDER_MODE in extras:
            mode, odd = mode_of_word(extras[RENDER_MODE], f"{RENDER_MODE!r} of a primitive")
        fields |= {"extras": {}, "warnings": (*warnings, *odd), "render_mode": mode}
        if not colour:
            return fields
        bands = [[harmonic_name(band, place) for place in range(2 * band + 1)] for band in range(MAX_DEGREE + 1)]
        absent = (band for band, names in enumerate(bands) if band and not attributes.keys() & set(names))
        coefficients = [read(name, 3) for names in bands[: next(absent, len(bands))] for name in names]
        sh = np.stack(coefficients, axis=1, dtype=np.float32)
        return fields | {"sh": rotate_bands(sh, rotation), "extras": self._extras(primitive, count)}

    def _extras(self, primitive: dict[str, Any], count: int) -> dict[str, np.ndarray]:
        """Return feature ids by their label, else by their number, and other columns by name, each [P]."""
        attributes = primitive["attributes"]
        if len(attributes) > MAX_ATTRIBUTES:
            raise ValueError(f"at most {MAX_ATTRIBUTES} attributes, got {len(attributes)}")
        sets = {
            item.get("attribute"): item for item in primitive["extensions"].get(FEATURES, {}).get("featureIds", ())
        }
        extras: dict[str, np.ndarray] = {}
        for name in sorted(attributes):
            if not re.fullmatch(f"{FEATURE_ID}[0-9]{{1,9}}", name):
                continue
            number = int(name.removeprefix(FEATURE_ID))
            ids_of = sets.get(number, {})
            label, none = f"{ids_of.get('label')}_id", ids_of.get("nullFeatureId", -1)
            column = label if label in IDS else IDS[number] if number < 2 else f"feature_id_{number}"
            ids = self._attribute(attributes[name], name, 1, count)[:, 0].astype(np.int64)
            ids = np.where(ids == none, 0, ids + (none != 0))
            extras[column] = ids.clip(0, np.iinfo(np.int32).max).astype(np.int32)
        for name, place in attributes.items():
            column = name[1:].lower() if name == name.upper() else name[1:]
            is_column = COLUMN.fullmatch(column) and not MODEL.fullmatch(column) and column not in extras
            if name[:1] != "_" or name.startswith(FEATURE_ID) or not is_column:
                continue
            if self.json["accessors"][place].get("type") == "SCALAR":
                values = self._attribute(place, name, 1, count)[:, 0]
                extras[column] = values.astype(np.float32 if values.dtype.kind == "f" else np.int32)
        return extras

    def _count(self, primitive: dict[str, Any]) -> int:
        return self.json["accessors"][primitive["attributes"]["POSITION"]]["count"]

    def _attribute(self, place: Any, name: str, width: int, count: int) -> np.ndarray:
        """Read an attribute [P, width]; normalized integers as f32."""
        accessor: dict[str, Any] = {}
        try:
            accessor = self.json["accessors"][place]
            view = self.json["bufferViews"][accessor["bufferView"]]
            dtype = np.dtype(COMPONENTS[accessor["componentType"]])
            content = self.binary[view.get("byteOffset", 0) :][: view["byteLength"]]
            size, first = width * dtype.itemsize, accessor.get("byteOffset", 0)
            stride = view.get("byteStride", size)
            is_within = view["buffer"] == 0 and "uri" not in self.json["buffers"][0]
            fits = accessor["count"] == count and WIDTHS[accessor["type"]] == width and "sparse" not in accessor
            if not (fits and is_within) or stride < size or first + (count - 1) * stride + size > len(content):
                raise ValueError(name)
            rows = np.ndarray((count, width), dtype, content, first, (stride, dtype.itemsize))
        except (AttributeError, LookupError, TypeError, ValueError, OverflowError):
            expected = f"{count} rows of {width} plain numbers within the file as {name}"
            got = repr(accessor)[:80]
            raise ValueError(f"{expected}, got {got}; make one .glb of it, with its buffers") from None
        if accessor.get("normalized") and dtype.kind in "iu":
            return np.maximum(rows.astype(np.float32) / np.iinfo(dtype).max, -1)
        return rows.copy()


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """Return the transform [4, 4] f64 of a node."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    rotation = np.roll(np.array(node.get("rotation", (0, 0, 0, 1)), np.float64), 1)
    matrix[:3, :3] = rotation_matrices(rotation) * np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _kernel_warnings(primitive: dict[str, Any]) -> tuple[str, ...]:
    """Refuse what is no plain splats, and warn of colours of another space than sRGB."""
    kind = primitive["extensions"][EXTENSION]
    compressed = next(iter(kind.get("extensions", {})), "")
    got = f"the extension {compressed!r}" if compressed else f"the kernel {kind.get('kernel')!r}"
    if not compressed and kind.get("kernel") == "ellipse":
        if primitive.get("mode") == 0 and "indices" not in primitive:
            space = kind.get("colorSpace")
            return () if space == SRGB else (f"colours are of {str(space)[:60]!r}, and are taken for sRGB",)
        got = "a primitive that is no list of points"
    raise ValueError(f"plain splats with the kernel 'ellipse', got {got[:100]}; {_hint_of(compressed)}")


def harmonic_name(band: int, place: int) -> str:
    return f"{EXTENSION}:SH_DEGREE_{band}_COEF_{place}"


# ---- writing


def gltf_blocks(splats: Splats, document: Mapping[str, Any] | None = None) -> Iterator[bytes]:
    """Yield the bytes of a ``.glb`` of any splats (`gaussian_rows`), with their extras and the labels' document.

    Harmonics above degree 3 are left out; 2DGS and DBS become the nearest Gaussians, as ``asset.extras`` records.
    """
    binary, columns = _Binary(), stored_columns(splats)
    sets = [name for name in IDS if name in columns]
    primitive = _primitive(binary, splats, columns, sets)
    node: dict[str, Any] = {"mesh": 0, "name": "splats"}
    node |= _transform(splats)
    extras: dict[str, Any] = {WORLD: splats.world.model_dump(mode="json")}
    if splats.kernel is not Kernel.GAUSSIAN_3D:
        extras["note"] = NEAREST.format(kernel=splats.kernel)
    asset: dict[str, Any] = {"version": "2.0", "generator": f"splatlift {__version__}", "extras": extras}
    gltf: dict[str, Any] = {"extensionsUsed": [EXTENSION], "asset": asset}  # files are recognised by their beginning
    if sets:
        primitive["extensions"][FEATURES] = {"featureIds": [_feature_set(columns, name, sets) for name in sets]}
        gltf["extensionsUsed"].append(FEATURES)
    if document:
        extras[LABELS] = document
    gltf |= {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [node], "meshes": [{"primitives": [primitive]}]}
    gltf |= {"accessors": binary.accessors, "bufferViews": binary.views, "buffers": [{"byteLength": binary.size}]}
    text = json.dumps(gltf, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = 28 + len(text) + binary.size
    if size > LARGEST_FILE:
        expected, hint = f"a file of at most {LARGEST_FILE} bytes", "export parts of it"
        raise InvalidSplats("splats", expected=expected, got=str(size), hint=hint)
    yield struct.pack("<4sII", MAGIC, 2, size) + struct.pack("<I4s", len(text), JSON_CHUNK) + text
    yield struct.pack("<I4s", binary.size, BINARY_CHUNK)
    yield from binary.parts


def _transform(splats: Splats) -> dict[str, Any]:
    """Return the node's transform to +Y up and metres, as far as these are known."""
    world, parts = splats.world, dict[str, Any]()
    if (turn := world.upright(TO_FILE)).tolist() != IDENTITY:
        parts["rotation"] = np.roll(turn, -1).tolist()
    if world.metres_per_unit not in (None, 1.0):
        parts["scale"] = [world.metres_per_unit] * 3
    if splats.origin != FILE_ORIGIN:
        place = world.placement(TO_FILE, in_metres=True)[:3, :3]
        parts["translation"] = (place @ TO_FILE @ splats.origin).tolist()
    return parts


class _Binary:
    """The buffer of a file that is written: arrays one after the other, each from a multiple of 8 bytes."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def attribute(self, values: np.ndarray, **members: Any) -> int:
        """Add an accessor of values [P] or [P, n], aligned to 4 bytes, and return its number."""
        width = 1 if values.ndim == 1 else values.shape[1]
        row_bytes = width * values.itemsize
        stride = row_bytes + -row_bytes % 4
        rows = np.zeros((len(values), stride), np.uint8)
        rows[:, :row_bytes] = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), row_bytes)
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": rows.size, "target": 34962, "byteStride": stride}
        self.parts.append(rows.tobytes() + b"\0" * (-rows.size % 8))
        self.size += len(self.parts[-1])
        number = len(self.views)  # of the view, and of its accessor
        kind = next(name for name, components in WIDTHS.items() if components == width)
        accessor = {"bufferView": number, "componentType": CODES[values.dtype], "count": len(values), "type": kind}
        self.views.append(view)
        self.accessors.append(accessor | members)
        return number


def _primitive(
    binary: _Binary, splats: Splats, columns: Mapping[str, np.ndarray], sets: Sequence[str]
) -> dict[str, Any]:
    rows = gaussians_in(splats, TO_FILE)
    srgb = rows.colours.clip(0, 1)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    extents = {"min": rows.means.min(axis=0).tolist(), "max": rows.means.max(axis=0).tolist()}
    attributes = {
        "POSITION": binary.attribute(rows.means, **extents),
        "COLOR_0": binary.attribute(  # for viewers that draw points only
            np.round(255 * np.column_stack([linear, rows.opacities])).astype("<u1"), normalized=True
        ),
        f"{EXTENSION}:ROTATION": binary.attribute(rows.quats),
        f"{EXTENSION}:SCALE": binary.attribute(rows.scales),
        f"{EXTENSION}:OPACITY": binary.attribute(rows.opacities),
    }
    for band in range(round(rows.sh.shape[1] ** 0.5)):
        for place in range(2 * band + 1):
            attributes[harmonic_name(band, place)] = binary.attribute(rows.sh[:, band**2 + place])
    for name, column in columns.items():
        attribute_name = f"_{name.upper() if name == name.lower() else name}"
        attribute = f"_FEATURE_ID_{sets.index(name)}" if name in sets else attribute_name
        if attribute in attributes:
            expected = "names that differ in more than their case, and are no feature_id_0"
            raise InvalidSplats("columns", expected=expected, got=f"a second {attribute}")
        attributes[attribute] = binary.attribute(_attribute_values(name, column))
    kind = {"kernel": "ellipse", "colorSpace": SRGB, "projection": "perspective", "sortingMethod": "cameraDistance"}
    primitive: dict[str, Any] = {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: kind}}
    if splats.antialiased:
        primitive["extras"] = {RENDER_MODE: "mip"}  # as in PLYs; the format has no property for it
    return primitive


def _attribute_values(name: str, column: np.ndarray) -> np.ndarray:
    """Convert a column [P] to a type that attributes have: integers of at most 16 bits, or f32."""
    if column.dtype.kind == "f":
        return column.astype("<f4")
    low, high = int(column.min()), int(column.max())
    for code in ("<u1", "<u2", "<i2"):
        if np.iinfo(code).min <= low and high <= np.iinfo(code).max:
            return column.astype(code)
    if max(-low, high) > 1 << 24:
        expected = "whole numbers below 2^24, as attributes of glTF have them"
        raise InvalidSplats(f"columns[{name!r}]", expected=expected, got=f"{low}..{high}")
    return column.astype("<f4")


def _feature_set(columns: Mapping[str, np.ndarray], name: str, sets: Sequence[str]) -> dict[str, Any]:
    count = np.unique(columns[name][columns[name] > 0]).size
    ids = {"featureCount": max(count, 1), "nullFeatureId": 0, "attribute": sets.index(name)}
    return ids | {"label": name.removesuffix("_id")}
