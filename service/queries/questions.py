"""The JSON of questions: what liftcore declares, with the lift that is asked, its encoder, and bounds of HTTP."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, BaseModel, Field
from pydantic_core import PydanticCustomError

from liftcore import Answer, CoveringRegion, Objects, Picture, Query, SceneObject
from liftcore.models import (
    NOTATIONS,
    AskableWords,
    BestWords,
    Body,
    Box,
    Edit,
    Found,
    FoundWords,
    ListedObjects,
    NoBoolean,
    Notation,
    SceneTree,
    Seen,
    takes,
)
from service import models
from service.models import BUILT, AssetId, JobId, Text

THE_LIFT = "the lift; may be left out when there is exactly one"


def at_most(characters: int) -> AfterValidator:
    """Bounds a list of texts by what they have together."""

    def check(texts: list[str]) -> list[str]:
        if (got := sum(map(len, texts))) > characters:
            told = {"expected": f"texts of at most {characters} characters together, which are {got}"}
            raise PydanticCustomError("too_long_together", "{expected}", told)
        return texts

    return AfterValidator(check)


# The first thing that is wrong is all that is told: whoever sends a hundred thousand is not answered about each.
Texts = Annotated[list[Text], Field(max_length=models.ASKED, fail_fast=True), at_most(models.ASKED_CHARACTERS)]
Numbers = Annotated[
    tuple[Annotated[float, Field(allow_inf_nan=False, strict=True)], ...],
    Field(min_length=1, max_length=models.VECTOR, fail_fast=True),
]
AnExample = Annotated[
    Notation | Numbers,
    takes(f"{NOTATIONS}, or a vector of 1 to {models.VECTOR} finite numbers"),
]
Examples = Annotated[list[AnExample], Field(max_length=models.ASKED, fail_fast=True)]


class LiftQuestion(BaseModel):
    """Which lift is asked, and in whose words."""

    lift: JobId | None = Field(None, description=THE_LIFT)
    encoder: str | None = Field(
        None, max_length=200, description="a text space that the operator set up, the lift's own, or default"
    )
    table: AssetId | None = Field(None, description="an uploaded text table that has the words, in place of encoder")


def _same(name: str) -> Any:
    """A field of a question with its default and description, which HTTP bounds."""
    field = Query.model_fields[name]
    return Field(field.default, description=field.description)


class Question(Query, LiftQuestion):
    """A question to a lift."""

    model_config = BUILT
    error_type: ClassVar = None
    text: Texts = _same("text")
    like: Examples = _same("like")
    negatives: Texts = _same("negatives")
    unlike: Examples = _same("unlike")


class Words(LiftQuestion, Body):
    """Many words at once."""

    words: Annotated[list[Text], Field(max_length=models.WORDS, fail_fast=True)] | None = Field(
        None, description="what may be there, each word once; all words of a table if left out"
    )


class AskedToSegment(Words, Seen):
    """Every splat's best word."""

    model_config = BUILT


class AskedWhat(Words):
    """What is this?"""

    model_config = BUILT
    example: AnExample = Field(description="what is meant")
    top: Annotated[int, Field(ge=1, le=1000), NoBoolean] = Field(5, description="how many words")


class AskedForWords(LiftQuestion):
    """What is being typed."""

    model_config = BUILT
    text: str = Field("", max_length=200, description="what was typed of a word; empty: what is here alone")
    limit: int = Field(8, ge=1, le=100, description="how many words at most")


class AskedToRender(Picture):
    """A picture of a lift's scene."""

    model_config = BUILT

    lift: JobId | None = Field(None, description=THE_LIFT)


class OfLift(BaseModel):
    """An answer of a lift."""

    lift: JobId


class SegmentAnswer(FoundWords, OfLift):
    """What is there, of many words."""

    encoder: str = Field(description="the text encoder that was asked, without its file")


class WhatAnswer(BestWords, OfLift):
    """The words that something is most like."""

    encoder: str


class WordsAnswer(AskableWords, OfLift):
    """What a lift can be asked."""


class QueryAnswer(Answer, OfLift):
    """An answer, with what it is of and where its pictures are."""

    view: str | None
    text_space: str = Field(description="of the lift's features")
    encoder: str | None = Field(description="the text encoder that was asked, without its file; null without a text")
    links: dict[str, str]


class ObjectsAnswer(Found, Objects, OfLift):
    """The things that were found."""


class CoveringRegions(OfLift):
    """The regions that cover a pixel."""

    view: str
    regions: list[CoveringRegion] = Field(description="one a level at most, the smallest first")


SelectionName = Annotated[str, Field(min_length=1, max_length=models.LIFT_NAME_CHARACTERS, pattern=models.PRINTABLE)]


class AskedEdit(Edit):
    """One change of a selection."""

    model_config = BUILT
    query: Question | None = Field(None, description="a question: the splats that answer it")  # pyright: ignore[reportIncompatibleVariableOverride]


class NewSelection(Body):
    """A selection to begin."""

    model_config = BUILT
    name: SelectionName = Field(description="for people")
    edit: AskedEdit | None = Field(None, description="how, of no splats, it begins; left out, it has none")


class SelectionChange(Body):
    """What to change of a selection; what is left out stays."""

    model_config = BUILT
    name: SelectionName | None = Field(None, description="for people")
    step: Annotated[int, Field(ge=0, le=10**9), NoBoolean] | None = Field(
        None, description="the number of a step of its history: undo and redo"
    )


class ThingChange(Body):
    """What to change of a thing; what is left out stays."""

    model_config = BUILT
    name: SelectionName | None = Field(None, description="of your own; null for the nearest word again")
    hidden: bool = Field(False, description="whether lists leave it out")


class Thing(BaseModel):
    """What somebody calls a thing of a lift."""

    id: int
    name: str | None = Field(description="null where it has none of its own")
    hidden: bool


class ListedSelection(OfLift):
    """A set of splats that is corrected by hand."""

    id: str
    name: str
    count: int = Field(description="splats")
    box: Box | None = Field(description="of its largest group of splats that touch; null of none")
    step: int = Field(description="where in its history it is")
    first: int = Field(description="the steps that it can go to, by PATCH")
    last: int
    version: int = Field(description="its ETag, for If-Match")
    created: float = Field(description="seconds since 1970")
    changed: float
    links: dict[str, str]


class SelectionStep(BaseModel):
    """A step of a selection's history."""

    number: int
    edit: dict[str, Any] = Field(description="what made it of the step before, without bits")
    count: int = Field(description="splats after it")


class Selection(ListedSelection):
    """A selection with its history."""

    history: list[SelectionStep] = Field(description="also the steps that were undone")
    bits: str | None = Field(description="base64 of a bit a splat, the first the lowest of its byte, if asked for")


class Selections(BaseModel):
    """The selections of a lift, newest first."""

    selections: list[ListedSelection]


class AskedForNodes(BaseModel):
    """Which nodes of a lift's tree to list, and what names them."""

    table: AssetId | None = Field(None, description="an uploaded text table: they are named by its words")
    encoder: str | None = Field(
        None,
        max_length=200,
        description="a text space that the operator set up as a table, the lift's own, or default: likewise",
    )
    limit: int = Field(100, ge=1, le=1000, description="how many to list")
    cursor: int = Field(0, ge=0, le=10**9, description="the `next` of the page before")


class AskedForSceneObjects(AskedForNodes):
    """Which objects to list, and what names them."""

    features: Annotated[bool, Field(description="with the mean feature of each")] = False
    splat: int | None = Field(None, ge=0, le=10**9, description="the one of this splat alone, by its row")


class LiftTree(SceneTree, OfLift):
    """Some of the nodes of a lift's tree: objects first, those with the most evidence first."""

    encoder: str | None = Field(description="what named them, without its file; null for nothing")
    next: int | None = Field(description="the cursor of the page after this one; null at the end")


class NamedObject(SceneObject):
    """A thing of a lift, perhaps with a name that somebody gave it."""

    hidden: bool = Field(description="whether somebody hid it")


class SceneObjects(ListedObjects, OfLift):
    """Some of the objects of a lift, those with the most evidence first."""

    objects: tuple[NamedObject, ...]  # pyright: ignore[reportIncompatibleVariableOverride]

    encoder: str | None = Field(description="what named them, without its file; null for nothing")
    next: int | None = Field(description="the cursor of the page after this one; null at the end")
