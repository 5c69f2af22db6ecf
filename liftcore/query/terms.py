"""Terms of a question: words, and examples of what is looked for.

Examples stand in place of words, "more of this":

| notation | the feature |
|---|---|
| `VIEW:x,y` | what the lift shows at a pixel of a camera, ``sum_j A_ij x_j``; any camera, lifted or not |
| `region:VIEW:LEVEL:ID` | the codebook row of a region, as the lift's feature packs hold it |
| `splat:J` | the feature of a splat, by its row in the splat file |

A vector has no notation. Names of views may hold colons and commas: the notation is read from its end.
"""

import re
from dataclasses import dataclass

from liftcore.errors import InvalidQuery

NOTATIONS = "VIEW:x,y, region:VIEW:LEVEL:ID or splat:J"
_PIXEL = re.compile(r"(.+):\s*(-?\d{1,9})\s*,\s*(-?\d{1,9})\s*", re.ASCII | re.DOTALL)
_REGION = re.compile(r"region:(.+):(\d{1,9}):(\d{1,9})", re.ASCII | re.DOTALL)
_SPLAT = re.compile(r"splat:(\d{1,18})", re.ASCII)


@dataclass(frozen=True)
class Pixel:
    """What a camera's ray meets."""

    view: str  # the name of a camera
    x: int  # column of the camera's image, from the left
    y: int  # row, from the top

    def __str__(self) -> str:
        return f"{self.view}:{self.x},{self.y}"


@dataclass(frozen=True)
class Region:
    """A region of a feature pack that was lifted."""

    view: str  # a view of the packs
    level: int  # of its label map
    region: int  # its label, the row of the view's codebook

    def __str__(self) -> str:
        return f"region:{self.view}:{self.level}:{self.region}"


@dataclass(frozen=True)
class OneSplat:
    """A splat's own feature."""

    splat: int  # its row in the splat file

    def __str__(self) -> str:
        return f"splat:{self.splat}"


@dataclass(frozen=True)
class Vector:
    """A feature from elsewhere, of the encoder that made the lift's."""

    values: tuple[float, ...]  # [F], of any length above zero

    def __str__(self) -> str:
        return f"a vector of {len(self.values)} channels"


Example = Pixel | Region | OneSplat | Vector
Term = str | Example  # a text, or an example


def parse_example(notation: str, argument: str = "like") -> Example:
    """Read the notation of an example.

    A pixel's comma decides first, so a camera named "splat" can be asked too.

    Args:
        notation: as in the table above.
        argument: what to blame.

    Raises:
        InvalidQuery: it is none of them.
    """
    if pixel := _PIXEL.fullmatch(notation):
        return Pixel(pixel[1], int(pixel[2]), int(pixel[3]))
    if region := _REGION.fullmatch(notation):
        return Region(region[1], int(region[2]), int(region[3]))
    if splat := _SPLAT.fullmatch(notation):
        return OneSplat(int(splat[1]))
    raise InvalidQuery(argument, expected=NOTATIONS, got=repr(notation[:120]))
