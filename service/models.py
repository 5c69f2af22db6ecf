"""The JSON that the service takes and gives."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    AfterValidator,
    AliasChoices,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    computed_field,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError

from liftcore import Answer, CoveringRegion, LiftSettings, Objects, Picture, Query, SceneObject, WorldFrame
from liftcore.models import (
    NOTATIONS,
    BestWords,
    Body,
    Box,
    Edit,
    LabelSummary,
    ListedObjects,
    NoBoolean,
    Notation,
    SceneTree,
    SelectionSummary,
    SuggestedWords,
    Viewpoint,
    takes,
)

# Limits of one file or request, beside those that the operator sets (`service.settings`).
# Texts, in characters
VIEW_CHARACTERS = 500  # of a view's name, so that it fits a query string
WORD_CHARACTERS = 1000  # of a word, of a query's text, and of a pack's names
FILE_CHARACTERS = 4 << 20  # of all names, or all words, of a file: a hundred thousand of 40
PAGE_CHARACTERS = 256 << 10  # of the names, or words, of one answer
LIFT_NAME_CHARACTERS = 100
SETTING_CHARACTERS = 1000  # of a name or a text among settings
TEXT_CHARACTERS = 4000  # of the texts of a question together: an encoder takes seconds for more

# Numbers
PACKS = 64  # of a lift
SETTINGS = 100  # of a lift
MAX_TEXTS = 32  # texts, or examples, of a question
VECTOR = 65_536  # numbers of a vector
WORDS = 4096  # of a query
PAGE = 1000  # records of a list, names or views in one answer

# JSON bodies, before they are parsed: what a question needs at most is 4,096 words, or 32 vectors of 4,096 numbers
BODY_BRACKETS = 10_000
BODY_COMMAS = 140_000


def _once(texts: list[str]) -> list[str]:
    return list(dict.fromkeys(texts))


@dataclass(frozen=True)
class Published:
    """Shows a field in the OpenAPI document as a model's own fields, which another module checks in its own words."""

    model: type[BaseModel]
    without: Sequence[str] = ()

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        copy = deepcopy(handler.resolve_ref_schema(handler(self.model.__pydantic_core_schema__)))
        for name in self.without:
            copy["properties"].pop(name, None)
        del copy["title"]
        return copy


def _bounded(value: Any) -> Any:
    """Refuse settings that are too large before they are parsed."""
    if isinstance(value, dict):
        texts = (text for pair in value.items() for text in pair if isinstance(text, str))
        if len(value) > SETTINGS or any(len(text) > SETTING_CHARACTERS for text in texts):
            context = {"expected": f"at most {SETTINGS} settings of at most {SETTING_CHARACTERS} characters"}
            raise PydanticCustomError("too_many_settings", "{expected}", context)
    return value


Bounded = BeforeValidator(_bounded)


# What goes in and out

ASSET_ID = r"^sha256:[0-9a-f]{64}$"
JOB_ID = r"^[0-9a-f]{32}$"
TRADEOFF_SETTING = "quality"  # set by the runs of a trade-off alone
PRINTABLE = r"^[^\x00-\x1f\x7f]*$"

BODY_CONFIG = ConfigDict(defer_build=False)  # for models of bodies, which FastAPI builds at the start
AssetId = Annotated[str, Field(pattern=ASSET_ID, description="sha256: and the digest of the bytes, in hex")]
JobId = Annotated[str, Field(pattern=JOB_ID)]
Text = Annotated[str, Field(min_length=1, max_length=WORD_CHARACTERS)]
Scalar = Annotated[bool | int | float | str, takes("a boolean, a number or a text")]


class AssetKind(StrEnum):
    """Kind of an upload."""

    SPLATS = "splats"
    CAMERAS = "cameras"
    FEATURES = "features"
    MASKS = "masks"  # of views, to judge by
    TABLE = "table"  # of text embeddings
    PHOTOS = "photos"  # of views


UploadKind = AssetKind | Literal["lift"]


class JobKind(StrEnum):
    """Kind of a job."""

    LIFT = "lift"
    TRADEOFF = "tradeoff"


class JobState(StrEnum):
    """State of a job."""

    QUEUED = "queued"
    RUNNING = "running"
    CANCELING = "canceling"  # requested, and not complete
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELED = "canceled"


FINAL_STATES = frozenset({JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELED})


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
    nearest: Annotated[
        list[str] | None,
        Field(description="for an unknown word: known words near to it, the likeliest first"),
    ] = None
    request_id: Annotated[str | None, Field(description="as in X-Request-ID; the log has it too")] = None


FIRST_MOMENT, LAST_MOMENT = (datetime(*day, tzinfo=UTC).timestamp() for day in ((1, 1, 1), (9999, 12, 31)))


def within_calendar(seconds: float) -> float:
    """Return seconds since 1970, clipped to dates of ISO 8601: a database may hold any number."""
    return max(FIRST_MOMENT, min(LAST_MOMENT, seconds))


Seconds = Annotated[float, Field(description="seconds since 1970"), AfterValidator(within_calendar)]


def iso_of(name: str, *, optional: bool = False) -> Any:
    """Return a field with the time of a field of `Seconds` as ISO 8601, in UTC."""

    def moment(self: BaseModel) -> datetime | None:
        seconds = getattr(self, name)
        return None if seconds is None else datetime.fromtimestamp(seconds, UTC)

    kind: Any = datetime | None if optional else datetime
    return computed_field(return_type=kind, description=f"{name} as ISO 8601, in UTC")(property(moment))


class Asset(BaseModel):
    """An uploaded file."""

    id: AssetId
    kind: AssetKind
    bytes: int
    counts: dict[str, Any] = Field(description="counts of its content: splats, views, channels and so on")
    warnings: list[str]
    created: Seconds
    created_at = iso_of("created")
    links: dict[str, str]


class Assets(BaseModel):
    """Some of the assets, newest first."""

    assets: list[Asset]
    next: str | None = Field(description="the cursor of the page after this one; null at the end")


class Names(BaseModel):
    """Some of the names of views, or of the words, that an asset holds."""

    names: list[str]
    next: int | None = Field(description="the cursor of the page after this one; null at the end")


class LiftInputs(Body):
    """Inputs of a lift: assets that are uploaded."""

    model_config = BODY_CONFIG
    splats: AssetId
    cameras: AssetId
    features: Annotated[
        list[AssetId], Field(min_length=1, fail_fast=True), AfterValidator(_once), Field(max_length=PACKS)
    ] = Field(description=f"feature packs, each counts once; at most {PACKS}")
    settings: Annotated[dict[str, Scalar], Bounded, Published(LiftSettings)] = Field(
        default_factory=dict,
        description="settings of the lift; others take the values of the preset and the quality",
        examples=[{"preset": "default", "quality": "balanced"}],
    )


class LiftRequest(LiftInputs):
    """Inputs of a lift, with the words for its queries: assets that are uploaded."""

    model_config = BODY_CONFIG
    table: AssetId | None = Field(
        None, description="an uploaded text table, with the words of the lift's queries; else those of its text space"
    )


class Labels(Body):
    """Masks of views and their words; views with masks are held out, to measure the accuracy of lifts."""

    masks: AssetId
    table: AssetId
    classes: Annotated[list[Text], Field(min_length=1, max_length=1000, fail_fast=True)] = Field(
        description="words of the table; the first is what masks call 0"
    )


class TradeoffRequest(LiftInputs):
    """Inputs of a trade-off: lifts of these assets, each with another preset or quality level."""

    settings: Annotated[dict[str, Scalar], Bounded, Published(LiftSettings, without=(TRADEOFF_SETTING,))] = Field(
        default_factory=dict,
        description="settings of all runs, without quality, which is compared; its levels begin with a preset",
        examples=[{"robust_steps": 1}],
    )
    budget_s: Annotated[float, Field(ge=10, le=86_400), NoBoolean] = Field(
        600, description="seconds for all runs; the exact run is made in any case"
    )
    labels: Labels | None = Field(
        None, description="masks with the true labels; without them, runs are compared on held-out views"
    )


class Progress(BaseModel):
    """Progress of a job's current stage."""

    stage: str
    completed: int = Field()
    total: int
    unit: str
    eta_s: float | None = Field(description="seconds until the end of this stage, from its speed so far")

    @computed_field(description="`completed`, by its old name", json_schema_extra={"deprecated": True})
    @property
    def done(self) -> int:
        """Return ``completed`` by its old name, until version 1 of the API ends."""
        return self.completed


class Plan(BaseModel):
    """Plan of a lift: ``summary``, ``warnings``, and the fields of ``plan`` in its diagnostics."""

    model_config = ConfigDict(extra="allow")  # the numbers of the diagnostics

    summary: list[str] = Field(description="the plan for people, a few lines")
    warnings: list[str] = Field(description="about the inputs, and about the memory and disk of the machine")


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
    parameters: dict[str, Any] = Field(
        description="of its kind: the table of a lift's words; budget_s of a trade-off, and its labels"
    )
    plan: Plan | None = Field(description="of a lift, before its first view is rasterized; of the latest attempt")
    progress: Progress | None
    problem: Problem | None
    created: Seconds
    started: Seconds | None
    ended: Seconds | None
    created_at = iso_of("created")
    started_at = iso_of("started", optional=True)
    ended_at = iso_of("ended", optional=True)
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
    time: Seconds
    time_at = iso_of("time")


class LiftResult(BaseModel):
    """Features on splats. A lift has the id of the job that made it."""

    id: JobId
    name: str | None = Field(description="set by a user")
    bytes: int = Field(description="size of the file, as it was made")
    sha256: str = Field(
        description="of the file, as it was made; after a change of `world` the download has another one, in its ETag"
    )
    splats: AssetId
    cameras: AssetId
    features: list[AssetId]
    photos: AssetId | None = Field(description="of its views")
    count: int = Field(description="P, the number of splats")
    channels: int = Field(description="F, the number of feature channels")
    version: str
    settings: dict[str, Any]
    encoder: str = Field(description="the 2D encoder that made the features, as in their packs")
    text_space: str = Field(description="the text space that the features share")
    words: list[str] = Field(description="from its packs, for queries without an encoder")
    views: list[str] = Field(description="the views that were lifted; very many are at links.views alone")
    view_count: int = Field(description="number of these")
    origin: list[float] = Field(
        [0.0, 0.0, 0.0],
        min_length=3,
        max_length=3,
        description="of the positions of its `.splat` and `.spz`; zeros except for scenes in map coordinates",
    )
    world: WorldFrame = Field(description="up axis and length of a scene unit, as far as they are known")
    diagnostics: dict[str, Any] = Field(description="measures of the lift's quality, and its warnings")
    timings: dict[str, float] = Field(description="seconds a stage")
    created: Seconds
    created_at = iso_of("created")
    links: dict[str, str]

    @computed_field(description="`diagnostics`, by its old name", json_schema_extra={"deprecated": True})
    @property
    def certificate(self) -> dict[str, Any]:
        """The diagnostics by their old name, until version 1 of the API ends."""
        return self.diagnostics


SettingText = Annotated[str, Field(min_length=1, max_length=SETTING_CHARACTERS, pattern=PRINTABLE)]


class PackChange(Body):
    """Names of a feature pack; fields that are left out stay as in the pack."""

    model_config = BODY_CONFIG
    encoder: SettingText | None = Field(None, description="the encoder of the features")
    text_space: SettingText | None = Field(
        None, description="the text encoder that shares their space; 'none' for none"
    )


class WorldUpdate(WorldFrame):
    """Up direction and unit of length of a lift; absent fields are unknown."""

    error_type: ClassVar = None


class LiftChange(Body):
    """Change of a lift; absent fields stay."""

    model_config = BODY_CONFIG
    name: (
        Annotated[str, Field(max_length=LIFT_NAME_CHARACTERS, pattern=PRINTABLE), AfterValidator(str.strip)] | None
    ) = Field(None, description="for people; null or an empty one takes the name away")
    photos: AssetId | None = Field(None, description="an asset of kind photos; null takes them away")
    world: WorldUpdate | None = Field(
        None, description="up axis and length of a scene unit, in place of all known values; null: neither"
    )


class Lifts(BaseModel):
    """Some of the lifts, newest first."""

    lifts: list[LiftResult]
    next: str | None = Field(description="the cursor of the page after this one; null at the end")


class View(BaseModel):
    """A camera of a lift's scene, in gsplat's conventions: OpenCV axes, pixel centres at +0.5."""

    name: str
    lifted: bool = Field(description="true if its features were lifted")
    photo: bool = Field(description="true if the lift's photos include it")
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

    model_config = ConfigDict(extra="allow")  # other fields of the comparison

    id: JobId
    splats: AssetId
    cameras: AssetId
    features: list[AssetId]
    labels: Labels | None = Field(description="the masks with the true labels")
    runs: list[dict[str, Any]] = Field(description="one for each preset and level of quality: seconds and accuracy")
    over_budget: list[str] = Field(
        description="runs that did not fit the budget",
        validation_alias=AliasChoices("over_budget", "skipped"),  # stored ones may have the old name
    )
    invalid_runs: list[str] = Field(
        default=[],
        description="runs that the settings do not allow",
        validation_alias=AliasChoices("invalid_runs", "refused"),
    )
    choice: dict[str, Any] = Field(description="the recommended runs, with reasons")
    views: dict[str, int] = Field(description="number of lifted, all and held-out views")
    budget_s: float
    seconds: float = Field(description="duration")
    created: Seconds
    created_at = iso_of("created")
    links: dict[str, str]

    @computed_field(description="`over_budget`, by its old name", json_schema_extra={"deprecated": True})
    @property
    def skipped(self) -> list[str]:
        """Return ``over_budget`` by its old name, until version 1 of the API ends."""
        return self.over_budget

    @computed_field(description="`invalid_runs`, by its old name", json_schema_extra={"deprecated": True})
    @property
    def refused(self) -> list[str]:
        """Return ``invalid_runs`` by its old name, until version 1 of the API ends."""
        return self.invalid_runs


class Health(BaseModel):
    """Answer of the HTTP process that it is alive."""

    status: str


class Ready(BaseModel):
    """The service can work."""

    status: str
    checks: list[str] = Field(description="the checks that ran")


class Version(BaseModel):
    """Versions of the service and its packages."""

    version: str = Field(description="of splatlift")
    api: str = Field(description="of the routes and their JSON")
    database: int = Field(description="of the database's schema")
    commit: str | None = Field(description="the git commit of the build, if the operator set it")
    python: str
    packages: dict[str, str] = Field(description="versions of the main dependencies")


# Queries: the models of liftcore, with the lift, the encoder, and limits of HTTP

QUESTIONS = 16  # that are exported together
THE_LIFT = "the lift; may be left out when there is exactly one"


def at_most(characters: int) -> AfterValidator:
    """Limit a list of texts by their total length."""

    def check(texts: list[str]) -> list[str]:
        if (got := sum(map(len, texts))) > characters:
            context = {"expected": f"texts of at most {characters} characters together, which are {got}"}
            raise PydanticCustomError("too_long_together", "{expected}", context)
        return texts

    return AfterValidator(check)


# Only the first error is reported: a list of a hundred thousand items must not make as many errors.
Texts = Annotated[list[Text], Field(max_length=MAX_TEXTS, fail_fast=True), at_most(TEXT_CHARACTERS)]
Numbers = Annotated[
    tuple[Annotated[float, Field(allow_inf_nan=False, strict=True)], ...],
    Field(min_length=1, max_length=VECTOR, fail_fast=True),
]
AnExample = Annotated[Notation | Numbers, takes(f"{NOTATIONS}, or a vector of 1 to {VECTOR} finite numbers")]
Examples = Annotated[list[AnExample], Field(max_length=MAX_TEXTS, fail_fast=True)]


class LiftQuestion(BaseModel):
    """The lift of a query, and the words that it may use."""

    lift: JobId | None = Field(None, description=THE_LIFT)
    encoder: str | None = Field(
        None, max_length=200, description="a text space that the operator set up, the lift's own, or default"
    )
    table: AssetId | None = Field(None, description="an uploaded text table that has the words, in place of encoder")


def _query_field(name: str) -> Any:
    """Return a field of `Query` with its default and description, for HTTP to add limits."""
    field = Query.model_fields[name]
    return Field(field.default, description=field.description)


class Question(Query, LiftQuestion):
    """A question to a lift."""

    model_config = BODY_CONFIG
    error_type: ClassVar = None
    text: Texts = _query_field("text")
    like: Examples = _query_field("like")
    negatives: Texts = _query_field("negatives")
    unlike: Examples = _query_field("unlike")


class Words(LiftQuestion, Body):
    """Many words at once."""

    words: Annotated[list[Text], Field(max_length=WORDS, fail_fast=True)] | None = Field(
        None, description="words to find, each once; all words of a table if left out"
    )


class SegmentRequest(Words, Viewpoint):
    """Every splat's best word."""

    model_config = BODY_CONFIG


SelectionName = Annotated[str, Field(min_length=1, max_length=LIFT_NAME_CHARACTERS, pattern=PRINTABLE)]


class NamedQuestion(Question):
    """A question to a lift, and what files call its answer."""

    model_config = BODY_CONFIG
    name: SelectionName | None = Field(None, description="name of the label; by default the words of the question")


class ExportRequest(Words):
    """The content of a ZIP: the answers of questions, every splat's best word, or the objects of the lift."""

    model_config = BODY_CONFIG
    of: Literal["questions", "words", "objects"] = Field("objects", description="the labels of the content")
    questions: Annotated[list[NamedQuestion], Field(max_length=QUESTIONS, fail_fast=True)] = Field(
        [], description="for content `questions`: each is a class of the labels"
    )
    view: str | None = Field(
        None, min_length=1, max_length=VIEW_CHARACTERS, description="the view of the masks; else all views"
    )


class NearestWordsRequest(Words):
    """Example for which the nearest words are requested."""

    model_config = BODY_CONFIG
    example: AnExample = Field(description="the example")
    top: Annotated[int, Field(ge=1, le=1000), NoBoolean] = Field(5, description="number of words")


class SuggestedWordsRequest(LiftQuestion):
    """Text for which completions are requested."""

    model_config = BODY_CONFIG
    text: str = Field("", max_length=200, description="the beginning of a word; empty: words of the scene alone")
    limit: int = Field(8, ge=1, le=100, description="number of words at most")


class RenderRequest(Picture):
    """A picture of a lift's scene."""

    model_config = BODY_CONFIG

    lift: JobId | None = Field(None, description=THE_LIFT)


class OfLift(BaseModel):
    """An answer of a lift."""

    lift: JobId


class SegmentAnswer(LabelSummary, OfLift):
    """Words that are requested, of many."""

    encoder: str = Field(description="the text encoder of the query, without its file")


class NearestWordsAnswer(BestWords, OfLift):
    """The words that something is most like."""

    encoder: str


class WordsAnswer(SuggestedWords, OfLift):
    """Words that a lift can be queried with."""


class QueryAnswer(Answer, OfLift):
    """An answer, with what it is of and where its pictures are."""

    view: str | None
    text_space: str = Field(description="of the lift's features")
    encoder: str | None = Field(description="the text encoder of the query, without its file; null without a text")
    links: dict[str, str]


class ObjectsAnswer(SelectionSummary, Objects, OfLift):
    """The objects of an answer."""


class CoveringRegions(OfLift):
    """The regions that cover a pixel."""

    view: str
    regions: list[CoveringRegion] = Field(description="one a level at most, the smallest first")


class EditRequest(Edit):
    """One change of a selection."""

    model_config = BODY_CONFIG
    error_type: ClassVar = None
    query: Question | None = Field(None, description="a query: the splats that it selects")  # pyright: ignore[reportIncompatibleVariableOverride]


class NewSelection(Body):
    """A selection to begin."""

    model_config = BODY_CONFIG
    name: SelectionName = Field(description="for people")
    edit: EditRequest | None = Field(None, description="first edit of the empty selection; none if left out")


class SelectionChange(Body):
    """Change of a selection; absent fields stay."""

    model_config = BODY_CONFIG
    name: SelectionName | None = Field(None, description="for people")
    step: Annotated[int, Field(ge=0, le=10**9), NoBoolean] | None = Field(
        None, description="the number of a step of its history: undo and redo"
    )


class ObjectLabelChange(Body):
    """Changes of an object's label; fields that are left out stay."""

    model_config = BODY_CONFIG
    name: SelectionName | None = Field(None, description="your own name; null for the nearest word")
    hidden: bool = Field(False, description="true if lists leave it out")


class ObjectLabel(BaseModel):
    """The name that a user gave an object of a lift, and whether it is hidden."""

    id: int
    name: str | None = Field(description="your own name; null if there is none")
    hidden: bool


class ListedSelection(OfLift):
    """A set of splats that is corrected by hand."""

    id: str
    name: str
    count: int = Field(description="splats")
    box: Box | None = Field(description="box of its large groups of touching splats; null if there are none")
    step: int = Field(description="its current step in the history")
    first: int = Field(description="the steps that it can go to, by PATCH")
    last: int
    version: int = Field(description="its ETag, for If-Match")
    created: Seconds
    changed: Seconds
    created_at = iso_of("created")
    changed_at = iso_of("changed")
    links: dict[str, str]


class SelectionStep(BaseModel):
    """A step of a selection's history."""

    number: int
    edit: dict[str, Any] = Field(description="the edit of the step before, without bits")
    count: int = Field(description="splats after it")


class SelectionDetail(ListedSelection):
    """A selection with its history."""

    history: list[SelectionStep] = Field(description="also the steps that were undone")
    bits: str | None = Field(description="base64 of a bit a splat, the first the lowest of its byte, if requested")


class Selections(BaseModel):
    """The selections of a lift, newest first."""

    selections: list[ListedSelection]


class OwnKey(BaseModel):
    """Rights of a key."""

    name: str | None = Field(description="its owner or purpose; null where no key is needed")
    scopes: list[str]
    lifts: list[JobId] = Field(description="for the scope `shared`: the shared lifts")
    expires: Seconds | None = Field(description="null for never")
    expires_at = iso_of("expires", optional=True)


class ShareRequest(Body):
    """Request for a new key."""

    model_config = BODY_CONFIG
    name: SelectionName = Field(description="its recipient")
    expires_s: Annotated[float, Field(ge=60, le=31_622_400), NoBoolean] = Field(
        2_592_000, description="seconds until it ends; 30 days if left out, a year at most"
    )


class Share(BaseModel):
    """Request for a key that can read and query one lift; it expires with the key that created it."""

    id: str
    name: str
    created: Seconds
    expires: Seconds | None = Field(description="null for never")
    created_at = iso_of("created")
    expires_at = iso_of("expires", optional=True)
    links: dict[str, str]


class NewShare(Share):
    """A share with its secret."""

    key: str = Field(description="the secret, which cannot be read again; links.page has it")


class Shares(BaseModel):
    """The valid shares of a lift, newest first."""

    shares: list[Share]


class NodesRequest(BaseModel):
    """Nodes of a lift's tree to list, and words to name them."""

    table: AssetId | None = Field(None, description="an uploaded text table: its words name the objects")
    encoder: str | None = Field(
        None,
        max_length=200,
        description="a text space that the operator set up as a table, the lift's own, or default: to name objects",
    )
    limit: int = Field(100, ge=1, le=1000, description="number of items to list")
    cursor: int = Field(0, ge=0, le=10**9, description="the `next` of the page before")


NUMBER = r"[+-]?(\d{1,20}(\.\d{0,20})?|\.\d{1,20})([eE][+-]?\d{1,3})?"
UP = rf"^(cameras|{NUMBER},{NUMBER},{NUMBER})$"


class TreeRequest(NodesRequest):
    """Nodes to list, with or without relations of objects."""

    relations: bool = Field(False, description="relations of the objects in space, with numbers")
    up: str | None = Field(
        None,
        pattern=UP,
        description="with relations: the direction against gravity in the frame of the splats, x,y,z, or cameras, "
        "where photos were taken upright; left out, that of the lift, without which nothing is on, under or beside",
    )


class SceneObjectsRequest(NodesRequest):
    """Objects to list, and words to name them."""

    features: Annotated[bool, Field(description="true: with the mean feature of each")] = False
    splat: int | None = Field(None, ge=0, le=10**9, description="only the object of this splat, by its row")


class LiftTree(SceneTree, OfLift):
    """Some of the nodes of a lift's tree: objects first, those with the largest total weight first.

    Of the relations those whose `node` is on the page.
    """

    encoder: str | None = Field(description="the text encoder of their names, without its file; null if unnamed")
    next: int | None = Field(description="the cursor of the page after this one; null at the end")


class NamedObject(SceneObject):
    """An object of a lift, with its name if a user gave it one."""

    hidden: bool = Field(description="true if a user hid it")


class SceneObjects(ListedObjects, OfLift):
    """Some of the objects of a lift, those with the largest total weight first."""

    objects: tuple[NamedObject, ...]  # pyright: ignore[reportIncompatibleVariableOverride]

    encoder: str | None = Field(description="the text encoder of their names, without its file; null if unnamed")
    next: int | None = Field(description="the cursor of the page after this one; null at the end")
