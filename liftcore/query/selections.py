"""Selections: named sets of splats that are edited by hand, with undo and redo."""

from __future__ import annotations

import base64
import binascii
import math
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.edits import Edit
from liftcore.query.objects import MOST_SPLATS, object_box, objects
from liftcore.query.question import Answer, Box, Query
from liftcore.query.scene import Scene, as_numpy
from liftcore.query.terms import Area
from liftcore.runtime.one_line import one_line
from liftcore.scene.touching import REACH, spreads_along, touching_pairs

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.scene.cameras import Camera

MOST_HISTORY = 100  # steps in the history of a selection
SURFACE_OPACITY = 0.75  # accumulated opacity of a ray from which it has hit a surface
RAYS = 1 << 15  # that are traced at once
NEAR = 0.01  # depth from which splats are in front of a camera, scene units
ROUNDING = 1e-6  # pixels beyond a stroke's edge that count as on it
# A selection grows into splats within a margin of its box, on each side, and the reach of all but a hundredth of the
# scene's splats.
GROWTH_MARGIN = 0.25
SIZE_QUANTILE = 0.99


class Selection:
    """A named set of splats of a scene, with its edits, which can be undone.

    Args:
        scene: an opened lift. name: ``selection:NAME`` in queries.
    """

    def __init__(self, scene: Scene, name: str) -> None:
        self._scene, self.name = scene, name
        self._steps, self._place = [bits_of(np.zeros(len(scene.features), np.bool_))], 0

    def __repr__(self) -> str:
        return one_line(self, repr(self.name), f"{int(self.splats.sum())} splats", f"step {self._place}")

    @property
    def splats(self) -> np.ndarray:
        """[P] bool, the selected splats."""
        return splats_of_bits(self.bits, len(self._scene.features))

    @property
    def bits(self) -> bytes:
        """The selected splats (`bits_of`)."""
        return self._steps[self._place]

    @property
    def box(self) -> Box | None:
        """The box of its large groups of touching splats (`object_box`); None without splats."""
        rows = np.flatnonzero(self.splats)
        return object_box(self._scene.splats, rows, self._scene.weights_of(rows)) if rows.size else None

    def edit(
        self,
        operation: str | Edit,
        source: Answer | Query | str | np.ndarray | Tensor | int | None = None,
        **fields: Any,
    ) -> Self:
        """Edit the selection; edits that were undone before are dropped.

        Args:
            operation: set, add, remove, grow or shrink; or an `Edit`, with the answer to its query if that is known.
            source: of the splats: an answer, a query or a text, [P] bool, or the number of an object.
            fields: of `Edit`, such as ``area="0001:stroke:40,30,90,30", radius=12`` or ``steps=2``.

        Raises:
            InvalidQuery: no source or several, or as the query.
            NotFound: no such view, object or selection.
            InvalidLift: the splats or cameras moved or changed since the lift.
        """
        edit, answer = _edit_of(self._scene, operation, source, fields)
        if edit.query is not None and answer is None:
            answer = self._scene.ask(edit.query, places=False)
        splats = apply_edit(self._scene, self.splats, edit, answer)
        self._steps = [*self._steps[: self._place + 1], bits_of(splats)][-MOST_HISTORY - 1 :]
        self._place = len(self._steps) - 1
        return self

    def undo(self) -> Self:
        """Go back a step; no change at the first one."""
        self._place = max(0, self._place - 1)
        return self

    def redo(self) -> Self:
        """Revert an undo; no change at the last step."""
        self._place = min(len(self._steps) - 1, self._place + 1)
        return self


def _edit_of(scene: Scene, operation: str | Edit, source: Any, fields: dict[str, Any]) -> tuple[Edit, Answer | None]:
    """Return an edit from Python's arguments, and the answer that is its source."""
    answer = source if isinstance(source, Answer) else None
    if isinstance(operation, Edit):
        return operation, answer
    if isinstance(source, np.ndarray) or hasattr(source, "detach"):
        source = as_numpy(source)
        if source.dtype != np.bool_ or source.shape != (len(scene.features),):
            expected = f"a boolean for each of {len(scene.features)} splats"
            raise InvalidQuery("splats", expected=expected, got=f"{source.dtype} {list(source.shape)}")
        fields["bits"] = base64.b64encode(bits_of(source)).decode()
    elif source is not None:
        query = answer.query if answer else Query(sets=[f"object:{source}"]) if isinstance(source, int) else source
        fields["query"] = Query.of(query) if isinstance(query, str) else query
    return Edit.model_validate({"operation": operation, **fields}), answer


def bits_of(splats: np.ndarray) -> bytes:
    """Pack splats [P] bool to a bit a splat, the first in the lowest bit of its byte."""
    return np.packbits(splats, bitorder="little").tobytes()


def splats_of_bits(bits: bytes, count: int) -> np.ndarray:
    """Unpack bits of `bits_of` to [count] bool."""
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=count, bitorder="little").astype(np.bool_)


def apply_edit(scene: Scene, splats: np.ndarray, edit: Edit, answer: Answer | None = None) -> np.ndarray:
    """Apply an edit to splats [P] bool, and return them, [P] bool.

    Args:
        scene: an opened lift. answer: to the edit's query, if it has one.
    """
    if edit.operation == "grow":
        return _grow(scene, splats, edit.steps)
    if edit.operation == "shrink":
        return ~_grow(scene, ~splats, edit.steps, splats)
    source = _source(scene, edit, answer)
    return source if edit.operation == "set" else splats | source if edit.operation == "add" else splats & ~source


def _source(scene: Scene, edit: Edit, answer: Answer | None) -> np.ndarray:
    count = len(scene.features)
    if answer is not None:
        return objects(scene, answer).numbers >= 0 if answer.query.keeps_some else answer.selected
    if edit.area is not None:
        area = edit.parsed_area()
        camera = scene.camera(area.view if edit.camera is None else edit.camera.camera())
        return splats_under(scene, camera, area_mask(area, camera.photo_size, edit.radius), through=edit.through)
    if edit.box is not None:
        low, high = np.sort(np.array([*edit.box]), axis=0)[..., None]
        return np.all((scene.axes >= low) & (scene.axes <= high), axis=0)
    if edit.bits is None:
        return np.zeros(count, np.bool_)
    try:
        bits = base64.b64decode(edit.bits, validate=True)
    except (binascii.Error, ValueError):
        raise InvalidQuery("bits", expected="base64", got="something else") from None
    if len(bits) != -(-count // 8):
        raise InvalidQuery("bits", expected=f"{-(-count // 8)} bytes for {count} splats", got=f"{len(bits)} bytes")
    return splats_of_bits(bits, count)


def area_mask(area: Area, size: tuple[int, int], radius: float) -> np.ndarray:
    """Return the pixels of a box, or within a radius of a stroke, [H, W] bool; without parts outside the image.

    Args:
        size: width and height of the image.
    """
    mask = np.zeros(size[::-1], np.bool_)
    if area.kind == "box":
        (x0, y0), (x1, y1) = np.sort(np.maximum(area.corners, 0), axis=0).tolist()  # drawn from any corner
        mask[y0:y1, x0:x1] = True
        return mask
    reach = radius + ROUNDING
    for begin, end in pairwise(np.array(area.corners, np.float64)):
        left, top = np.clip(np.ceil(np.minimum(begin, end) - reach), 0, size).astype(np.int64).tolist()
        right, bottom = np.clip(np.floor(np.maximum(begin, end) + reach) + 1, 0, size).astype(np.int64).tolist()
        along_x, along_y = (end - begin).tolist()
        low, high = sorted((0.0, along_y))
        for row in range(top, bottom):  # of which the segment is near to few columns
            y = row - begin[1]
            feet = np.array([0.0, along_x])
            if along_y:
                feet = np.clip([y - reach, y + reach], low, high) * along_x / along_y
            first = max(left, math.ceil(begin[0] + feet.min() - reach))
            last = max(first, min(right, math.floor(begin[0] + feet.max() + reach) + 1))
            x = np.arange(first, last) - begin[0]
            share = np.clip((x * along_x + y * along_y) / max(along_x**2 + along_y**2, 1.0), 0.0, 1.0)
            mask[row, first:last] |= np.hypot(x - share * along_x, y - share * along_y) <= reach
    return mask


def splats_under(scene: Scene, camera: Camera, mask: np.ndarray, *, through: bool = False) -> np.ndarray:
    """Return the splats whose centres a camera sees in a mask [H, W] bool of its image, [P] bool.

    A splat is hidden if it lies completely, to `REACH` standard deviations, behind the splat at which the ray through
    its centre has an accumulated opacity of `SURFACE_OPACITY`. ``through`` selects hidden ones, too.
    """
    import torch

    from liftcore.scene.cameras import drawn_by

    pinhole = drawn_by(camera)
    pinhole_mask = _pinhole_mask(camera, mask)
    local = pinhole.about(scene.splats.origin)
    places = scene.splats.means.cpu().numpy().astype(np.float64) @ local.viewmat[:3, :3].T + local.viewmat[:3, 3]
    depth = places[:, 2]
    in_front = np.flatnonzero(depth > NEAR)
    columns, rows = np.floor(
        places[in_front, :2] / depth[in_front, None] * (local.fx, local.fy) + (local.cx, local.cy)
    ).T
    inside = (columns >= 0) & (columns < pinhole.width) & (rows >= 0) & (rows < pinhole.height)
    in_front, columns, rows = in_front[inside], columns[inside].astype(np.int64), rows[inside].astype(np.int64)
    under = pinhole_mask[rows, columns]
    in_front, pixels = in_front[under], rows[under] * pinhole.width + columns[under]
    visible = np.zeros(len(scene.features), np.bool_)
    if through or not in_front.size:
        visible[in_front] = True
        return visible
    rays, ray_of_splat = np.unique(pixels, return_inverse=True)
    surface = np.full(len(rays), np.inf)  # depths
    for first in range(0, len(rays), RAYS):
        block = rays[first : first + RAYS]
        positions = np.stack([block % pinhole.width, block // pinhole.width], axis=1).astype(np.int32)
        row = scene.raster.ray_rows(pinhole, torch.from_numpy(positions), scene.compositing)
        ends, splats, weights = (part.cpu().numpy() for part in (row.indptr, row.splats, row.weights))
        ray = np.repeat(np.arange(len(block)), np.diff(ends))
        sums = np.concatenate([[0.0], np.cumsum(weights, dtype=np.float64)])
        surface_entries = np.flatnonzero(sums[1:] - sums[ends[:-1]][ray] >= SURFACE_OPACITY)
        np.minimum.at(surface, first + ray[surface_entries], depth[splats[surface_entries]])
    reach = REACH * spreads_along(scene.splats, in_front, local.viewmat[2, :3])
    visible[in_front[depth[in_front] - reach <= surface[ray_of_splat]]] = True
    return visible


def _pinhole_mask(camera: Camera, mask: np.ndarray) -> np.ndarray:
    """Map a mask of a camera's photo to the pixels of the pinhole that renders it, [h, w] bool."""
    if camera.lens is None:
        return mask
    from liftcore.scene.cameras import drawn_by
    from liftcore.scene.distortion import photo_places

    pinhole = drawn_by(camera)
    pinhole_mask = np.zeros((pinhole.height, pinhole.width), np.bool_)
    columns, rows = (np.floor(axis[mask]).astype(np.int64) for axis in photo_places(camera.lens))
    inside = (columns >= 0) & (columns < pinhole.width) & (rows >= 0) & (rows < pinhole.height)
    pinhole_mask[rows[inside], columns[inside]] = True
    return pinhole_mask


def _grow(scene: Scene, splats: np.ndarray, steps: int, core: np.ndarray | None = None) -> np.ndarray:
    """Add to splats [P] bool those that touch one of them, ``steps`` times; ``core`` bounds the search."""
    rows = _near(scene, splats if core is None else core, steps)
    inside = splats[rows]
    first, second = touching_pairs(scene.splats, rows)
    for _ in range(steps):
        wider = inside.copy()
        wider[second[inside[first]]] = True
        wider[first[inside[second]]] = True
        inside = wider
    full = splats.copy()
    full[rows] = inside
    return full


def _near(scene: Scene, splats: np.ndarray, steps: int) -> np.ndarray:
    """Return the splats around some [P] bool among which neighbours are searched, [n] i64."""
    if not splats.any():
        return np.zeros(0, np.int64)
    places = scene.axes[:, splats]
    low, high = places.min(axis=1, keepdims=True), places.max(axis=1, keepdims=True)
    size = float(np.exp(np.quantile(scene.splats.log_scales.cpu().numpy().max(axis=1), SIZE_QUANTILE)))
    reach = GROWTH_MARGIN * (high - low).max() + 2 * REACH * size * steps
    rows = np.flatnonzero(((scene.axes >= low - reach) & (scene.axes <= high + reach)).all(axis=0))
    if len(rows) > MOST_SPLATS:
        expected = f"a selection with at most {MOST_SPLATS:,} splats around it"
        raise InvalidQuery("selection", expected=expected, got=f"{len(rows):,}", hint="take a smaller one")
    return rows
