"""The JSON of questions: what liftcore declares, with the lift that is asked, its encoder, and bounds of HTTP."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, BaseModel, Field
from pydantic_core import PydanticCustomError

from liftcore import Answer, CoveringRegion, Objects, Picture, Query
from liftcore.models import (
    NOTATIONS,
    AskableWords,
    BestWords,
    Body,
    Found,
    FoundWords,
    ListedObjects,
    NoBoolean,
    Notation,
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


class SceneObjects(ListedObjects, OfLift):
    """Some of the objects of a lift, those with the most evidence first."""

    encoder: str | None = Field(description="what named them, without its file; null for nothing")
    next: int | None = Field(description="the cursor of the page after this one; null at the end")
