"""Terms of a query: words, and examples of the target.

Examples stand in place of words, "more of this":

| notation | the feature |
|---|---|
| `VIEW:x,y` | of a pixel of a camera, ``sum_j A_ij x_j``; any camera, lifted or not |
| `VIEW:box:x0,y0,x1,y1` | common to the pixels of a box, and not around it; columns x0 up to x1 without x1 |
| `VIEW:stroke:x0,y0,x1,y1,...` | common to the pixels on the line through these corners, two or more |
| `splat:J` | the feature of a splat, by its row in the splat file |
| `object:N` | the mean of an object's features, by its number in the lift (`liftcore.query.tree`) |
| `selection:NAME` | the mean of the features of a selection (`liftcore.query.selections`) |

`liftcore.query.areas` computes features of boxes and strokes. A vector has no notation. Names of views may contain
colons and commas: the notation is parsed from its end.
"""

import math
import re
from dataclasses import dataclass

from liftcore.errors import InvalidQuery

SETS = "object:N or selection:NAME"
NOTATIONS = f"VIEW:x,y, VIEW:box:x0,y0,x1,y1, VIEW:stroke:x0,y0,x1,y1,..., splat:J, {SETS}"
_NUMBER = r"\s*-?\d{1,9}\s*"
_AREA = re.compile(rf"(.+?)(?::(box|stroke))?:({_NUMBER}(?:,{_NUMBER})*)", re.ASCII | re.DOTALL)
CORNERS = {"pixel": (1, 1), "box": (2, 2), "stroke": (2, math.inf)}  # fewest and most
_SPLAT = re.compile(r"splat:(\d{1,18})", re.ASCII)
_SET = re.compile(r"object:(?P<object>\d{1,9})|selection:(?P<selection>[^:,]{1,100})", re.ASCII)


@dataclass(frozen=True)
class Area:
    """A pixel, a box or a stroke of a camera's image; what is also around a box does not count."""

    view: str  # the name of a camera
    kind: str  # pixel, box or stroke
    corners: tuple[tuple[int, int], ...]  # column and row; of a box its first pixel and the one after its last

    def __str__(self) -> str:
        kind = "" if self.kind == "pixel" else f"{self.kind}:"
        return f"{self.view}:{kind}{','.join(f'{x},{y}' for x, y in self.corners)}"


@dataclass(frozen=True)
class SplatTerm:
    """A splat as an example."""

    splat: int  # its row in the splat file

    def __str__(self) -> str:
        return f"splat:{self.splat}"


@dataclass(frozen=True)
class SplatSet:
    """A set of splats: an object of the lift, or a selection of the scene."""

    kind: str  # object or selection
    name: str  # the object's number, or the selection's name

    def __str__(self) -> str:
        return f"{self.kind}:{self.name}"


@dataclass(frozen=True)
class Vector:
    """A feature vector, of the same encoder as the lift's."""

    values: tuple[float, ...]  # [F], of any length above zero

    def __str__(self) -> str:
        return f"a vector of {len(self.values)} channels"


Example = Area | SplatTerm | SplatSet | Vector
Term = str | Example  # a text, or an example


def parse_example(notation: str, argument: str = "like") -> Example:
    """Read the notation of an example.

    Args:
        notation: as in the table above.
        argument: that errors name.

    Raises:
        InvalidQuery: it is none of these notations.
    """
    if splat := _SPLAT.fullmatch(notation):
        return SplatTerm(int(splat[1]))
    if members := _SET.fullmatch(notation):
        return _splat_set(members)
    if area := _AREA.fullmatch(notation):
        kind, numbers = area[2] or "pixel", list(map(int, area[3].split(",")))
        minimum, maximum = CORNERS[kind]
        if len(numbers) % 2 == 0 and minimum <= len(numbers) // 2 <= maximum:
            return Area(area[1], kind, tuple(zip(numbers[::2], numbers[1::2], strict=True)))
    raise InvalidQuery(argument, expected=NOTATIONS, got=repr(notation[:120]))


def parse_set(notation: str, argument: str = "sets") -> SplatSet:
    """Parse the notation of a set of splats; InvalidQuery if it is none."""
    if members := _SET.fullmatch(notation):
        return _splat_set(members)
    raise InvalidQuery(argument, expected=SETS, got=repr(notation[:120]))


def _splat_set(parts: re.Match[str]) -> SplatSet:
    kind, name = next((kind, name) for kind, name in parts.groupdict().items() if name is not None)
    return SplatSet(kind, str(int(name)) if kind == "object" else name)
