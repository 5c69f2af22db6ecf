"""Base models of requests and answers: strict fields, and one readable error for an invalid value."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, ClassVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError, WrapValidator, model_validator
from pydantic_core import PydanticCustomError

from liftcore.errors import SplatliftError
from liftcore.runtime.arguments import nearest, one_of
from liftcore.runtime.one_line import one_line, value_text

NAME_CHARACTERS = 80  # of an invalid name or value, in an error
NEAREST = 3  # fields that are named where one is unknown


def takes(expected: str) -> WrapValidator:
    """Return a validator of a union with one error, in place of one error a branch."""

    def check(value: Any, branches: Callable[[Any], Any]) -> Any:
        try:
            return branches(value)
        except ValidationError:
            raise PydanticCustomError("takes", "{expected}", {"expected": expected}) from None

    return WrapValidator(check)


def _no_boolean(value: Any) -> Any:
    if isinstance(value, bool):
        raise PydanticCustomError("no_number", "{expected}", {"expected": "a number"})
    return value


NoBoolean = BeforeValidator(_no_boolean)  # of a number: pydantic reads true as 1


class PlainModel(BaseModel):
    """A model whose representation is one line: the fields that were set."""

    error_type: ClassVar[type[SplatliftError] | None] = None  # in place of pydantic's errors; None: these

    def __repr__(self) -> str:
        names = self.model_fields_set
        return one_line(self, *(f"{name}={value_text(value)}" for name, value in self if name in names))

    def __str__(self) -> str:
        return repr(self)


class Body(PlainModel):
    """The body of a request, or a part of one. An unknown field is an error that lists the known ones."""

    model_config = ConfigDict(extra="forbid", defer_build=True)  # help lists fields, and checks none
    noun: ClassVar[str] = "field"  # of a field, in errors

    @model_validator(mode="before")
    @classmethod
    def _check_names(cls, values: Any) -> Any:
        for name in values if isinstance(values, dict) else ():
            if name not in cls.model_fields:
                # Half a surrogate pair, which JSON can name, would break pydantic's own report.
                text = name[:NAME_CHARACTERS].encode("utf-8", "backslashreplace").decode()
                context = {"field": text, "expected": one_of(cls.model_fields)}
                raise PydanticCustomError("unknown_field", "{expected}", context)
        return values

    @model_validator(mode="wrap")
    @classmethod
    def _in_words(cls, values: Any, handler: Callable[[Any], Any]) -> Any:
        try:
            return handler(values)
        except ValidationError as error:
            if cls.error_type is None:
                raise
            raise _error_of(cls, error, cls.error_type) from None


def _error_of(model: type[Body], error: ValidationError, error_type: type[SplatliftError]) -> SplatliftError:
    """Return the error of the first invalid field, with the values that it may have."""
    first = error.errors(include_url=False)[0]
    context, kind, place = first.get("ctx", {}), first["type"], [str(part) for part in first["loc"]]
    got, hint = repr(first["input"])[:NAME_CHARACTERS], ""
    expected = context.get("expected") or re.sub(r"^\w+ should (be|have) ", "", first["msg"])
    if kind == "unknown_field":
        place = [context["field"]]
        got, hint = f"an unknown {model.noun}", nearest(place[0], model.model_fields, NEAREST)
    elif kind == "literal_error":
        expected = one_of(re.findall(r"'([^']*)'", expected))
    elif place and place[0] in model.model_fields and kind in ("greater_than_equal", "less_than_equal"):
        schema = model.model_json_schema()["properties"][place[0]]
        parts = [schema, *schema.get("anyOf", ())]
        low, high = (next((part[name] for part in parts if name in part), None) for name in ("minimum", "maximum"))
        expected = f"{low} to {high}" if None not in (low, high) else expected
    return error_type(".".join(place) or model.__name__.lower(), expected=expected, got=got, hint=hint)
