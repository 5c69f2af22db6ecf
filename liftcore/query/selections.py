"""Selections: named sets of splats that somebody corrects by hand, and can go back in."""

from __future__ import annotations

import base64
import binascii
import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from liftcore.errors import InvalidQuery, NotFound
from liftcore.query.edits import Edit
from liftcore.query.objects import MOST_SPLATS, object_box, objects
from liftcore.query.opened import MOST_PIXELS, OpenedLift
from liftcore.query.question import Answer, Box, Query
from liftcore.query.terms import PixelBox, SplatSet, Stroke
from liftcore.runtime.one_line import one_line
from liftcore.scene.touching import REACH, spreads_along, touching_pairs

if TYPE_CHECKING:
    from liftcore.query.scene import Scene
    from liftcore.scene.cameras import Camera

MOST_HISTORY = 100  # steps that are kept of a selection
SEEN_BEFORE = 0.75  # of a ray's light: where so much is lost, it meets a surface
RAYS = 1 << 15  # that are looked along at once
NEAR = 0.01  # in front of a camera, scene units
ROUNDING = 1e-6  # pixels beyond a stroke's edge that count as on it
BESIDE = 0.25  # of a selection's box, on each side: where splats that it may grow by are looked for,
MOST_SIZES = 0.99  # and as far as all but a hundredth of the scene's splats reach


@dataclass(frozen=True)
class Step:
    """A state of a selection, and what made it."""

    edit: dict[str, Any]  # as `Edit.described`
    bits: bytes  # a bit a splat, the first the lowest of its byte

    @classmethod
    def of(cls, edit: dict[str, Any], splats: np.ndarray) -> Self:
        """A step to splats [P] bool."""
        return cls(edit, np.packbits(splats, bitorder="little").tobytes())


class Selection:
    """A named set of splats of a scene, with the edits that made it; each can be undone.

    Args:
        scene: an opened lift. name: in questions ``selection:NAME``. splats: [P] bool to begin with; None: none.
    """

    def __init__(self, scene: Scene, name: str, splats: np.ndarray | None = None) -> None:
        self._scene, self.name = scene, name
        start = np.zeros(len(scene.features), np.bool_) if splats is None else _booleans(scene, splats)
        self._steps, self._place = [Step.of({"how": "set"}, start)], 0

    def __repr__(self) -> str:
        return one_line(self, repr(self.name), f"{int(self.splats.sum())} splats", f"step {self._place}")

    @property
    def splats(self) -> np.ndarray:
        """[P] bool, what is selected."""
        return splats_of_bits(self._steps[self._place].bits, len(self._scene.features))

    @property
    def bits(self) -> bytes:
        """The same, a bit a splat, the first the lowest of its byte."""
        return self._steps[self._place].bits

    @property
    def box(self) -> Box | None:
        """The box of its large groups of splats that touch (`thing_box`); None of no splats."""
        rows = np.flatnonzero(self.splats)
        return object_box(self._scene.splats, rows, _weights(self._scene, rows)) if rows.size else None

    @property
    def history(self) -> tuple[dict[str, Any], ...]:
        """The edits that made it, in their order, without those that were undone."""
        return tuple(step.edit for step in self._steps[1 : self._place + 1])

    def edit(
        self, how: str | Edit, source: Answer | Query | str | np.ndarray | int | None = None, **fields: Any
    ) -> Self:
        """Change what is selected; what was undone before is forgotten.

        Args:
            how: set, add, remove, grow or shrink; or a whole `Edit`, with the answer to its query if that is known.
            source: of the splats: an answer, a question or a text, [P] bool, or the number of an object.
            fields: of `Edit`, such as ``area="0001:stroke:40,30,90,30", radius=12`` or ``steps=2``.

        Raises:
            InvalidQuery: no source or several, or as the question.
            NotFound: a view, an object or a selection that is not there.
            InvalidLift: the splats or cameras moved or changed since the lift.
        """
        edit, answer = _edit_of(self._scene, how, source, fields)
        if edit.query is not None and answer is None:
            answer = self._scene.ask(edit.query, places=False)
        splats = edited(self._scene, self.splats, edit, answer)
        self._steps = [*self._steps[: self._place + 1], Step.of(edit.described(), splats)][-MOST_HISTORY - 1 :]
        self._place = len(self._steps) - 1
        return self

    def undo(self) -> Self:
        """Go back a step; at the first one nothing happens."""
        self._place = max(0, self._place - 1)
        return self

    def redo(self) -> Self:
        """Take back an undo; after the last step nothing happens."""
        self._place = min(len(self._steps) - 1, self._place + 1)
        return self


def _edit_of(scene: Scene, how: str | Edit, source: Any, fields: dict[str, Any]) -> tuple[Edit, Answer | None]:
    """An edit from Python's arguments, and the answer that is its source."""
    answer = source if isinstance(source, Answer) else None
    if isinstance(how, Edit):
        return how, answer
    if isinstance(source, np.ndarray):
        fields["bits"] = base64.b64encode(Step.of({}, _booleans(scene, source)).bits).decode()
    elif source is not None:
        asked = answer.query if answer else Query(sets=[f"object:{source}"]) if isinstance(source, int) else source
        fields["query"] = Query.of(asked) if isinstance(asked, str) else asked
    return Edit.model_validate({"how": how, **fields}), answer


def splats_of_bits(bits: bytes, count: int) -> np.ndarray:
    """[count] bool, of a bit a splat, the first the lowest of its byte."""
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=count, bitorder="little").astype(np.bool_)


def edited(scene: OpenedLift, splats: np.ndarray, edit: Edit, answer: Answer | None = None) -> np.ndarray:
    """Splats [P] bool after an edit, [P] bool.

    Args:
        scene: an opened lift. answer: to the edit's query, if it has one.

    Raises:
        InvalidQuery, NotFound, InvalidLift, Unavailable: as `Selection.edit`.
    """
    if edit.how in ("grow", "shrink"):
        return (
            _grown(scene, splats, edit.steps) if edit.how == "grow" else ~_grown(scene, ~splats, edit.steps, splats)
        )
    source = _source(scene, edit, answer)
    return source if edit.how == "set" else splats | source if edit.how == "add" else splats & ~source


def set_members(scene: OpenedLift, members: SplatSet) -> np.ndarray:
    """[P] bool, the splats of an object or of a selection; NotFound where there is none of that name."""
    if members.kind == "selection":
        found = scene.selections.get(members.name)
        if found is None:
            known = ", ".join(list(scene.selections)[:20]) or "none yet"
            raise NotFound("selection", expected=f"a selection of the scene: {known}", got=repr(members.name))
        return found.splats
    return scene.members(int(members.name))


def _source(scene: OpenedLift, edit: Edit, answer: Answer | None) -> np.ndarray:
    count = len(scene.features)
    if answer is not None:
        return objects(scene, answer).numbers >= 0 if answer.query.keeps_some else answer.selected
    if edit.area is not None:
        area = edit.parsed_area()
        camera = scene.camera(area.view) if edit.camera is None else edit.camera.camera()
        if np.prod(camera.photo_size) > MOST_PIXELS:
            width, height = camera.photo_size
            expected = f"an image of at most {MOST_PIXELS} pixels to take an area of"
            raise InvalidQuery("camera", expected=expected, got=f"{width}x{height}", hint="take a smaller camera")
        return splats_under(scene, camera, area_mask(area, camera.photo_size, edit.radius), through=edit.through)
    if edit.box is not None:
        low, high = (np.array(corner)[:, None] for corner in edit.box)
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


def area_mask(area: PixelBox | Stroke, size: tuple[int, int], radius: float) -> np.ndarray:
    """[H, W] bool, the pixels of a box, or as far from a stroke as its radius; what lies outside is left out.

    Args:
        size: width and height of the image.
    """
    width, height = size
    if isinstance(area, PixelBox):
        mask = np.zeros((height, width), np.bool_)
        mask[max(0, area.y0) : max(0, area.y1), max(0, area.x0) : max(0, area.x1)] = True
        return mask
    # Along each row: the pieces of the stroke that begin at a pixel, less those that ended before it. Discs around
    # its corners and rectangles between them are convex, so a row crosses each of them once.
    changes = np.zeros((height, width + 1), np.int16)
    corners = np.array(area.pixels, np.float64)
    pieces = [_disc_runs(corner, radius, height) for corner in corners]
    pieces += [_rectangle_runs(ends, radius, height) for ends in pairwise(corners)]
    for rows, low, high in pieces:
        first, end = np.clip(np.ceil(low - ROUNDING), 0, width), np.clip(np.floor(high + ROUNDING) + 1, 0, width)
        changes[rows, first.astype(np.int64)] += 1
        changes[rows, np.maximum(first, end).astype(np.int64)] -= 1
    return np.cumsum(changes[:, :-1], axis=1, dtype=np.int16) > 0


def _rows_between(low: float, high: float, height: int) -> np.ndarray:
    """[n] i64, the rows of an image that lie between two places."""
    return np.arange(max(0, math.ceil(low - ROUNDING)), min(height, math.floor(high + ROUNDING) + 1))


def _disc_runs(centre: np.ndarray, radius: float, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows [n] i64 of an image that a disc crosses, and from where to where it does, [n] f64 each."""
    x, y = centre.tolist()
    rows = _rows_between(y - radius, y + radius, height)
    half = np.sqrt(np.maximum(radius**2 - (rows - y) ** 2, 0))
    return rows, x - half, x + half


def _rectangle_runs(
    ends: tuple[np.ndarray, np.ndarray], radius: float, height: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same of all that lies across a line, as far as a radius to both sides of it."""
    begin, end = ends
    across = (end - begin)[::-1] * (-radius, radius) / max(np.hypot(*(end - begin)), 1.0)
    corners = [begin + across, end + across, end - across, begin - across]
    rows = _rows_between(min(y for _, y in corners), max(y for _, y in corners), height)
    low, high = np.full(len(rows), np.inf), np.full(len(rows), -np.inf)
    for (x, y), (to_x, to_y) in zip(corners, [*corners[1:], corners[0]], strict=True):
        meets = (rows >= min(y, to_y) - ROUNDING) & (rows <= max(y, to_y) + ROUNDING)
        if y == to_y:
            crossing = np.array([[x], [to_x]])
        else:
            crossing = np.clip(x + (rows - y) * ((to_x - x) / (to_y - y)), min(x, to_x), max(x, to_x))[None]
        low = np.where(meets, np.minimum(low, crossing.min(axis=0)), low)
        high = np.where(meets, np.maximum(high, crossing.max(axis=0)), high)
    return rows, low, high


def splats_under(scene: OpenedLift, camera: Camera, mask: np.ndarray, *, through: bool = False) -> np.ndarray:
    """[P] bool, the splats whose centres a camera shows in a mask [H, W] bool of its image.

    A splat is hidden where it lies wholly, to `REACH` standard deviations, behind the splat at which the ray through
    its centre has lost `SEEN_BEFORE` of its light; ``through`` takes hidden ones too.

    Raises:
        InvalidLift: the splats moved or changed since the lift.
    """
    import torch

    from liftcore.scene.cameras import drawn_by

    pinhole = drawn_by(camera)
    drawn = _as_drawn(camera, mask)
    local = pinhole.about(scene.splats.origin)
    places = scene.splats.means.cpu().numpy().astype(np.float64) @ local.viewmat[:3, :3].T + local.viewmat[:3, 3]
    depth = places[:, 2]
    ahead = np.flatnonzero(depth > NEAR)
    columns, rows = np.floor(places[ahead, :2] / depth[ahead, None] * (local.fx, local.fy) + (local.cx, local.cy)).T
    inside = (columns >= 0) & (columns < pinhole.width) & (rows >= 0) & (rows < pinhole.height)
    ahead, columns, rows = ahead[inside], columns[inside].astype(np.int64), rows[inside].astype(np.int64)
    under = drawn[rows, columns]
    ahead, pixels = ahead[under], rows[under] * pinhole.width + columns[under]
    found = np.zeros(len(scene.features), np.bool_)
    if through or not ahead.size:
        found[ahead] = True
        return found
    rays, own = np.unique(pixels, return_inverse=True)
    surface = np.full(len(rays), np.inf)  # depths
    for first in range(0, len(rays), RAYS):
        some = rays[first : first + RAYS]
        asked = np.stack([some % pinhole.width, some // pinhole.width], axis=1).astype(np.int32)
        row = scene.raster.ray_rows(pinhole, torch.from_numpy(asked), scene.compositing)
        ends, splats, weights = (part.cpu().numpy() for part in (row.indptr, row.splats, row.weights))
        ray = np.repeat(np.arange(len(some)), np.diff(ends))
        sums = np.concatenate([[0.0], np.cumsum(weights, dtype=np.float64)])
        lost = np.flatnonzero(sums[1:] - sums[ends[:-1]][ray] >= SEEN_BEFORE)
        np.minimum.at(surface, first + ray[lost], depth[splats[lost]])
    reach = REACH * spreads_along(scene.splats, ahead, local.viewmat[2, :3])
    found[ahead[depth[ahead] - reach <= surface[own]]] = True
    return found


def _as_drawn(camera: Camera, mask: np.ndarray) -> np.ndarray:
    """A mask of a camera's photo in the pixels of the pinhole that draws it, [h, w] bool."""
    if camera.lens is None:
        return mask
    from liftcore.scene.cameras import drawn_by
    from liftcore.scene.distortion import photo_places

    pinhole = drawn_by(camera)
    drawn = np.zeros((pinhole.height, pinhole.width), np.bool_)
    columns, rows = (np.floor(axis[mask]).astype(np.int64) for axis in photo_places(camera.lens))
    inside = (columns >= 0) & (columns < pinhole.width) & (rows >= 0) & (rows < pinhole.height)
    drawn[rows[inside], columns[inside]] = True
    return drawn


def _grown(scene: OpenedLift, splats: np.ndarray, steps: int, core: np.ndarray | None = None) -> np.ndarray:
    """Splats [P] bool and those that touch one of them, some steps far; ``core``: where they grow, None: around."""
    rows = _near(scene, splats if core is None else core, steps)
    grown = splats[rows]
    own, near = touching_pairs(scene.splats, rows)
    for _ in range(steps):
        more = grown.copy()
        more[near[grown[own]]] = True
        more[own[grown[near]]] = True
        grown = more
    whole = splats.copy()
    whole[rows] = grown
    return whole


def _near(scene: OpenedLift, splats: np.ndarray, steps: int) -> np.ndarray:
    """[n] i64, those splats around some [P] bool among which neighbours are looked for.

    Raises:
        InvalidQuery: they are too many.
    """
    if not splats.any():
        return np.zeros(0, np.int64)
    places = scene.axes[:, splats]
    low, high = places.min(axis=1, keepdims=True), places.max(axis=1, keepdims=True)
    size = float(np.exp(np.quantile(scene.splats.log_scales.cpu().numpy().max(axis=1), MOST_SIZES)))
    reach = BESIDE * (high - low).max() + 2 * REACH * size * steps
    rows = np.flatnonzero(((scene.axes >= low - reach) & (scene.axes <= high + reach)).all(axis=0))
    if len(rows) > MOST_SPLATS:
        expected = f"a selection with at most {MOST_SPLATS:,} splats around it"
        raise InvalidQuery("selection", expected=expected, got=f"{len(rows):,}", hint="take a smaller one")
    return rows


def _booleans(scene: OpenedLift, splats: Any) -> np.ndarray:
    splats = np.asarray(splats)
    if splats.dtype != np.bool_ or splats.shape != (len(scene.features),):
        expected = f"a boolean for each of {len(scene.features)} splats"
        raise InvalidQuery("splats", expected=expected, got=f"{splats.dtype} {list(splats.shape)}")
    return splats


def _weights(scene: OpenedLift, rows: np.ndarray) -> np.ndarray:
    weights = scene.evidence[rows].astype(np.float64)
    return weights if weights.any() else np.ones(len(rows))
