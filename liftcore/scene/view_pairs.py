"""Which camera a view of features or masks is seen by, told from their names alone."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from liftcore.errors import InvalidFeatures

if TYPE_CHECKING:
    from collections.abc import Collection

NAMED_AFTER = (
    "a view is named after its image, without the extension, and with its folders where file names of the scene "
    "repeat (camA/000)"
)


def cameras_of_views(views: Collection[str], cameras: Collection[str]) -> dict[str, str]:
    """View -> camera, of the views that have one.

    Names pair as they are. Else one may have folders before it that the other leaves out, where no other view and no
    other camera has the same last part: ``camA/000`` and ``000``, but never ``train/000`` and ``test/000``.
    """
    known = set(cameras)
    named, seen = Counter(map(_last, views)), Counter(map(_last, cameras))
    alone = {_last(camera): camera for camera in cameras if seen[_last(camera)] == 1}
    pairs = {}
    for view in views:
        other = alone.get(_last(view)) if named[_last(view)] == 1 else None
        if view in known:
            pairs[view] = view
        elif other is not None and (_ends(view, other) or _ends(other, view)):
            pairs[view] = other
    return pairs


def require_pairs(views: Collection[str], cameras: Collection[str]) -> dict[str, str]:
    """`cameras_of_views` of the views of features.

    Raises:
        InvalidFeatures: no view has a camera.
    """
    pairs = cameras_of_views(views, cameras)
    if not pairs:
        raise InvalidFeatures(
            "features",
            expected="views named like the cameras",
            got=f"views {some_of(views)} and cameras {some_of(cameras)}, none in common",
            hint=NAMED_AFTER,
        )
    return pairs


def some_of(names: Collection[str]) -> str:
    """The first few, for an error."""
    return ", ".join(repr(name) for name in sorted(names)[:3])


def _last(name: str) -> str:
    return name.rpartition("/")[2]


def _ends(name: str, end: str) -> bool:
    return name.endswith(f"/{end}")
