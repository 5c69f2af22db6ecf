"""Writer of a ``.glb`` of splats with labels, in the layout of `liftcore.io.gltf`."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidSplats
from liftcore.io.gltf import (
    BINARY_CHUNK,
    COMPONENTS,
    EXTENSION,
    FEATURES,
    JSON_CHUNK,
    LABELS,
    MAGIC,
    RENDER_MODE,
    SRGB,
    TO_FILE,
    WIDTHS,
    WORLD,
    harmonic_name,
)
from liftcore.io.labels import IDS, stored_columns
from liftcore.io.quantised import gaussians_in
from liftcore.runtime.version import __version__
from liftcore.scene.kernel import Kernel
from liftcore.scene.origin import FILE_ORIGIN

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

LARGEST_FILE = (1 << 32) - 1  # bytes; a .glb stores its size in 32 bits
IDENTITY = [1.0, 0.0, 0.0, 0.0]  # w x y z
CODES = {np.dtype(code): number for number, code in COMPONENTS.items()}
NEAREST = "{kernel} splats as the nearest Gaussians: the format has the kernel 'ellipse' alone"


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
    gltf: dict[str, Any] = {"asset": asset, "extensionsUsed": [EXTENSION]}
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

    def view(self, content: bytes, **members: Any) -> int:
        """Add a buffer view, and return its number."""
        self.views.append({"buffer": 0, "byteOffset": self.size, "byteLength": len(content), **members})
        self.parts.append(content + b"\0" * (-len(content) % 8))
        self.size += len(self.parts[-1])
        return len(self.views) - 1

    def attribute(self, values: np.ndarray, **members: Any) -> int:
        """Add an accessor of values [P] or [P, n], aligned to 4 bytes, and return its number."""
        width = 1 if values.ndim == 1 else values.shape[1]
        row_bytes = width * values.itemsize
        stride = row_bytes + -row_bytes % 4
        rows = np.zeros((len(values), stride), np.uint8)
        rows[:, :row_bytes] = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), row_bytes)
        view = self.view(rows.tobytes(), target=34962, byteStride=stride)
        kind = next(name for name, components in WIDTHS.items() if components == width)
        accessor = {"bufferView": view, "componentType": CODES[values.dtype], "count": len(values), "type": kind}
        self.accessors.append(accessor | members)
        return len(self.accessors) - 1


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
