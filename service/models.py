"""The JSON that the service takes and gives. Rows of the store are replies: what is private is excluded."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, computed_field
from pydantic_core import PydanticCustomError

from liftcore import Answer, LiftSettings, Objects, Picture, Query, SceneNode, WorldFrame
from liftcore.errors import InvalidSettings
from liftcore.models import (
    NOTATIONS,
    VIEW_CHARACTERS,
    BestWords,
    Body,
    Box,
    Edit,
    LabelSummary,
    NoBoolean,
    Notation,
    OwnCamera,
    SceneTree,
    SelectionSummary,
    SuggestedWords,
    Viewpoint,
    WithUnits,
    takes,
)

# Limits of one file or request. JSON is parsed in the event loop, where each megabyte may take .3 s.
BODY_BYTES = 256 << 10
BITS_BYTES = 1 << 20  # of a body with a bit a splat
WORD_CHARACTERS = 1000  # of a word, of a query's text, and of a pack's names
FILE_CHARACTERS = 4 << 20  # of all names, or all words, of a file: a hundred thousand of 40
NAME_CHARACTERS = 100  # that people give to lifts, selections and keys
TEXT_CHARACTERS = 4000  # of the texts of a question together: an encoder takes seconds for more
PACKS = 64  # of a lift
SETTINGS = 100  # of a lift
MAX_TEXTS = 32  # texts, or examples, of a question
VECTOR = 65_536  # numbers of a vector
WORDS = 4096  # of a query
PAGE = 1000  # records of a list in one answer
QUESTIONS = 16  # that are exported together

ASSET_ID, JOB_ID = r"^sha256:[0-9a-f]{64}$", r"^[0-9a-f]{32}$"
CURSOR = r"^[0-9]{1,20}(\.[0-9]{1,20})?(e[+-]?[0-9]{1,2})?~[0-9a-z:]{1,80}$"  # time and id of a page's last record
PRINTABLE = r"^[^\x00-\x1f\x7f]*$"
FINAL_STATES = ("succeeded", "failed", "canceled")

AssetKind = Literal["splats", "cameras", "features", "masks", "table", "photos"]
JobKind = Literal["lift", "tradeoff"]
JobState = Literal["queued", "running", "canceling", "succeeded", "failed", "canceled"]
AssetId = Annotated[str, Field(pattern=ASSET_ID, description="sha256: and the digest of the bytes, in hex")]
JobId = Annotated[str, Field(pattern=JOB_ID)]
Seconds = Annotated[float, Field(description="seconds since 1970")]
Text = Annotated[str, Field(min_length=1, max_length=WORD_CHARACTERS)]
Name = Annotated[str, Field(min_length=1, max_length=NAME_CHARACTERS, pattern=PRINTABLE)]
Next = Annotated[str | None, Field(description="the cursor of the page after this one; null at the end")]
NextNumber = Annotated[int | None, Field(description="likewise")]
BODY_CONFIG = ConfigDict(defer_build=False)  # of models of bodies, which FastAPI builds at the start


# Assets


class Asset(BaseModel):
    """An uploaded file."""

    id: AssetId
    kind: AssetKind
    bytes: int
    file: Path = Field(exclude=True)
    counts: dict[str, Any] = Field(description="counts of its content: splats, views, channels and so on")
    warnings: list[str]
    created: Seconds

    @computed_field
    @property
    def links(self) -> dict[str, str]:
        """Routes of the asset."""
        return {"self": f"/assets/{self.id}", "content": f"/assets/{self.id}/content"}

    @property
    def client_name(self) -> str:
        """Name of the file in errors."""
        return f"{self.kind} {self.id}"

    @property
    def download_name(self) -> str:
        """Name of the file for downloads, and for lifts that are made of it."""
        return f"{self.kind}-{self.id.removeprefix('sha256:')[:12]}{self.file.suffix}"

    def kernel(self, settings: dict[str, Any]) -> str:
        """Return the kernel with which a lift of those settings interprets these splats."""
        kernel = settings.get("kernel", "auto")
        return self.counts.get("kernel", "3dgs") if kernel == "auto" else kernel


# Jobs


class LiftInputs(Body):
    """Inputs of a lift: assets that are uploaded."""

    model_config = BODY_CONFIG
    splats: AssetId
    cameras: AssetId
    features: Annotated[list[AssetId], Field(min_length=1, max_length=PACKS, fail_fast=True)] = Field(
        description=f"feature packs, each counts once; at most {PACKS}"
    )
    settings: dict[str, Any] = Field(
        {},
        max_length=SETTINGS,
        description="settings of the lift; others take the values of the preset and the quality",
        examples=[{"preset": "default", "quality": "balanced"}],
    )

    def columns(self, kind: str, parameters: dict[str, Any], settings: dict[str, Any]) -> dict[str, Any]:
        """Return the columns of the job."""
        packs = list(dict.fromkeys(self.features))
        inputs = {"splats": self.splats, "cameras": self.cameras, "features": packs}
        return {"kind": kind, **inputs, "settings": settings, "parameters": parameters}


class LiftRequest(LiftInputs):
    """Inputs of a lift, with the words for its queries: assets that are uploaded."""

    table: AssetId | None = Field(
        None, description="an uploaded text table, with the words of the lift's queries; else those of its text space"
    )

    def job(self) -> dict[str, Any]:
        """Return the columns of the job."""
        settings = LiftSettings.of_json(self.settings).model_dump(mode="json")
        return self.columns("lift", {} if self.table is None else {"table": self.table}, settings)


class Labels(Body):
    """Masks of views and their words; views with masks are held out, to measure the accuracy of lifts."""

    masks: AssetId
    table: AssetId
    classes: Annotated[list[Text], Field(min_length=1, max_length=1000, fail_fast=True)] = Field(
        description="words of the table; the first is what masks call 0"
    )


class TradeoffRequest(LiftInputs):
    """Inputs of a trade-off: lifts of these assets, each with another preset or quality level."""

    budget_s: Annotated[float, Field(ge=10, le=86_400), NoBoolean] = Field(
        600, description="seconds for all runs; the exact run is made in any case"
    )
    labels: Labels | None = Field(
        None, description="masks with the true labels; without them, runs are compared on held-out views"
    )

    def job(self) -> dict[str, Any]:
        """Return the columns of the job."""
        if "quality" in self.settings:
            expected, got = "settings that are the same in all runs", "one that is compared"
            raise InvalidSettings("quality", expected=expected, got=got)
        LiftSettings.of_json(self.settings)
        parameters = self.model_dump(mode="json", include={"budget_s", "labels"}, exclude_none=True)
        return self.columns("tradeoff", parameters, self.settings)


class Progress(BaseModel):
    """Progress of a job's current stage."""

    stage: str
    completed: int
    total: int
    unit: str
    eta_s: float | None = Field(None, description="seconds until the end of this stage, from its speed so far")


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
    parameters: dict[str, Any] = Field(description="the table of a lift's words; budget_s of a trade-off, its labels")
    plan: Plan | None = Field(description="of a lift, before its first view is rasterized; of the latest attempt")
    progress: Progress | None
    problem: dict[str, Any] | None = Field(description="why it failed: a problem, as of an error")
    request_id: str | None = Field(description="the X-Request-ID of the request that made it")
    created: Seconds
    started: Seconds | None
    ended: Seconds | None

    @computed_field
    @property
    def links(self) -> dict[str, str]:
        """Routes of the job and of its result."""
        path = f"/jobs/{self.id}"
        links = {"self": path, "events": f"{path}/events"}
        if self.state not in FINAL_STATES:
            links["cancel"] = f"{path}/cancel"
        if self.state == "succeeded":
            result, file = ("lift", "features") if self.kind == "lift" else ("tradeoff", "chart")
            links |= {result: f"/{result}s/{self.id}", file: f"/{result}s/{self.id}/{file}"}
        return links


# Lifts and trade-offs


class Lift(BaseModel):
    """Features on splats. A lift has the id of the job that made it."""

    id: JobId
    name: str | None = Field(description="set by a user")
    bytes: int = Field(description="size of the file")
    sha256: str = Field(description="of the file")
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
    words: list[str] = Field([], description="from its packs, for queries without an encoder; few enough to show")
    views: list[str] = Field([], description="the views that were lifted; very many are at /lifts/{lift}/views alone")
    view_count: int = Field(description="number of these")
    origin: list[float] = Field(
        [0.0, 0.0, 0.0],
        description="of the positions of its `.splat` and `.spz`; zeros except for scenes in map coordinates",
    )
    world: WorldFrame = Field(description="up axis and length of a scene unit, as far as they are known")
    diagnostics: dict[str, Any] = Field(description="measures of the lift's quality, and its warnings")
    timings: dict[str, float] = Field(description="seconds a stage")
    created: Seconds
    file: Path = Field(exclude=True)
    parameters: dict[str, Any] = Field(exclude=True)

    @computed_field
    @property
    def links(self) -> dict[str, str]:
        """Routes of the lift."""
        path = f"/lifts/{self.id}"
        below = {name: f"{path}/{name}" for name in ("features", "views", "objects", "tree")}
        return {"self": path, "job": f"/jobs/{self.id}", **below, "query": f"/query?lift={self.id}&text="}

    @classmethod
    def of_row(cls, row: dict[str, Any]) -> Self:
        """Return the lift of a row, in which the metadata of its file stand beside its own columns."""
        metadata, world = row["metadata"], row["world"]
        world = metadata.get("world") or {} if world is None else world
        return cls(**metadata | row | {"world": world})


class WorldUpdate(WorldFrame):
    """Up direction and unit of length of a lift; absent fields are unknown."""

    error_type: ClassVar = None


class LiftChange(Body):
    """Change of a lift; absent fields stay."""

    model_config = BODY_CONFIG
    name: Annotated[str, Field(max_length=NAME_CHARACTERS, pattern=PRINTABLE), AfterValidator(str.strip)] | None = (
        Field(None, description="for people; null or an empty one takes the name away")
    )
    photos: AssetId | None = Field(None, description="an asset of kind photos; null takes them away")
    world: WorldUpdate | None = Field(
        None, description="for answers and exports, in place of all known values; null: none is known"
    )


class View(OwnCamera):
    """A camera of a lift's scene, in gsplat's conventions: OpenCV axes, pixel centres at +0.5."""

    lifted: bool = Field(description="true if its features were lifted")  # pyright: ignore[reportIncompatibleVariableOverride]
    photo: bool = Field(description="true if the lift's photos include it")  # pyright: ignore[reportIncompatibleVariableOverride]


class Views(BaseModel):
    """Some of the cameras of a lift's scene, in their file's order."""

    views: list[View]
    next: NextNumber


class Tradeoff(BaseModel):
    """Speed against accuracy on a scene, as ``splatlift tradeoff --json`` has it. It has the id of its job."""

    model_config = ConfigDict(extra="allow")  # other fields of the comparison

    id: JobId
    splats: AssetId
    cameras: AssetId
    features: list[AssetId]
    labels: Labels | None = Field(description="the masks with the true labels")
    runs: list[dict[str, Any]] = Field(description="one for each preset and level of quality: seconds and accuracy")
    choice: dict[str, Any] = Field(description="the recommended runs, with reasons")
    budget_s: float
    seconds: float = Field(description="duration")
    table: str = Field(description="the runs as Markdown, with a summary and the protocol")
    created: Seconds


# Queries: the models of liftcore, with the lift, the encoder, and limits of HTTP


def _at_most(texts: list[str]) -> list[str]:
    if (count := sum(map(len, texts))) > TEXT_CHARACTERS:
        context = {"expected": f"texts of at most {TEXT_CHARACTERS} characters together, which are {count}"}
        raise PydanticCustomError("too_long_together", "{expected}", context)
    return texts


def _query_field(name: str) -> Any:
    """Return a field of `Query` with its default and description, for HTTP to add limits."""
    field = Query.model_fields[name]
    return Field(field.default, description=field.description)


# Only the first error is reported: a list of a hundred thousand items must not make as many errors.
Texts = Annotated[list[Text], Field(max_length=MAX_TEXTS, fail_fast=True), AfterValidator(_at_most)]
Numbers = Annotated[
    tuple[Annotated[float, Field(allow_inf_nan=False, strict=True)], ...],
    Field(min_length=1, max_length=VECTOR, fail_fast=True),
]
AnExample = Annotated[Notation | Numbers, takes(f"{NOTATIONS}, or a vector of 1 to {VECTOR} finite numbers")]
Examples = Annotated[list[AnExample], Field(max_length=MAX_TEXTS, fail_fast=True)]
Notations = Annotated[list[Notation], Field(max_length=MAX_TEXTS, fail_fast=True)]
EncoderName = Annotated[str, Field(max_length=200)]
THE_LIFT = "the lift; the newest one if left out"


class LiftQuestion(BaseModel):
    """The lift of a query, and the words that it may use."""

    lift: JobId | None = Field(None, description=THE_LIFT)
    encoder: EncoderName | None = Field(
        None, description="a text space that the operator set up, the lift's own, or default"
    )
    table: AssetId | None = Field(None, description="an uploaded text table that has the words, in place of encoder")


class Question(Query, LiftQuestion):
    """A question to a lift."""

    model_config = BODY_CONFIG
    error_type: ClassVar = None
    text: Texts = _query_field("text")
    like: Examples = _query_field("like")
    negatives: Texts = _query_field("negatives")
    unlike: Examples = _query_field("unlike")


class QuestionParameters(Question):
    """A question to a lift in the query of a request, which holds no vectors and no camera."""

    like: Notations = _query_field("like")  # pyright: ignore[reportIncompatibleVariableOverride]
    unlike: Notations = _query_field("unlike")  # pyright: ignore[reportIncompatibleVariableOverride]
    camera: ClassVar[None] = None  # pyright: ignore[reportIncompatibleVariableOverride]


class Words(LiftQuestion, Body):
    """Many words at once."""

    model_config = BODY_CONFIG
    words: Annotated[list[Text], Field(max_length=WORDS, fail_fast=True)] | None = Field(
        None, description="words to find, each once; all words of a table if left out"
    )


class SegmentRequest(Words, Viewpoint):
    """Every splat's best word."""

    model_config = BODY_CONFIG


class NamedQuestion(Question):
    """A question to a lift, and what files call its answer."""

    name: Name | None = Field(None, description="name of the label; by default the words of the question")


class ExportRequest(Words):
    """The labels of a file: the answers of questions, every splat's best word, or the objects of the lift."""

    of: Literal["questions", "words", "objects"] = Field("objects", description="what the labels are of")
    questions: Annotated[list[NamedQuestion], Field(max_length=QUESTIONS, fail_fast=True)] = Field(
        [], description="for `of` questions: each is a class of the labels"
    )
    format: Literal["ply", "glb", "usdz", "names", "masks"] = Field("ply", description="the kind of file")
    view: str | None = Field(
        None, min_length=1, max_length=VIEW_CHARACTERS, description="the view of the masks; else all views"
    )


class NearestWordsRequest(Words):
    """Example for which the nearest words are requested."""

    example: AnExample = Field(description="the example")
    top: Annotated[int, Field(ge=1, le=1000), NoBoolean] = Field(5, description="number of words")


class SuggestedWordsRequest(LiftQuestion):
    """Text for which completions are requested."""

    model_config = ConfigDict(extra="forbid")
    text: str = Field("", max_length=200, description="the beginning of a word; empty: words of the scene alone")
    limit: int = Field(8, ge=1, le=100, description="number of words at most")


class RenderRequest(Picture):
    """A picture of a lift's scene."""

    model_config = BODY_CONFIG
    lift: JobId | None = Field(None, description=THE_LIFT)
    hide: list[str] | None = Field(
        None, max_length=1000, description="sets of splats left out, as `sets` of a query; default: hidden objects"
    )


class RenderParameters(RenderRequest):
    """A picture of a lift's scene, by a view of it."""

    camera: ClassVar[None] = None  # pyright: ignore[reportIncompatibleVariableOverride]


class OfLift(BaseModel):
    """An answer of a lift."""

    lift: JobId


class SegmentAnswer(LabelSummary, OfLift):
    """Words that are requested, of many."""

    encoder: str = Field(description="the text encoder of the query, without its file")


class NearestWordsAnswer(BestWords, OfLift):
    """The words that something is most like."""

    encoder: str


class SuggestedWordsAnswer(SuggestedWords, OfLift):
    """Words that a lift can be queried with."""


class QueryAnswer(Answer, OfLift):
    """An answer, with its lift, its view and where its outputs are."""

    view: str | None
    text_space: str = Field(description="of the lift's features")
    encoder: str | None = Field(description="the text encoder of the query, without its file; null without a text")
    links: dict[str, str]


class ObjectsAnswer(SelectionSummary, Objects, OfLift):
    """The objects of an answer."""


class NodesRequest(BaseModel):
    """Objects, or nodes of a tree, to list, and words to name them."""

    model_config = ConfigDict(extra="forbid")
    table: AssetId | None = Field(None, description="an uploaded text table: its words name the objects")
    encoder: EncoderName | None = Field(None, description="a text space with a table, the lift's own, or default")
    limit: int = Field(100, ge=1, le=PAGE, description="number of items to list")
    cursor: int = Field(0, ge=0, le=10**9, description="the `next` of the page before")


class LiftTree(SceneTree, OfLift):
    """Some of the nodes of a lift's tree: objects first, those with the largest total weight first."""

    encoder: str | None = Field(description="the text encoder of their names, without its file; null if unnamed")
    next: NextNumber


class NamedObject(SceneNode):
    """An object of a lift, with its name if a user gave it one."""

    hidden: bool = Field(description="true if a user hid it")


class SceneObjects(WithUnits, OfLift):
    """Some of the objects of a lift, those with the largest total weight first."""

    explanation: str = Field(description="why there are so many; or why there are none")
    count: int = Field(description="of all pages")
    objects: tuple[NamedObject, ...]
    encoder: str | None = Field(description="the text encoder of their names, without its file; null if unnamed")
    next: NextNumber


# Selections


class EditRequest(Edit):
    """One change of a selection."""

    model_config = BODY_CONFIG
    error_type: ClassVar = None
    query: Question | None = Field(None, description="a query: the splats that it selects")  # pyright: ignore[reportIncompatibleVariableOverride]


class NewSelection(Body):
    """A selection to begin."""

    model_config = BODY_CONFIG
    name: Name = Field(description="for people")
    edit: EditRequest | None = Field(None, description="first edit of the empty selection; none if left out")


class SelectionChange(Body):
    """Change of a selection; absent fields stay."""

    model_config = BODY_CONFIG
    name: Name | None = Field(None, description="for people")
    step: Annotated[int, Field(ge=0, le=10**9), NoBoolean] | None = Field(
        None, description="the number of a step of its history: undo and redo"
    )


class ObjectLabelChange(Body):
    """Changes of an object's label; fields that are left out stay."""

    model_config = BODY_CONFIG
    name: Name | None = Field(None, description="your own name; null for the nearest word")
    hidden: bool = Field(False, description="true if lists and pictures leave it out")


class ObjectLabel(BaseModel):
    """The name that a user gave an object of a lift, and whether it is hidden."""

    id: int
    name: str | None = Field(None, description="your own name; null if there is none")
    hidden: bool = False


class Selection(OfLift):
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

    @computed_field
    @property
    def links(self) -> dict[str, str]:
        """Routes of the selection and of its splats."""
        path = f"/lifts/{self.lift}/selections/{self.id}"
        question = f"lift={self.lift}&sets=selection:{self.id}"
        outputs = {name: f"/query/{name}?{question}" for name in ("object", "selection")}
        return {"self": path, "edits": f"{path}/edits", "query": f"/query?{question}", **outputs}


class Selections(BaseModel):
    """The selections of a lift, newest first."""

    selections: list[Selection]


# Keys


class Key(BaseModel):
    """A key; of its secret only the digest is stored."""

    id: str
    name: str
    scopes: str = Field(description="its rights, with spaces between")
    lifts: list[str] = Field(description="shared lifts: all that a key of the scope `shared` sees")
    maker: str | None = Field(description="the key that shared them, with which it ends")
    created: Seconds
    expires: Seconds | None
    revoked: Seconds | None


class OwnKey(BaseModel):
    """Rights of a key."""

    name: str | None = Field(description="its owner or purpose; null where no key is needed")
    scopes: list[str]
    lifts: list[JobId] = Field(description="for the scope `shared`: the shared lifts")
    expires: Seconds | None = Field(description="null for never")


class ShareRequest(Body):
    """Request for a key that can read and query one lift."""

    model_config = BODY_CONFIG
    name: Name = Field(description="its recipient")
    expires_s: Annotated[float, Field(ge=60, le=31_622_400), NoBoolean] = Field(
        2_592_000, description="seconds until it ends; 30 days if left out, a year at most"
    )


class Share(BaseModel):
    """A key that can read and query one lift; it ends with the key that created it."""

    id: str
    name: str
    created: Seconds
    expires: Seconds | None = Field(description="null for never")
    lift: JobId

    @computed_field
    @property
    def links(self) -> dict[str, str]:
        """Routes of the share and of its lift."""
        return {"self": f"/lifts/{self.lift}/shares/{self.id}", "lift": f"/lifts/{self.lift}"}


class NewShare(Share):
    """A share with its secret."""

    key: str = Field(description="the secret, which cannot be read again; links.page has it")

    @computed_field
    @property
    def links(self) -> dict[str, str]:
        """Routes, and the page with the secret after the #, which browsers do not send."""
        return super().links | {"page": f"/?lift={self.lift}#key={self.key}"}


class Shares(BaseModel):
    """The valid shares of a lift, newest first."""

    shares: list[Share]


class Status(BaseModel):
    """The service answers, or can work."""

    status: str
