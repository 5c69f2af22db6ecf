"""Terms of a query: words, and examples of the target.

Examples stand in place of words, "more of this":

| notation | the feature |
|---|---|
| `VIEW:x,y` | of a pixel of a camera, ``sum_j A_ij x_j``; any camera, lifted or not |
| `VIEW:box:x0,y0,x1,y1` | common to the pixels of a box, and not around it; columns x0 up to x1 without x1 |
| `VIEW:stroke:x0,y0,x1,y1,...` | common to the pixels on the line through these corners, two or more |
| `splat:J` | the feature of a splat, by its row in the splat file |
| `object:N` | the mean of an object's features, by its number in the lift (`liftcore.query.catalogue`) |
| `selection:NAME` | the mean of the features of a selection (`liftcore.query.selections`) |

`liftcore.query.areas` computes features of boxes and strokes. A vector has no notation. Names of views may contain
colons and commas: the notation is parsed from its end.
"""

import re
from dataclasses import dataclass

from liftcore.errors import InvalidQuery

SETS = "object:N or selection:NAME"
NOTATIONS = f"VIEW:x,y, VIEW:box:x0,y0,x1,y1, VIEW:stroke:x0,y0,x1,y1,..., splat:J, {SETS}"
_PIXEL = re.compile(r"(.+):\s*(-?\d{1,9})\s*,\s*(-?\d{1,9})\s*", re.ASCII | re.DOTALL)
_AREA = re.compile(r"(.+):(box|stroke):([^:]*)", re.ASCII | re.DOTALL)
AREAS = (":box", ":stroke")  # ends of a pixel's view that look like an area without its corners
_INTEGER = re.compile(r"\s*-?\d{1,9}\s*", re.ASCII)
_SPLAT = re.compile(r"splat:(\d{1,18})", re.ASCII)
_SET = re.compile(r"object:(?P<object>\d{1,9})|selection:(?P<selection>[^:,]{1,100})", re.ASCII)


@dataclass(frozen=True)
class Pixel:
    """A pixel of a camera's image."""

    view: str  # the name of a camera
    x: int  # column of the camera's image, from the left
    y: int  # row, from the top

    def __str__(self) -> str:
        return f"{self.view}:{self.x},{self.y}"


@dataclass(frozen=True)
class PixelBox:
    """A box of a camera's image; what is also around it does not count."""

    view: str  # the name of a camera
    x0: int  # its first column, from the left
    y0: int  # its first row, from the top
    x1: int  # the column after its last one
    y1: int  # the row after its last one

    def __str__(self) -> str:
        return f"{self.view}:box:{self.x0},{self.y0},{self.x1},{self.y1}"


@dataclass(frozen=True)
class Stroke:
    """A line that is drawn on a camera's image."""

    view: str  # the name of a camera
    pixels: tuple[tuple[int, int], ...]  # column and row of its corners, two or more

    def __str__(self) -> str:
        return f"{self.view}:stroke:{','.join(f'{x},{y}' for x, y in self.pixels)}"


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


Area = Pixel | PixelBox | Stroke  # of a camera's image
Example = Area | SplatTerm | SplatSet | Vector
Term = str | Example  # a text, or an example


def parse_example(notation: str, argument: str = "like") -> Example:
    """Read the notation of an example.

    Pixels are tried first, so a camera may be called "splat" or "v:box".

    Args:
        notation: as in the table above.
        argument: that errors name.

    Raises:
        InvalidQuery: it is none of these notations.
    """
    if pixel := _PIXEL.fullmatch(notation):
        return Pixel(pixel[1], int(pixel[2]), int(pixel[3]))
    if splat := _SPLAT.fullmatch(notation):
        return SplatTerm(int(splat[1]))
    if members := _SET.fullmatch(notation):
        return _splat_set(members)
    if area := _AREA.fullmatch(notation):
        return _area(notation, area, argument)
    raise InvalidQuery(argument, expected=NOTATIONS, got=repr(notation[:120]))


def parse_set(notation: str, argument: str = "sets") -> SplatSet:
    """Parse the notation of a set of splats; InvalidQuery if it is none."""
    if members := _SET.fullmatch(notation):
        return _splat_set(members)
    raise InvalidQuery(argument, expected=SETS, got=repr(notation[:120]))


def _splat_set(parts: re.Match[str]) -> SplatSet:
    kind, name = next((kind, name) for kind, name in parts.groupdict().items() if name is not None)
    return SplatSet(kind, str(int(name)) if kind == "object" else name)


def _area(notation: str, parts: re.Match[str], argument: str) -> PixelBox | Stroke:
    view, kind, coordinates = parts.groups()
    numbers = [int(text) for text in coordinates.split(",") if _INTEGER.fullmatch(text)]
    corners = tuple(zip(numbers[::2], numbers[1::2], strict=False))
    if (
        len(numbers) < coordinates.count(",") + 1
        or len(numbers) % 2
        or len(corners) < 2
        or (kind == "box" and len(corners) > 2)
    ):
        expected = f"{kind}:x0,y0,x1,y1{'' if kind == 'box' else ',...'}, whole numbers of pixels"
        raise InvalidQuery(argument, expected=expected, got=repr(notation[:120]))
    return PixelBox(view, *corners[0], *corners[1]) if kind == "box" else Stroke(view, corners)
