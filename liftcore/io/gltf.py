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
from pathlib import Path
from typing import Any

import numpy as np

from liftcore.errors import InvalidInput
from liftcore.io.files import open_regular
from liftcore.io.labels import COLUMN, IDS
from liftcore.io.ply import MODEL
from liftcore.io.quantised import MOST_GROWTH, Fields, joined_fields, logits
from liftcore.scene.harmonics import band_rotation
from liftcore.scene.quaternions import product_matrix, rotation_matrices
from liftcore.scene.render_mode import mode_of_word
from liftcore.scene.similarity import Similarity
from liftcore.scene.world import UPRIGHT, world_of

EXTENSION = "KHR_gaussian_splatting"
FEATURES = "EXT_mesh_features"
SUPPORTED_EXTENSIONS = {EXTENSION, FEATURES, "EXT_structural_metadata", "KHR_mesh_quantization"}
MAGIC, JSON_CHUNK, BINARY_CHUNK = b"glTF", b"JSON", b"BIN\0"
MAX_JSON_BYTES = 64 << 20
MAX_DEGREE = 3  # of harmonics
MAX_NODES = 100_000
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


def read_gltf(path: Path, *, colour: bool = True) -> Fields:
    """Read the fields of all splats in a ``.glb``, node by node, in the frame of PLYs and cameras.

    Feature ids come as ``instance_id`` and ``class_id`` with 0 for none, other attributes with an underscore by their
    names, in lower case.
    """
    asset = _Asset(path)
    parts = [asset.fields(matrix, primitive, colour=colour) for matrix, primitive in asset.splats()]
    return joined_fields(parts) | {"world": asset.world}


def _hint_of(extension: str) -> str:
    """Return the advice for a file that needs an extension that is not read."""
    if "spz" in extension.lower():
        return "export its splats as .spz, which is read, as .ply, or as .glb without compression"
    return ""


class _Asset:
    """An open file: its JSON, and its bytes as they lie in the file."""

    def __init__(self, path: Path) -> None:
        with open_regular(path) as handle:
            head = handle.read(20)
        self.size = path.stat().st_size
        if len(head) < 20 or head[16:20] != JSON_CHUNK or struct.unpack_from("<I", head, 4)[0] != 2:
            raise _broken("a glTF 2.0 file that begins with JSON", repr(head[4:20]))
        length = struct.unpack_from("<I", head, 12)[0]
        if length > min(MAX_JSON_BYTES, self.size - 20):
            raise _broken(f"at most {MAX_JSON_BYTES} bytes of JSON in the file", str(length))
        content, offset = np.memmap(path, np.uint8, "r"), 20 + length
        text, self.binary = content[20:offset].tobytes(), content[:0]
        if offset + 8 <= self.size and content[offset + 4 : offset + 8].tobytes() == BINARY_CHUNK:
            (binary_length,) = struct.unpack("<I", content[offset : offset + 4].tobytes())
            self.binary = content[offset + 8 : offset + 8 + binary_length]
        try:
            self.json: Any = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise _broken("JSON", str(error)[:120]) from None
        if not isinstance(self.json, dict):
            raise _broken("a JSON object", repr(self.json)[:40])
        unsupported = [
            name for name in map(str, self._list(self.json, "extensionsRequired")) if name not in SUPPORTED_EXTENSIONS
        ]
        if unsupported:
            got = f"one that requires {unsupported[0][:80]}"
            raise _broken("a file without other required extensions", got, _hint_of(unsupported[0]))
        asset = self.json.get("asset")
        extras = asset.get("extras") if isinstance(asset, dict) else None
        self.world = world_of(extras[WORLD]) if isinstance(extras, dict) and WORLD in extras else METRES

    def splats(self) -> list[tuple[np.ndarray, dict[str, Any]]]:
        """Return the primitives of splats with their nodes' matrices [4, 4] f64, as the scene has them."""
        meshes, nodes = self._list(self.json, "meshes"), self._list(self.json, "nodes")
        scenes = self._list(self.json, "scenes")
        scene = self.json.get("scene", 0)
        inner = {
            child
            for node in nodes
            if isinstance(node, dict)
            for child in self._list(node, "children")
            if type(child) is int
        }
        roots = [place for place in range(len(nodes)) if place not in inner]
        if scenes:
            roots = self._list(self._at(scenes, scene, "scene"), "nodes")
        origin = np.linalg.inv(self.world.placement(TO_FILE, in_metres=True))
        primitives, queue, visited = [], [(root, origin) for root in reversed(roots)], set[int]()
        while queue:
            place, above = queue.pop()
            node = self._at(nodes, place, "node")
            if place in visited or max(len(visited), len(primitives)) >= MAX_NODES:
                got = "one that meets a node twice, or has more nodes"
                raise _broken(f"a tree of at most {MAX_NODES} nodes with splats", got)
            visited.add(place)
            matrix = above @ self._matrix(node, place) if TRANSFORM & node.keys() else above
            queue += [(child, matrix) for child in reversed(self._list(node, "children"))]
            if "mesh" in node:
                mesh = self._at(meshes, node["mesh"], "mesh")
                primitives += [(matrix, item) for item in self._list(mesh, "primitives") if _is_of_splats(item)]
        if not primitives:
            raise _broken(f"splats ({EXTENSION})", "a glTF model without any")
        total = sum(self._count(primitive) for _, primitive in primitives)
        if not 0 < total * SPLAT_BYTES <= MOST_GROWTH * self.size:
            raise _broken("as many splats as the file's size can be of", str(total))
        return primitives

    def fields(self, matrix: np.ndarray, primitive: dict[str, Any], *, colour: bool) -> Fields:
        """Return the fields of one primitive, with its extras and warnings."""
        attributes, warnings = primitive["attributes"], self._require_kernel(primitive)
        count = self._count(primitive)
        try:
            move = Similarity.of(matrix)
        except InvalidInput as error:
            hint = "apply the node's transform to its splats in the program that made it"
            raise _broken(f"a node's transform of {error.expected}", error.got, hint) from None
        rotation = TO_FILE @ move.rotation

        def read(name: str, width: int) -> np.ndarray:
            return self._attribute(attributes, name, width, count)

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
        extras = primitive.get("extras")
        mode, odd = None, ()
        if isinstance(extras, dict) and RENDER_MODE in extras:
            mode, odd = mode_of_word(extras[RENDER_MODE], f"{RENDER_MODE!r} of a primitive")
        fields |= {"extras": {}, "warnings": (*warnings, *odd), "render_mode": mode}
        if not colour:
            return fields
        degree = next(
            (
                band - 1
                for band in (1, 2, 3)
                if not any(harmonic_name(band, n) in attributes for n in range(2 * band + 1))
            ),
            3,
        )
        sh = np.empty((count, (degree + 1) ** 2, 3), np.float32)
        for band in range(degree + 1):
            coefficients = np.stack([read(harmonic_name(band, place), 3) for place in range(2 * band + 1)], axis=1)
            sh[:, band**2 : (band + 1) ** 2] = np.einsum("ij,njc->nic", band_rotation(band, rotation), coefficients)
        return fields | {"sh": sh, "extras": self._extras(primitive, count)}

    def _extras(self, primitive: dict[str, Any], count: int) -> dict[str, np.ndarray]:
        attributes = primitive["attributes"]
        if len(attributes) > MAX_ATTRIBUTES:
            raise _broken(f"at most {MAX_ATTRIBUTES} attributes", str(len(attributes)))
        extras = {}
        for name, feature_set in self._feature_sets(primitive).items():
            ids = self._attribute(attributes, f"_FEATURE_ID_{feature_set['attribute']}", 1, count)[:, 0].astype(
                np.int64
            )
            none = feature_set.get("nullFeatureId") if type(feature_set.get("nullFeatureId")) is int else -1
            extras[name] = (
                np.where(ids == none, 0, ids + (none != 0)).clip(0, np.iinfo(np.int32).max).astype(np.int32)
            )
        for name, place in attributes.items():
            column = name[1:].lower() if name == name.upper() else name[1:]
            is_column = COLUMN.fullmatch(column) and not MODEL.fullmatch(column) and column not in extras
            if name[:1] != "_" or name.startswith("_FEATURE_ID_") or not is_column:
                continue
            if self._at(self._list(self.json, "accessors"), place, "accessor").get("type") == "SCALAR":
                values = self._attribute(attributes, name, 1, count)[:, 0]
                extras[column] = values.astype(np.float32 if values.dtype.kind == "f" else np.int32)
        return extras

    def _feature_sets(self, primitive: dict[str, Any]) -> dict[str, dict[str, Any]]:
        """Return the feature ids of attributes by the names of their columns: by their label, else by their order."""
        sets_by_column: dict[str, dict[str, Any]] = {}
        sets = self._list(self._extension(primitive, FEATURES), "featureIds")
        of_attributes = [
            feature_set
            for feature_set in sets
            if isinstance(feature_set, dict) and type(feature_set.get("attribute")) is int
        ]
        numbers = {int(feature_set["attribute"]) for feature_set in of_attributes}
        attribute_numbers = (
            int(name[12:])
            for name in primitive["attributes"]
            if name.startswith("_FEATURE_ID_") and re.fullmatch("[0-9]{1,9}", name[12:])
        )
        for feature_set in [
            *of_attributes,
            *({"attribute": place} for place in sorted(attribute_numbers) if place not in numbers),
        ]:
            label, place = f"{feature_set.get('label')}_id", feature_set["attribute"]
            default = IDS[place] if 0 <= place < 2 and IDS[place] not in sets_by_column else f"feature_id_{place}"
            sets_by_column[label if label in IDS else default] = feature_set
        return sets_by_column

    def _require_kernel(self, primitive: dict[str, Any]) -> tuple[str, ...]:
        kind = self._extension(primitive, EXTENSION)
        compressed = next(iter(self._at_key(kind, "extensions")), None) if "extensions" in kind else None
        unsupported = f"the extension {compressed!r}" if compressed else None
        if kind.get("kernel") != "ellipse" and unsupported is None:
            unsupported = f"the kernel {kind.get('kernel')!r}"
        if primitive.get("mode") != 0 or "indices" in primitive:
            unsupported = unsupported or "a primitive that is no list of points"
        if unsupported:
            raise _broken("plain splats with the kernel 'ellipse'", unsupported[:100], _hint_of(compressed or ""))
        space = kind.get("colorSpace")
        return () if space == SRGB else (f"colours are of {str(space)[:60]!r}, and are taken for sRGB",)

    # -- parts of the file

    def _attribute(self, attributes: dict[str, Any], name: str, width: int, count: int) -> np.ndarray:
        """Read an attribute [P, width]; normalized integers as f32."""
        accessor = self._at(self._list(self.json, "accessors"), attributes.get(name), f"accessor of {name}")
        component, kind, normalized = (accessor.get(key) for key in ("componentType", "type", "normalized"))
        code = COMPONENTS.get(component) if type(component) is int else None
        fits = (
            kind in [name for name, components in WIDTHS.items() if components == width]
            and accessor.get("count") == count
        )
        if code is None or not fits or "sparse" in accessor or "bufferView" not in accessor:
            raise _broken(f"{count} rows of {width} plain numbers as {name}", repr(accessor)[:80])
        content = self._view(accessor["bufferView"])
        view = self._at(self._list(self.json, "bufferViews"), accessor["bufferView"], "buffer view")
        size = width * np.dtype(code).itemsize
        stride, first = view.get("byteStride", size), accessor.get("byteOffset", 0)
        if type(stride) is not int or type(first) is not int or stride < size or first < 0:
            raise _broken(f"rows of {size} bytes or more as {name}", f"{stride!r} from {first!r}"[:40])
        if first + (count - 1) * stride + size > len(content):
            raise _broken(f"{count} rows of {name} in the file", f"{len(content)} bytes")
        rows = np.lib.stride_tricks.as_strided(content[first:], (count, size), (stride, 1))
        values = np.ascontiguousarray(rows).view(code)
        if normalized and values.dtype.kind in "iu":
            return np.maximum(values.astype(np.float32) / np.iinfo(values.dtype).max, -1)
        return values

    def _view(self, place: Any) -> np.ndarray:
        """Return the bytes [n] u8 of a buffer view."""
        view = self._at(self._list(self.json, "bufferViews"), place, "buffer view")
        first, size, buffer = view.get("byteOffset", 0), view.get("byteLength"), view.get("buffer")
        uri = self._at(self._list(self.json, "buffers"), buffer, "buffer").get("uri")
        if buffer != 0 or uri is not None:
            got = f"a buffer in {str(uri)[:60]!r}"
            raise _broken("buffers within the file", got, "make one .glb of it, with its buffers")
        if (
            type(first) is not int
            or type(size) is not int
            or first < 0
            or size < 0
            or first + size > len(self.binary)
        ):
            raise _broken("a buffer view that lies in the file", f"{size!r} bytes from {first!r}"[:60])
        return self.binary[first : first + size]

    def _count(self, primitive: dict[str, Any]) -> int:
        attributes = primitive.get("attributes")
        if not isinstance(attributes, dict):
            raise _broken("attributes of a primitive", repr(attributes)[:40])
        accessor = self._at(self._list(self.json, "accessors"), attributes.get("POSITION"), "accessor of POSITION")
        count = accessor.get("count")
        if type(count) is not int or count < 1:
            raise _broken("a number of splats", repr(count)[:40])
        return count

    def _matrix(self, node: dict[str, Any], place: Any) -> np.ndarray:
        try:
            if "matrix" in node:
                return np.array(node["matrix"], np.float64).reshape(4, 4).T
            matrix = np.eye(4)
            rotation = np.roll(np.array(node.get("rotation", (0, 0, 0, 1)), np.float64), 1)
            matrix[:3, :3] = rotation_matrices(rotation) * np.array(node.get("scale", (1, 1, 1)), np.float64)
            matrix[:3, 3] = node.get("translation", (0, 0, 0))
            return matrix
        except (TypeError, ValueError, OverflowError):
            raise _broken("a transform of numbers", f"that of node {place}") from None

    def _extension(self, owner: dict[str, Any], name: str) -> dict[str, Any]:
        extensions = owner.get("extensions")
        extension = extensions.get(name) if isinstance(extensions, dict) else None
        return extension if isinstance(extension, dict) else {}

    def _list(self, owner: Any, key: str) -> list[Any]:
        values = owner.get(key, []) if isinstance(owner, dict) else None
        if not isinstance(values, list):
            raise _broken(f"a list of {key}", repr(values)[:40])
        return values

    def _at(self, values: list[Any], place: Any, noun: str) -> dict[str, Any]:
        if type(place) is not int or not 0 <= place < len(values) or not isinstance(values[place], dict):
            raise _broken(f"a {noun}", f"the number {place!r}"[:60])
        item: dict[str, Any] = values[place]
        return item

    def _at_key(self, owner: Any, key: Any) -> dict[str, Any]:
        value = owner.get(key) if isinstance(owner, dict) and isinstance(key, str) else None
        if not isinstance(value, dict):
            raise _broken(f"{str(key)[:40]!r} as an object", repr(value)[:40])
        return value


def _broken(expected: str, got: str, hint: str = "") -> ValueError:
    return ValueError(f"{expected}, got {got}" + (f"; {hint}" if hint else ""))


def _is_of_splats(primitive: Any) -> bool:
    extensions = primitive.get("extensions") if isinstance(primitive, dict) else None
    return isinstance(extensions, dict) and isinstance(extensions.get(EXTENSION), dict)


def harmonic_name(band: int, place: int) -> str:
    return f"{EXTENSION}:SH_DEGREE_{band}_COEF_{place}"
