"""Models of queries of a lift and of their answers, for Python, the command line and HTTP.

The fields of `Query` are the parameters and bodies of HTTP, the JSON lines of its worker and the options of the
command line; those of `Answer` are HTTP's replies, and ``answer`` of ``--json``. A field is declared here alone.
Nothing here imports numpy or torch, which help and the HTTP process do not need.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, get_args

from pydantic import BeforeValidator, ConfigDict, Field, PlainSerializer, PrivateAttr, model_validator

from liftcore.errors import InvalidQuery
from liftcore.query.terms import NOTATIONS, SETS, Example, SplatSet, Term, Vector, parse_example, parse_set
from liftcore.runtime.fields import Body, NoBoolean, PlainModel, takes
from liftcore.scene.compositing import MAX_SIDE
from liftcore.scene.world import WorldFrame

if TYPE_CHECKING:
    import numpy as np

    from liftcore.scene.cameras import Camera

MOST_TERMS = 64  # for and against together
MOST_INSTANCES = 100
VIEW_CHARACTERS = 500  # of a view's name, so that it fits a query string
Point = tuple[float, float, float]  # x y z, world frame, scene units


def _several(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _examples(value: Any) -> Any:
    """Convert examples to JSON: notations, and vectors as numbers."""
    if isinstance(value, str | Example):
        return [_json_of(value)]
    if hasattr(value, "ndim"):
        value = value.tolist() if value.ndim == 2 else [value.tolist()]
    return list(map(_json_of, value)) if isinstance(value, list | tuple) else value


def _json_of(example: Any) -> Any:
    if isinstance(example, Vector):
        return example.values
    return str(example) if isinstance(example, Example) else example


def as_own_camera(value: Any) -> Any:
    return OwnCamera.of(value) if hasattr(value, "K") else value


MOST_CHARACTERS = 4096  # of an example: a stroke of some hundred corners
EXAMPLES = f"{NOTATIONS}, of at most {MOST_CHARACTERS} characters, or a vector"
Notation = Annotated[str, Field(min_length=1, max_length=MOST_CHARACTERS, description=NOTATIONS)]
Numbers = Annotated[tuple[float, ...], Field(min_length=1)]
Texts = Annotated[list[str], BeforeValidator(_several)]
Examples = Annotated[list[Annotated[Notation | Numbers, takes(EXAMPLES)]], BeforeValidator(_examples)]
Sets = Annotated[
    list[Annotated[str, Field(min_length=1, max_length=120, description=SETS)]], BeforeValidator(_several)
]
Method = Literal["auto", "paper"]
METHODS: tuple[str, ...] = get_args(Method)
Score = Annotated[float, Field(ge=-1, le=1), NoBoolean]  # a cosine, which NaN is not
Cut = Annotated[Method | Score, takes(f"{', '.join(METHODS)}, or a number from -1 to 1")]
Count = Annotated[int, Field(ge=1, le=MOST_INSTANCES), NoBoolean]
ViewName = Annotated[str, Field(min_length=1, max_length=VIEW_CHARACTERS)]
Coordinate = Annotated[float, Field(allow_inf_nan=False), NoBoolean]
Pixels = Annotated[int, Field(ge=1, le=MAX_SIDE), NoBoolean]
Row4 = Annotated[list[Coordinate], Field(min_length=4, max_length=4)]
Rendered = Literal["rgb", "depth", "pca", "cluster", "confidence"]


class OwnCamera(Body):
    """A camera that no file has, in the frame of the splats; an entry of GET /lifts/{lift}/views is one, too."""

    width: Pixels = Field(description="pixels")
    height: Pixels
    fx: Coordinate = Field(description="pixels, like fy, cx and cy")
    fy: Coordinate | None = Field(default=None, description="fx if left out")
    cx: Coordinate | None = Field(default=None, description="from the left edge; the middle if left out, as cy")
    cy: Coordinate | None = None
    viewmat: Annotated[list[Row4], Field(min_length=4, max_length=4)] = Field(
        description="[4, 4], world to camera, rigid; OpenCV axes: x right, y down, z forward"
    )
    name: ViewName = "camera"
    lifted: bool | None = Field(default=None, description="of no meaning here, like photo")
    photo: bool | None = None

    @classmethod
    def of(cls, camera: Camera, name: str = "") -> Self:
        """Return the model of a camera; of a distorted photo that of the pinhole that renders it."""
        numbers = {"fx": camera.fx, "fy": camera.fy, "cx": camera.K[0, 2].item(), "cy": camera.K[1, 2].item()}
        size = {"width": camera.width, "height": camera.height}
        return cls(name=name or camera.name or "camera", viewmat=camera.viewmat.tolist(), **size, **numbers)

    def camera(self) -> Camera:
        """Return the camera for rendering.

        Raises:
            InvalidCameras: its numbers are no valid pinhole.
        """
        from liftcore.scene.cameras import Camera

        fy = self.fx if self.fy is None else self.fy
        cx, cy = (side / 2 if at is None else at for at, side in ((self.cx, self.width), (self.cy, self.height)))
        return Camera.pinhole(self.name, self.width, self.height, self.fx, fy, cx, cy, self.viewmat)


class Viewpoint(Body):
    """Viewpoint of a picture: a view or a camera."""

    view: ViewName | None = Field(
        default=None, description="the name of a camera, for pictures and for links to them"
    )
    camera: Annotated[OwnCamera | None, BeforeValidator(as_own_camera)] = Field(
        default=None, description="for pictures, in place of a view"
    )

    def seen_from(self) -> str | Camera:
        """Return the camera of a picture.

        Raises:
            InvalidQuery: neither a view nor a camera, or both.
        """
        if (self.view is None) == (self.camera is None):
            got = "nothing" if self.view is None else "both"
            raise InvalidQuery("view", expected="a view's name or a camera", got=got)
        return self.camera.camera() if self.camera is not None else str(self.view)


class Picture(Viewpoint):
    """A picture of the scene."""

    channel: Rendered = Field(
        default="rgb",
        description="the splats' colours, expected depth, three principal components of features, clusters, or how "
        "far views agree",
    )


class Query(Viewpoint):
    """Query of a lift: words and examples of the target, positive and negative, and options of the search.

    Texts need an encoder of the lift's text space, examples need none. The scores are defined in
    ``liftcore.query.scores.combine``.

    Raises:
        InvalidQuery: no positive, too many terms, an unknown choice, or a number out of its range.
    """

    model_config = ConfigDict(frozen=True)
    error_type: ClassVar = InvalidQuery

    text: Texts = Field(default=[], description="what to look for; may be given several times")
    like: Examples = Field(
        default=[], description=f"an example of it: {NOTATIONS}, or a vector; may be given several times"
    )
    negatives: Texts = Field(default=[], description="what it is not; may be given several times")
    unlike: Examples = Field(default=[], description="an example of what it is not, likewise")
    sets: Sets = Field(
        default=[],
        description=f"{SETS}: splats that belong together, taken as they are, without texts and examples; "
        "may be given several times",
    )
    threshold: Cut = Field(
        default="auto",
        description=f"{', '.join(METHODS)} or a number from -1 to 1: how to find it, or the score from which a splat "
        "counts as found",
    )
    instances: Count | None = Field(default=None, description="number of objects to keep, the best ones")
    min_size: Annotated[int, Field(ge=1, le=10**9), NoBoolean] = Field(
        default=1, description="objects of fewer splats are outliers"
    )
    keep: Literal["all", "largest"] = Field(
        default="all", description="of what was found, in masks, splats and objects"
    )
    absent: Literal["drop", "keep"] = Field(
        default="drop", description="words for what is not there: select nothing for them, or what is most like them"
    )
    top: Annotated[int, Field(ge=0, le=1000), NoBoolean] = Field(
        default=10, description="number of best splats to list"
    )

    @classmethod
    def of(cls, positives: Iterable[Term] | str, negatives: Iterable[Term] | str = (), **options: Any) -> Self:
        """Return a query of terms, each a text or an example; texts come before examples."""
        sides = [list(_several(terms)) for terms in (positives, negatives)]
        (text, like), (against, unlike) = (
            ([term for term in side if isinstance(term, str)], [term for term in side if not isinstance(term, str)])
            for side in sides
        )
        return cls(text=text, like=like, negatives=against, unlike=unlike, **options)

    @model_validator(mode="after")
    def _asks(self) -> Self:
        against = bool(self.negatives or self.unlike)
        if self.sets and (self.text or self.like or against):
            hint = "ask for like=object:N to find what is like one"
            raise InvalidQuery("sets", expected="sets without texts and examples", got="both", hint=hint)
        if not self.sets and not (self.text or self.like):
            raise InvalidQuery(
                "query", expected="a text or an example of what to look for",
                got="only what it is not" if against else "neither",
                hint="say what to look for, too" if against else "",
            )  # fmt: skip
        count = sum(map(len, (self.text, self.like, self.negatives, self.unlike, self.sets)))
        if count > MOST_TERMS:
            raise InvalidQuery("query", expected=f"at most {MOST_TERMS} texts, examples and sets", got=str(count))
        return self

    @classmethod
    def deciding(cls) -> list[str]:
        """Return the fields that decide the selection; the others decide its listing and viewpoint."""
        return [name for name in cls.model_fields if name not in {*Viewpoint.model_fields, "top"}]

    @cached_property
    def positives(self) -> tuple[Term, ...]:
        """Texts and examples of the target."""
        return (*self.text, *_parse_examples(self.like, "like"))

    @cached_property
    def terms(self) -> tuple[Term, ...]:
        """Positives, then negatives."""
        return (*self.positives, *self.negatives, *_parse_examples(self.unlike, "unlike"))

    @cached_property
    def splat_sets(self) -> tuple[SplatSet, ...]:
        """The sets of splats that are selected as they are."""
        return tuple(parse_set(notation, f"sets.{place}") for place, notation in enumerate(self.sets))

    @cached_property
    def places(self) -> list[str]:
        """The field and index of each of the terms, for errors."""
        names = ("text", "like", "negatives", "unlike")
        return [f"{name}.{place}" for name in names for place in range(len(getattr(self, name)))]

    @property
    def keeps_some(self) -> bool:
        """True if the query keeps some of the objects only, by size, scores or number."""
        return self.keep == "largest" or self.instances is not None or self.min_size > 1

    @property
    def texts(self) -> list[str]:
        """The texts among the terms, in their order."""
        return [*self.text, *self.negatives]


def _parse_examples(examples: list[Any], field: str) -> list[Example]:
    return [
        parse_example(example, f"{field}.{place}") if isinstance(example, str) else Vector(tuple(example))
        for place, example in enumerate(examples)
    ]


Corner = Annotated[tuple[Coordinate, Coordinate, Coordinate], Field(description="x y z")]


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, world frame."""

    # The same in requests and answers, as generators of clients want one class of a name.
    __pydantic_config__: ClassVar = ConfigDict(extra="forbid")
    low: Corner
    high: Corner

    def __iter__(self) -> Iterator[Point]:
        return iter((self.low, self.high))


class Value(PlainModel):
    """A part of an answer."""

    model_config = ConfigDict(frozen=True, defer_build=True)

    def __eq__(self, other: object) -> bool:
        """Compare the fields of JSON; per-splat arrays are not compared."""
        return isinstance(other, Value) and type(self) is type(other) and dict(self) == dict(other)

    def __hash__(self) -> int:
        return hash(repr(self))

    def replace(self, **fields: Any) -> Self:
        """Return a copy with other values of some fields, which are not checked."""
        return self.model_copy(update=fields)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


class Threshold(Value):
    """Threshold on the scores, and its explanation."""

    value: Annotated[
        float,
        BeforeValidator(lambda value: math.inf if value is None else value),
        PlainSerializer(_finite, return_type=float | None, when_used="json"),
        Field(description="null if no score is clearly higher, or the target is absent"),
    ]
    method: str = Field(description="that of the query; `fixed` for a number, `set` for sets")
    explanation: str = Field(description="one sentence on how it was found")
    clear: bool = Field(default=True, exclude=True)  # True if the method has a clear result


class Presence(Value):
    """Presence of the target in the scene."""

    present: bool | None = Field(description="true if the target is in the scene; null if unknown or uncertain")
    presence: float | None = Field(
        description="share of its best splats where few other words are nearer, present from .5 on; null if unknown"
    )
    reason: str = Field(description="one sentence on how it is known whether it is there, or why it is not")


class SelectionSummary(Presence):
    """Threshold, size and clarity of a selection."""

    threshold: Threshold
    count: int = Field(description="splats that were selected")
    clear: bool = Field(description="true if the selection is clearly separate from the rest")


NodeKind = Literal["object", "part", "group"]


class Candidate(Value):
    """A node of the lift's tree that a click, or a part without a word, may mean."""

    id: int
    set: str = Field(description="its notation, for sets")
    kind: NodeKind
    splats: int = Field(description="number of splats")
    share: float = Field(description="share of the weight at the pixel; for words, of the object's total weight")
    confidence: float | None = Field(description="of the views that see it, the share that has a mask of the whole")


class TopSplat(Value):
    """One of the best splats."""

    splat: int = Field(description="row in the splat file")
    score: float
    position: Point = Field(description="x y z, world frame")


class WordMatch(Value):
    """A text that is no word of the encoder's table, and a word that stands for it; several for a list."""

    text: str
    word: str = Field(description="for a part: that part of the object in which it is searched")
    match: Literal[
        "spelling", "qualifier", "synonym", "number", "head", "part", "list", "negation", "quotes"
    ] = Field(
        description="the kind of match: letters, a word that says which is meant, meaning, one or several, the head "
        "of a phrase, a part that it names, one of several that it names, one that a negation excludes, or what is "
        "in quotes"
    )  # fmt: skip


class SuggestedWord(Value):
    """A word that completes a text."""

    word: str
    typed: str = Field(description="the match of the text: the word itself, or a synonym")


class SuggestedWords(Value):
    """Words that complete a text, and words of the lift's objects."""

    open_vocabulary: bool = Field(description="true if any text can be queried, not the words of a table alone")
    words: tuple[SuggestedWord, ...] = Field(description="those that a text may become, the likeliest first")
    scene_words: tuple[str, ...] = Field(description="words for the objects that the lift found by masks alone")


class Answer(SelectionSummary):
    """Answer to a query: scores and the selected splats, with candidates and competing words."""

    text: list[str]
    like: list[str] = Field(description="the examples, in their notation; vectors by their length")
    wording: tuple[WordMatch, ...] = Field(
        default=(), description="texts that another word stands for; words of the table stand for themselves"
    )
    rivals: tuple[str, ...] = Field(
        default=(),
        description="words that are nearer to what was found, or most like it; of a clear answer to most of it; "
        "of a kind that is not there, its members that are",
    )
    statistics: Mapping[str, Any] = Field(description="least, largest and mean score of the splats with a feature")
    top: tuple[TopSplat, ...] = ()
    candidates: tuple[Candidate, ...] = Field(
        default=(),
        description="for clicks: the nested objects that they may mean, the smallest first; for a part that no word "
        "stands for: the parts of its object, the largest first",
    )
    box: Box | None = Field(default=None, description="around all selected splats, outliers too: see objects")
    _query: Query = PrivateAttr()
    _arrays: tuple[np.ndarray, np.ndarray, np.ndarray] = PrivateAttr()
    _objects: Objects | None = PrivateAttr(None)  # cached by `liftcore.query.objects.objects`

    @classmethod
    def of(
        cls, query: Query, scores: np.ndarray, has_feature: np.ndarray, selected: np.ndarray, **fields: Any
    ) -> Self:
        """Return an answer with its query and per-splat arrays, which JSON leaves out."""
        answer = cls(
            text=query.text,
            like=[example if isinstance(example, str) else str(Vector(example)) for example in query.like],
            count=int(selected.sum()),
            **fields,
        )
        answer._query, answer._arrays = query, (scores, has_feature, selected)
        return answer

    def with_selected(self, selected: np.ndarray, query: Query, **fields: Any) -> Self:
        """Return the answer with other selected splats [P] bool, as that to another query, with other fields."""
        answer = self.replace(**{"text": query.text, "count": int(selected.sum())} | fields)
        answer._query, answer._arrays = query, (self.scores, self.has_feature, selected)
        answer._objects = None
        return answer

    @property
    def query(self) -> Query:
        """The query of this answer."""
        return self._query

    @property
    def scores(self) -> np.ndarray:
        """[P] f32 in -1..1 (`liftcore.query.scores.combine`); the minimum for splats without a feature."""
        return self._arrays[0]

    @property
    def has_feature(self) -> np.ndarray:
        """[P] bool, True if a splat has a feature; for sets all are."""
        return self._arrays[1]

    @property
    def selected(self) -> np.ndarray:
        """[P] bool, the splats that answer (`liftcore.query.ask`)."""
        return self._arrays[2]

    @property
    def is_dropped(self) -> bool:
        """True if the target is absent and the query drops absent words: nothing is selected or shown."""
        return self.present is False and self.query.absent == "drop"


class WithUnits(Value):
    """World frame and unit of sizes and distances: metres if the length of a scene unit is known."""

    world: WorldFrame = Field(description="up axis and length of a scene unit, as far as they are known")
    unit: Literal["metres", "scene units"] = Field(
        description="of sizes and gaps; places and boxes are in scene units"
    )


class SelectedObject(Value):
    """A group of touching selected splats."""

    splats: int = Field(description="number of splats")
    share: float = Field(description="of the total weight of all selected splats")
    score: float = Field(description="the mean of its splats' scores, by the same")
    centre: Point = Field(description="the middle of its box: x y z, world frame")
    box: Box = Field(description="of its splats' centres, but for a thousandth of the total weight at each end")
    size: Point = Field(description="the sides of its box, in `unit`")


class Objects(WithUnits):
    """Objects of an answer."""

    objects: tuple[SelectedObject, ...] = Field(description="those with the largest total weight first")
    unassigned_splats: int = Field(description="the number of selected splats in none of them")
    _numbers: np.ndarray = PrivateAttr()

    @classmethod
    def of(
        cls, objects: Iterable[SelectedObject], numbers: np.ndarray, unassigned_splats: int, world: WorldFrame
    ) -> Self:
        """Return objects with the index of each splat's object, which JSON leaves out."""
        groups = cls(objects=tuple(objects), unassigned_splats=unassigned_splats, world=world, unit=world.unit)
        groups._numbers = numbers
        return groups

    @property
    def numbers(self) -> np.ndarray:
        """[P] i32, the index in ``objects`` of each splat's object; -1 for none."""
        return self._numbers


class NamedSplats(Value):
    """A present word, with its splats and its value and colour in pictures."""

    word: str
    row: int = Field(description="index among the words of the query")
    value: int = Field(description="of its splats and pixels in labels and maps; 0 is none")
    colour: tuple[int, int, int] = Field(description="sRGB, 0 to 255, in pictures")
    splats: int = Field(description="number of its splats")
    share: float = Field(description="of the total weight of all splats with a feature")
    score: float = Field(description="the mean cosine of its splats, by total weight")
    margin: float = Field(description="the mean of how much nearer they are to it than to the nearest other word")
    threshold: float = Field(description="of its cosines")
    box: Box = Field(description="of its splats' centres, but for a thousandth of the total weight at each end")


class LabelSummary(Value):
    """The words of a vocabulary that are in the scene."""

    word_count: int = Field(description="the number of words of the query")
    splats: int = Field(description="P")
    none: int = Field(description="the number of splats without a word")
    named_words: tuple[NamedSplats, ...] = Field(
        description="the words that are there, those with the largest total weight first"
    )


class BestWord(Value):
    """A word and its cosine to an example."""

    word: str
    score: float = Field(description="their cosine")


class BestWords(Value):
    """The words most similar to an example."""

    example: str
    words: tuple[BestWord, ...] = Field(description="the nearest first")


class SceneNode(Value):
    """An object on which masks of many views agree, a part of one, or a group of objects."""

    id: int = Field(description="the same for the same lift; 0 is the object with the largest total weight")
    name: str | None = Field(description="the nearest word of the vocabulary; null without one")
    score: float | None = Field(description="its cosine with the node's mean feature")
    splats: int = Field(description="number of splats")
    share: float = Field(description="of the total weight of all splats")
    centre: Point = Field(description="the middle of its box: x y z, frame of the splat file")
    box: Box = Field(description="of its large groups of splats that touch, without outliers elsewhere")
    size: Point = Field(description="the sides of its box, in `unit`")
    views: tuple[str, ...] = Field(description="that show most of it, the best first")
    kind: NodeKind
    parent: int | None = Field(description="the node that it is a part of; null where it is of none")
    path: tuple[int, ...] = Field(description="the nodes that hold it, the largest first, and itself")
    parts: tuple[int, ...] = Field(description="the nodes that are its parts, the largest total weight first")
    confidence: float | None = Field(
        description="of the views that see it, the share that has a mask of the whole; null in a lift without a tree"
    )


class SceneTree(WithUnits):
    """Objects, their parts and groups of them, or some of these; the first are the objects."""

    explanation: str = Field(description="why there are so many; or why there are none")
    count: int = Field(description="of all pages")
    nodes: tuple[SceneNode, ...]

    @property
    def objects(self) -> tuple[SceneNode, ...]:
        """The objects among the nodes, those with the largest total weight first."""
        return tuple(node for node in self.nodes if node.kind == "object")


def page_fields() -> dict[str, Any]:
    """Return the JSON schema of each field that decides the answer, for the page."""
    fields = Query.model_json_schema()["properties"]
    return {name: fields[name] for name in Query.deciding()}
