"""Transfer of a lift to an edited copy of its splats: cropped, reordered, compressed or thinned.

Each new splat takes the values of the old one that lies nearest. A copy may be quantised, so of the nearest centres
the splat of the most similar size and colour counts.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from liftcore.errors import InvalidSplats
from liftcore.scene.neighbours import COLOUR_WIDTH, base_colours, set_apart
from liftcore.values.lift import NO_FILE, landmarks_of

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats
    from liftcore.values.lift import Lift

    AnyLift = TypeVar("AnyLift", bound=Lift)

NEIGHBOURS = 4  # nearest centres that are compared
REACH = 3.0  # standard deviations of an old splat along its longest axis, to which a new one is a copy of it
LEAST_SHARE = 0.5  # of the new splats that must be copies: fewer are of another scene or frame
_BLOCK = 1 << 16  # new splats at once


def transfer(lift: AnyLift, old: Splats, new: Splats, matrix: Any = None) -> AnyLift:
    """Take a lift's rows to another set of splats of its scene.

    Args:
        lift: it stays as it is. old: that were lifted. new: Q others, in any order. matrix: [4, 4] or [3, 4], the
            similarity from the old frame to the new one; None: they are the same.

    Returns:
        The lift of the new splats. Its diagnostics have ``transfer``: how many are copies of old rows, and how many
        lie near none and have no feature.

    Raises:
        InvalidSplats: other splats than were lifted, or less than half of the new ones are near an old one.
        InvalidInput: the matrix is no similarity.
    """
    lift.require_splats(old)
    lift = lift.cpu()
    if matrix is not None:
        lift, old = lift.transformed(matrix), old.transformed(matrix)
    rows, is_copy = nearest_rows(old, new)
    if is_copy.mean() < LEAST_SHARE:
        got = f"{int(is_copy.sum())} of {new.count} near a lifted one"
        hint = "give the matrix if the scene was moved, or lift the new splats"
        raise InvalidSplats("splats", expected="splats of the lifted scene", got=got, hint=hint)
    result = lift[rows]
    columns = result.columns
    for name, column in columns.items():
        column.numpy()[~is_copy] = -1 if name in ("cluster", "object", "node") else 0
    counts = {"from_splats": len(lift), "rows": int(is_copy.sum()), "without_partner": int((~is_copy).sum())}
    diagnostics = lift.diagnostics | {"transfer": counts}
    if isinstance(plan := diagnostics.get("plan"), dict):
        diagnostics["plan"] = plan | {"kernel": str(new.kernel)}
    changes = {
        "diagnostics": diagnostics, "splats": NO_FILE, "landmarks": landmarks_of(new), "origin": new.origin,
        "settings": lift.settings.model_copy(update={"kernel": str(new.kernel)}),
        "world": new.world.known_or(lift.metadata.world),
    }  # fmt: skip
    return replace(result, **columns, metadata=lift.metadata.model_copy(update=changes))


def nearest_rows(old: Splats, new: Splats) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest old splat of each new one, [Q] i64, and whether it is a copy of it, [Q] bool."""
    from scipy.spatial import KDTree

    centres, places = (splats.positions().astype(np.float64) for splats in (old, new))
    (sizes, styles), (_, new_styles) = map(_sizes_and_styles, (old, new))
    tree, rows, is_copy = KDTree(set_apart(centres)), np.empty(new.count, np.int64), np.empty(new.count, np.bool_)
    for first in range(0, new.count, _BLOCK):
        block = slice(first, first + _BLOCK)
        near = tree.query(places[block], min(NEIGHBOURS, old.count), workers=-1)[1].reshape(len(places[block]), -1)
        distances = np.linalg.norm(places[block, None] - centres[near], axis=2) / sizes[near]
        unlikeness = distances**2 + ((new_styles[block, None] - styles[near]) ** 2).sum(axis=2)
        best = unlikeness.argmin(axis=1)[:, None]
        rows[block] = np.take_along_axis(near, best, axis=1)[:, 0]
        is_copy[block] = np.take_along_axis(distances, best, axis=1)[:, 0] <= REACH
    return rows, is_copy


def _sizes_and_styles(splats: Splats) -> tuple[np.ndarray, np.ndarray]:
    """Return the longest standard deviation of each splat, [P] f64; its logarithm beside its colour, [P, 4] f64."""
    logs = splats.log_scales.cpu().numpy().astype(np.float64).max(axis=1).clip(-30, 30)
    colours = base_colours(splats)
    colours = np.zeros((splats.count, 3)) if colours is None else colours / COLOUR_WIDTH
    return np.exp(logs), np.column_stack([logs, colours])
