"""What is asked: words and examples, for and against, and how to find where they are.

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
from pathlib import Path

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.threshold import check_method

NOTATIONS = "VIEW:x,y, region:VIEW:LEVEL:ID or splat:J"
KEPT = ("all", "largest")
ABSENT = ("drop", "keep")
WEIGH = ("evidence", "confidence")
MOST_TERMS = 64  # for and against together
MOST_INSTANCES = 100
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


@dataclass(frozen=True)
class Query:
    """Positives and negatives make one query; each is a text or an example.

    Texts need an encoder of the lift's text space, examples need none. The scores are defined in
    ``liftcore.query.scores.combine``.

    Raises:
        InvalidQuery: no positive, too many terms, an unknown choice, or instances that it cannot count.
    """

    positives: tuple[Term, ...]
    negatives: tuple[Term, ...] = ()
    threshold: str | float = "auto"  # a method of liftcore.query.threshold, or a number on the scores
    instances: int | None = None  # how many there are, where the user knows: so many objects are kept, the best
    keep: str = "all"  # of the objects that are found: all, or the largest alone
    absent: str = "drop"  # words for what is not there: drop them, or keep what is most like them
    weigh: str = "evidence"  # what a splat counts by in histograms and objects: evidence, or that times confidence
    names: tuple[str, ...] = ()  # what errors call each of the terms; () = what they are themselves

    def __post_init__(self) -> None:
        if not self.positives:
            raise InvalidQuery(
                "query", expected="a text or an example of what to look for",
                got="only what it is not" if self.negatives else "neither",
                hint="say what to look for, too" if self.negatives else "",
            )  # fmt: skip
        count = len(self.terms)
        if count > MOST_TERMS:
            raise InvalidQuery("query", expected=f"at most {MOST_TERMS} texts and examples", got=str(count))
        for name, known in (("keep", KEPT), ("absent", ABSENT), ("weigh", WEIGH)):
            if (chosen := getattr(self, name)) not in known:
                raise InvalidQuery(name, expected=f"one of {', '.join(known)}", got=repr(chosen))
        if self.instances is not None and not 1 <= self.instances <= MOST_INSTANCES:
            raise InvalidQuery("instances", expected=f"1 to {MOST_INSTANCES}", got=str(self.instances))
        check_method(self.threshold)

    @property
    def terms(self) -> tuple[Term, ...]:
        """Positives, then negatives."""
        return (*self.positives, *self.negatives)

    @property
    def keeps_some(self) -> bool:
        """Whether some of the objects are kept and others not, as all else than strays is."""
        return self.keep == "largest" or self.instances is not None

    @property
    def texts(self) -> list[str]:
        """The texts among the terms, in their order."""
        return [term for term in self.terms if isinstance(term, str)]


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


def read_vector(path: Path) -> Vector:
    """The vector of a ``.npy`` file, [F] or [1, F] of any number type.

    Raises:
        InvalidFeatures: no such file, or no array of numbers in it; a pickle is never opened.
        InvalidQuery: the array is no vector.
    """
    from liftcore.io.npy import open_npy

    values = open_npy(path)
    if values.shape not in ((values.size,), (1, values.size)):
        raise InvalidQuery(str(path), expected="one vector, [F] or [1, F]", got=f"the shape {list(values.shape)}")
    return Vector(tuple(values.reshape(-1).astype(np.float64).tolist()))
