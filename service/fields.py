"""What a client is told of a field that does not fit: one error, in words, whatever pydantic would make of it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    GetJsonSchemaHandler,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError

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
