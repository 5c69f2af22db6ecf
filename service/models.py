"""The JSON that the service takes and gives."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError

from liftcore.scene.distortion import MAX_SIDE
from liftcore.scene.origin import FILE_ORIGIN
from liftcore.values.settings import LiftSettings
from service import limits

# How fields tell of what does not fit: one error, in words, whatever pydantic would make of it

NAME_CHARACTERS = 80  # of a name that a client sent, told back


def one_of(names: Iterable[str]) -> str:
    """What is expected where one of these names is."""
    return f"one of {', '.join(names)}"


def takes(expected: str) -> WrapValidator:
    """Says what a union takes, in one error in place of one for each of its branches."""

    def check(value: Any, branches: ValidatorFunctionWrapHandler) -> Any:
        try:
            return branches(value)
        except ValidationError:
            raise PydanticCustomError("takes", "{expected}", {"expected": expected}) from None

    return WrapValidator(check)


def at_most(characters: int) -> AfterValidator:
    """Bounds a list of texts by what they have together."""

    def check(texts: list[str]) -> list[str]:
        if (got := sum(map(len, texts))) > characters:
            told = {"expected": f"texts of at most {characters} characters together, which are {got}"}
            raise PydanticCustomError("too_long_together", "{expected}", told)
        return texts

    return AfterValidator(check)


def _once(texts: list[str]) -> list[str]:
    return list(dict.fromkeys(texts))


def _no_boolean(value: Any) -> Any:
    if isinstance(value, bool):
        raise PydanticCustomError("no_number", "{expected}", {"expected": "a number"})
    return value


NoBoolean = BeforeValidator(_no_boolean)  # of a number: pydantic reads true as 1


@dataclass(frozen=True)
class Published:
    """Shows a field in the OpenAPI document as a model's own fields, which another module checks in its own words."""

    model: type[BaseModel]
    without: Sequence[str] = ()

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        shown = deepcopy(handler.resolve_ref_schema(handler(self.model.__pydantic_core_schema__)))
        for name in self.without:
            shown["properties"].pop(name)
        del shown["title"]
        return shown


class Body(BaseModel):
    """What a body, or a part of one, may hold. A field that is not known is refused with those that are."""

    model_config = ConfigDict(extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _knows(cls, given: Any) -> Any:
        for name in given if isinstance(given, dict) else ():
            if name not in cls.model_fields:
                # Half a surrogate pair, which JSON can name, would break pydantic's own report.
                shown = name[:NAME_CHARACTERS].encode("utf-8", "backslashreplace").decode()
                told = {"field": shown, "expected": one_of(cls.model_fields)}
                raise PydanticCustomError("unknown_field", "{expected}", told)
        return given


def _bounded(given: Any) -> Any:
    """What is too much to be settings is refused before any of it is looked at."""
    if isinstance(given, dict):
        texts = (text for pair in given.items() for text in pair if isinstance(text, str))
        if len(given) > limits.SETTINGS or any(len(text) > limits.SETTING_CHARACTERS for text in texts):
            told = {
                "expected": f"at most {limits.SETTINGS} settings of at most {limits.SETTING_CHARACTERS} characters"
            }
            raise PydanticCustomError("too_many_settings", "{expected}", told)
    return given


Bounded = BeforeValidator(_bounded)


# What goes in and out

ASSET_ID = r"^sha256:[0-9a-f]{64}$"
JOB_ID = r"^[0-9a-f]{32}$"
COMPARED = "speed"  # what only the runs of a trade-off set
PRINTABLE = r"^[^\x00-\x1f\x7f]*$"

AssetId = Annotated[str, Field(pattern=ASSET_ID, description="sha256: and the digest of the bytes, in hex")]
JobId = Annotated[str, Field(pattern=JOB_ID)]
Text = Annotated[str, Field(min_length=1, max_length=limits.WORD_CHARACTERS)]
# The first thing that is wrong is all that is told: whoever sends a hundred thousand is not answered about each.
Texts = Annotated[list[Text], Field(max_length=limits.ASKED, fail_fast=True), at_most(limits.ASKED_CHARACTERS)]
Scalar = Annotated[bool | int | float | str, takes("a boolean, a number or a text")]


class AssetKind(StrEnum):
    """What an upload is."""

    SPLATS = "splats"
    CAMERAS = "cameras"
    FEATURES = "features"
    MASKS = "masks"  # of views, to judge by
    TABLE = "table"  # of text embeddings
    PHOTOS = "photos"  # of views, to look at


UploadKind = AssetKind | Literal["lift"]


class JobKind(StrEnum):
    """What a job does."""

    LIFT = "lift"
    TRADEOFF = "tradeoff"


class JobState(StrEnum):
    """Where a job is."""

    QUEUED = "queued"
    RUNNING = "running"
    CANCELING = "canceling"  # asked for, and not yet true
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELED = "canceled"


ENDED = frozenset({JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELED})


class Problem(BaseModel):
    """An RFC 9457 problem; the fields after ``detail`` are there when the error names them."""

    type: str = Field(description="a stable URI reference, /problems/ and a slug")
    title: str
    status: int
    detail: str
    argument: str | None = None
    expected: str | None = None
    got: str | None = None
    hint: str | None = None
    request_id: Annotated[str | None, Field(description="as in X-Request-ID; the log has it too")] = None


class Asset(BaseModel):
    """An uploaded file."""

    id: AssetId
    kind: AssetKind
    bytes: int
    counts: dict[str, Any] = Field(description="what is in it: splats, views, channels and so on")
    warnings: list[str]
    created: float = Field(description="seconds since 1970")
    links: dict[str, str]


class Assets(BaseModel):
    """Some of the assets, newest first."""

    assets: list[Asset]
    next: str | None = Field(description="the cursor of the page after this one; null at the end")


class Names(BaseModel):
    """Some of the names of views, or of the words, that an asset holds."""

    names: list[str]
    next: int | None = Field(description="the cursor of the page after this one; null at the end")


class LiftRequest(Body):
    """What to lift. The assets must be here already."""

    splats: AssetId
    cameras: AssetId
    features: Annotated[
        list[AssetId], Field(min_length=1, fail_fast=True), AfterValidator(_once), Field(max_length=limits.PACKS)
    ] = Field(description=f"feature packs, each counts once; at most {limits.PACKS}")
    settings: Annotated[dict[str, Scalar], Bounded, Published(LiftSettings)] = Field(
        default_factory=dict,
        description="preset and knobs of the lift; those left out take the values of the preset and the speed",
        examples=[{"preset": "default", "speed": "balanced"}],
    )


class Labels(Body):
    """Masks of views, and the words that they mean: views with masks are not lifted, and say how good a lift is."""

    masks: AssetId
    table: AssetId
    classes: Annotated[list[Text], Field(min_length=1, max_length=1000, fail_fast=True)] = Field(
        description="words of the table; the first is what masks call 0"
    )


class TradeoffRequest(LiftRequest):
    """What to compare: lifts of these assets, each with another preset or place of the dial."""

    settings: Annotated[dict[str, Scalar], Bounded, Published(LiftSettings, without=(COMPARED,))] = Field(
        default_factory=dict,
        description="of all runs: knobs of the lift beside speed, which is compared; the dial starts from a preset",
        examples=[{"robust_steps": 1}],
    )
    budget_s: Annotated[float, Field(ge=10, le=86_400), NoBoolean] = Field(
        600, description="seconds to plan with; the exact run is made whatever it takes"
    )
    labels: Labels | None = Field(None, description="masks to judge by; without them held-out views are judged by")


class Progress(BaseModel):
    """How far the current stage of a job is."""

    stage: str
    done: int
    total: int
    unit: str
    eta_s: float | None = Field(description="seconds until the end of this stage, at its pace so far")


class Plan(BaseModel):
    """What a lift sets out to do: ``summary``, ``warnings``, and what its certificate will have as ``plan``."""

    model_config = ConfigDict(extra="allow")  # the certificate's numbers

    summary: list[str] = Field(description="the plan for people, a few lines")
    warnings: list[str] = Field(description="of what is lifted, and of what the machine has for it today")


class Job(BaseModel):
    """A lift or a trade-off on its way."""

    id: JobId
    kind: JobKind
    state: JobState
    attempt: int
    splats: AssetId
    cameras: AssetId
    features: list[AssetId]
    settings: dict[str, Any]
    parameters: dict[str, Any] = Field(description="of its kind: budget_s of a trade-off, and its labels")
    plan: Plan | None = Field(description="of a lift, from before its first view is walked; the latest attempt's")
    progress: Progress | None
    problem: Problem | None
    created: float
    started: float | None
    ended: float | None
    request_id: str | None = Field(description="the X-Request-ID of the request that made it")
    links: dict[str, str]


class Jobs(BaseModel):
    """Some of the jobs, newest first."""

    jobs: list[Job]
    next: str | None = Field(description="the cursor of the page after this one; null at the end")


class JobStep(BaseModel):
    """The data of a ``state`` event: where a job came to be."""

    state: JobState
    attempt: int
    problem: Problem | None


class LogLine(BaseModel):
    """The data of a ``log`` event."""

    line: str
    time: float = Field(description="seconds since 1970")


class LiftResult(BaseModel):
    """Features on splats. A lift has the id of the job that made it."""

    id: JobId
    name: str | None = Field(description="that somebody gave it")
    bytes: int
    sha256: str
    splats: AssetId
    cameras: AssetId
    features: list[AssetId]
    photos: AssetId | None = Field(description="of its views, to look at")
    count: int = Field(description="P, the number of splats")
    channels: int = Field(description="F, the number of feature channels")
    version: str
    settings: dict[str, Any]
    encoder: str = Field(description="the 2D encoder that made the features, as their packs tell it")
    text_space: str = Field(description="the text space that the features share")
    words: list[str] = Field(description="that its packs brought: it is asked in these without an encoder")
    views: list[str] = Field(description="the views that were lifted; very many are at links.views alone")
    view_count: int = Field(description="how many these are")
    origin: list[float] = Field(
        list(FILE_ORIGIN),
        min_length=3,
        max_length=3,
        description="of the positions of its `.splat` and `.spz`; zeros but in map coordinates",
    )
    certificate: dict[str, Any]
    timings: dict[str, float] = Field(description="seconds a stage")
    created: float
    links: dict[str, str]


Named = Annotated[str, Field(min_length=1, max_length=limits.SETTING_CHARACTERS, pattern=PRINTABLE)]


class PackChange(Body):
    """Names of a feature pack; what is left out stays as the pack says it."""

    encoder: Named | None = Field(None, description="what made the features")
    text_space: Named | None = Field(None, description="the text encoder that shares their space; 'none' for none")


class LiftChange(Body):
    """What to change of a lift; what is left out stays."""

    name: (
        Annotated[str, Field(max_length=limits.LIFT_NAME_CHARACTERS, pattern=PRINTABLE), AfterValidator(str.strip)]
        | None
    ) = Field(None, description="for people; null or an empty one takes the name away")
    photos: AssetId | None = Field(None, description="an asset of kind photos; null takes them away")


class Lifts(BaseModel):
    """Some of the lifts, newest first."""

    lifts: list[LiftResult]
    next: str | None = Field(description="the cursor of the page after this one; null at the end")


class View(BaseModel):
    """A camera of a lift's scene, in gsplat's conventions: OpenCV axes, pixel centres at +0.5."""

    name: str
    lifted: bool = Field(description="whether its features were lifted")
    photo: bool = Field(description="whether the lift's photos have one of it")
    width: int = Field(description="pixels")
    height: int
    fx: float = Field(description="pixels, like fy, cx and cy")
    fy: float
    cx: float
    cy: float
    viewmat: list[list[float]] = Field(description="[4, 4], world to camera")


class Views(BaseModel):
    """Some of the cameras of a lift's scene, in their file's order."""

    views: list[View]
    next: int | None = Field(description="the cursor of the page after this one; null at the end")


class Tradeoff(BaseModel):
    """Speed against accuracy on a scene, as ``splatlift tradeoff --json`` has it. It has the id of its job."""

    model_config = ConfigDict(extra="allow")  # what else the comparison tells

    id: JobId
    splats: AssetId
    cameras: AssetId
    features: list[AssetId]
    labels: Labels | None = Field(description="the masks that it was judged by")
    runs: list[dict[str, Any]] = Field(description="one for each preset or place of the dial: seconds and accuracy")
    skipped: list[str] = Field(description="what did not fit the budget")
    refused: list[str] = Field(default=[], description="what the order's settings forbid")
    choice: dict[str, Any] = Field(description="which run to take, and why")
    views: dict[str, int] = Field(description="how many were lifted, of how many, and held out")
    budget_s: float
    seconds: float = Field(description="that it took")
    created: float = Field(description="seconds since 1970")
    links: dict[str, str]


class Threshold(BaseModel):
    """Which scores count as found, and why."""

    value: float | None = Field(description="null when no score stands out, or nothing asked for is there")
    method: str
    explanation: str = Field(description="one sentence on how it was found")


class TopSplat(BaseModel):
    """One of the best splats."""

    splat: int = Field(description="row in the splat file")
    score: float
    position: list[float] = Field(description="x y z, world frame")


class Box(BaseModel):
    """An axis-aligned box, world frame."""

    low: list[float] = Field(description="x y z")
    high: list[float]


class FoundObject(BaseModel):
    """Splats at or above the threshold that hang together."""

    splats: int = Field(description="how many")
    share: float = Field(
        description="of the evidence of all splats at or above the threshold, or of what `weigh` says"
    )
    score: float = Field(description="the mean of its splats' scores, by the same")
    centre: list[float] = Field(description="the middle of its box: x y z, world frame")
    box: Box = Field(description="of its splats' centres, but for a thousandth of the evidence at each end")


Notation = Annotated[
    str, Field(min_length=1, max_length=600, description="VIEW:x,y, region:VIEW:LEVEL:ID or splat:J")
]
Vector = Annotated[
    list[Annotated[float, Field(allow_inf_nan=False, strict=True)]],
    Field(min_length=1, max_length=65_536, fail_fast=True),
]
Example = Annotated[
    Notation | Vector,
    takes("VIEW:x,y, region:VIEW:LEVEL:ID, splat:J, or a vector of 1 to 65536 finite numbers"),
]
Examples = Annotated[list[Example], Field(max_length=limits.ASKED, fail_fast=True)]
ViewName = Annotated[str, Field(min_length=1, max_length=limits.VIEW_CHARACTERS, description="the name of a camera")]
Coordinate = Annotated[float, Field(allow_inf_nan=False), NoBoolean]
Pixels = Annotated[int, Field(ge=1, le=MAX_SIDE), NoBoolean]
Score = Annotated[float, Field(ge=-1, le=1), NoBoolean]  # a cosine, which NaN is not
Method = Literal["auto", "valley", "paper", "otsu", "stability"]
Cut = Annotated[Method | Score, takes(f"{', '.join(get_args(Method))}, or a number from -1 to 1")]
Count = Annotated[int, Field(ge=1, le=100), NoBoolean]
Top = Annotated[int, Field(ge=0, le=1000), NoBoolean]


Rendered = Literal["rgb", "depth", "pca", "cluster", "confidence"]
RENDERED = (
    "the splats' colours, expected depth, three principal components of features, clusters, or how far views agree"
)
SplatsOf = Literal["object", "scores"]
SPLATS_OF = "the splats that were found and no others, or all splats in the colours of their scores"


class OwnCamera(Body):
    """A camera that no file has, in the frame of the splats; an entry of GET /lifts/{lift}/views is one, too."""

    width: Pixels = Field(description="pixels")
    height: Pixels
    fx: Coordinate = Field(description="pixels, like fy, cx and cy")
    fy: Coordinate | None = Field(None, description="fx if left out")
    cx: Coordinate | None = Field(None, description="from the left edge; the middle if left out, as cy")
    cy: Coordinate | None = None
    viewmat: Annotated[
        list[Annotated[list[Coordinate], Field(min_length=4, max_length=4)]], Field(min_length=4, max_length=4)
    ] = Field(description="[4, 4], world to camera, rigid; OpenCV axes: x right, y down, z forward")
    name: ViewName = "camera"
    lifted: bool | None = Field(None, description="of no meaning here, like photo")
    photo: bool | None = None


class LiftQuestion(BaseModel):
    """Which lift is asked, and in whose words."""

    lift: JobId | None = Field(None, description="the lift; may be left out when there is exactly one")
    encoder: str | None = Field(
        None, max_length=200, description="a text space that the operator set up, the lift's own, or default"
    )
    table: AssetId | None = Field(None, description="an uploaded text table that has the words, in place of encoder")


class Question(LiftQuestion):
    """What all queries share: the words, and how to find what they mean."""

    text: Texts = Field([], description="what to look for; may be given several times, 4000 characters in all")
    negatives: Texts = Field([], description="what it is not; likewise")
    threshold: Cut = Field("auto", description="how to find it, or the score from which a splat counts as found")
    instances: Count | None = Field(None, description="how many there are: so many objects are kept, the best")
    keep: Literal["all", "largest"] = Field("all", description="of what was found, in masks, splats and objects")
    absent: Literal["drop", "keep"] = Field(
        "drop", description="words for what is not there: select nothing for them, or what is most like them"
    )
    weigh: Literal["evidence", "confidence"] = Field(
        "evidence",
        description="what splats count by in the threshold's histogram and in objects; confidence: times it",
    )


class Asked(Question):
    """A query in a URL."""

    like: list[Notation] = Field([], max_length=limits.ASKED, description="an example; may be given several times")
    unlike: list[Notation] = Field([], max_length=limits.ASKED, description="one of what it is not, likewise")


class AskedWhere(Asked):
    """Where something is."""

    view: ViewName | None = Field(None, description="for the links")
    top: Top = Field(10, description="how many of the best splats to list")


class AskedInView(Asked):
    """Where something is in a view."""

    view: ViewName


class AskedForSplats(Asked):
    """Splats of an answer."""

    what: SplatsOf = Field("object", description=SPLATS_OF)


class AskedInBody(Question, Body):
    """A query in a body, where an example may also be a vector [F]."""

    like: Examples = Field([], description="examples of it, or vectors")
    unlike: Examples = Field([], description="examples of what it is not, likewise")
    view: ViewName | None = Field(None, description="for pictures, and for the links")
    camera: OwnCamera | None = Field(None, description="for pictures, in place of a view")
    top: Top = Field(10, description="how many of the best splats to list")


class Words(LiftQuestion, Body):
    """Many words at once."""

    words: Annotated[list[Text], Field(max_length=limits.WORDS, fail_fast=True)] | None = Field(
        None, description="what may be there, each word once; all words of a table if left out"
    )


class AskedToSegment(Words):
    """Every splat's best word."""

    view: ViewName | None = Field(None, description="for pictures")
    camera: OwnCamera | None = Field(None, description="for pictures, in place of a view")


class AskedWhat(Words):
    """What is this?"""

    example: Example = Field(description="what is meant")
    top: Annotated[int, Field(ge=1, le=1000), NoBoolean] = Field(5, description="how many words")


class AskedToRender(Body):
    """A picture of the scene."""

    lift: JobId | None = Field(None, description="the lift; may be left out when there is exactly one")
    view: ViewName | None = Field(None, description="the name of a camera")
    camera: OwnCamera | None = Field(None, description="in place of a view")
    what: Rendered = Field("rgb", description=RENDERED)


class FoundWord(BaseModel):
    """A word that is there."""

    value: int = Field(description="of its splats and pixels in labels and maps; 0 is none")
    word: str
    splats: int = Field(description="how many it names")
    share: float = Field(description="of the evidence of all seen splats")
    score: float = Field(description="the mean cosine of its splats, by evidence")
    margin: float = Field(description="the mean of how much nearer they are to it than to the nearest other word")
    threshold: float = Field(description="of its cosines")
    colour: list[int] = Field(description="sRGB, 0 to 255, in pictures")
    box: Box = Field(description="of its splats' centres, but for a thousandth of the evidence at each end")


class SegmentAnswer(BaseModel):
    """What is there, of many words."""

    lift: JobId
    encoder: str = Field(description="the text encoder that was asked, without its file")
    words: int = Field(description="how many were asked")
    splats: int = Field(description="P")
    none: int = Field(description="splats that none of the words names")
    found: list[FoundWord] = Field(description="those that are there, with the most evidence first")


class BestWord(BaseModel):
    """How like a word something is."""

    word: str
    score: float = Field(description="their cosine")


class WhatAnswer(BaseModel):
    """The words that something is most like."""

    lift: JobId
    encoder: str
    example: str
    words: list[BestWord] = Field(description="the nearest first")


class QueryAnswer(BaseModel):
    """Where in a scene is what was asked for."""

    text: list[str]
    like: list[str] = Field(description="the examples, in their notation; vectors by their length")
    lift: JobId
    view: str | None
    text_space: str = Field(description="of the lift's features")
    encoder: str | None = Field(description="the text encoder that was asked, without its file; null without a text")
    statistics: dict[str, Any] = Field(description="of the scores over the seen splats")
    threshold: Threshold
    count: int = Field(description="splats that were selected")
    clear: bool = Field(description="whether what was found stands apart")
    present: bool | None = Field(description="whether it is there; null when not known or not sure")
    presence: float | None = Field(description="how sure that is, in 0..1: there from 0.5 on; null when not known")
    why: str = Field(description="one sentence on how it is known whether it is there, or why it is not")
    top: list[TopSplat]
    box: Box | None = Field(description="around all selected splats, strays too: see objects")
    links: dict[str, str]


class ObjectsAnswer(BaseModel):
    """The things that were found."""

    lift: JobId
    threshold: Threshold
    count: int = Field(description="splats that were selected")
    clear: bool = Field(description="whether they stand apart")
    present: bool | None = Field(description="whether they are what was asked for; null when not known or not sure")
    presence: float | None = Field(description="how sure that is, in 0..1: there from 0.5 on; null when not known")
    why: str = Field(description="one sentence on how it is known whether it is there, or why it is not")
    objects: list[FoundObject] = Field(description="those with the most evidence first")
    strays: int = Field(description="selected splats in none of them")


class SceneObject(BaseModel):
    """A thing that masks of many views keep together."""

    id: int = Field(description="the same for the same lift; 0 has the most evidence")
    name: str | None = Field(description="the nearest word of the vocabulary; null without one")
    score: float | None = Field(description="its cosine with the object's mean feature")
    splats: int = Field(description="how many")
    share: float = Field(description="of the evidence of all splats")
    centre: list[float] = Field(description="the middle of its box: x y z, frame of the splat file")
    box: Box = Field(description="of its largest group of splats that touch, without outliers elsewhere")
    views: list[str] = Field(description="that show most of it, the best first")
    feature: list[float] | None = Field(description="with features=true: the mean of its unit features [F], unit")


class CoveringRegion(BaseModel):
    """A region that covers a pixel."""

    example: str = Field(description="its notation, for like and unlike")
    view: str
    level: int = Field(description="of the view's label map")
    region: int = Field(description="its label there")
    share: float = Field(description="of the view's pixels that it covers")


class CoveringRegions(BaseModel):
    """The regions that cover a pixel."""

    lift: JobId
    view: str
    regions: list[CoveringRegion] = Field(description="one a level at most, the smallest first")


class AskedForSceneObjects(BaseModel):
    """Which objects to list, and what names them."""

    table: AssetId | None = Field(None, description="an uploaded text table: objects are named by its words")
    encoder: str | None = Field(
        None,
        max_length=200,
        description="a text space that the operator set up as a table, the lift's own, or default: likewise",
    )
    features: Annotated[bool, Field(description="with the mean feature of each")] = False
    limit: int = Field(100, ge=1, le=1000, description="how many to list")
    cursor: int = Field(0, ge=0, le=10**9, description="the `next` of the page before")


class SceneObjects(BaseModel):
    """Some of the objects of a lift, those with the most evidence first."""

    lift: JobId
    encoder: str | None = Field(description="what named them, without its file; null for nothing")
    explanation: str = Field(description="why there are so many; or why there are none")
    count: int = Field(description="of all pages")
    objects: list[SceneObject]
    next: int | None = Field(description="the cursor of the page after this one; null at the end")


class Health(BaseModel):
    """Whether the HTTP process answers."""

    status: str


class Ready(BaseModel):
    """The service can work."""

    status: str
    checks: list[str] = Field(description="what was looked at")


class Version(BaseModel):
    """What runs here."""

    version: str = Field(description="of splatlift")
    api: str = Field(description="of the routes and their JSON")
    database: int = Field(description="of the database's schema")
    commit: str | None = Field(description="the git commit that this was built from, if the operator said so")
    python: str
    packages: dict[str, str] = Field(description="versions of what matters most")
