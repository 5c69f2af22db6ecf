"""What models of requests and answers share: strict fields, and one error in words for what does not fit."""

from __future__ import annotations

import re
from typing import Any, ClassVar

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    ModelWrapValidatorHandler,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from liftcore.errors import SplatliftError
from liftcore.runtime.arguments import one_of
from liftcore.runtime.one_line import one_line, value_text

NAME_CHARACTERS = 80  # of a name or a value that came, told back


def takes(expected: str) -> WrapValidator:
    """Says what a union takes, in one error in place of one for each of its branches."""

    def check(value: Any, branches: ValidatorFunctionWrapHandler) -> Any:
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


class Shown(BaseModel):
    """A model that Python prints in a line: the fields that were given."""

    def __repr__(self) -> str:
        given = self.model_fields_set
        return one_line(self, *(f"{name}={value_text(value)}" for name, value in self if name in given))

    def __str__(self) -> str:
        return repr(self)


class Body(Shown):
    """What a body, or a part of one, may hold. A field that is not known is refused with those that are."""

    model_config = ConfigDict(extra="forbid", defer_build=True)  # help lists fields, and checks none
    error_type: ClassVar[type[SplatliftError] | None] = None  # what stands in for pydantic's errors; None: nothing

    @model_validator(mode="before")
    @classmethod
    def _knows(cls, given: Any) -> Any:
        for name in given if isinstance(given, dict) else ():
            if name not in cls.model_fields:
                # Half a surrogate pair, which JSON can name, would break pydantic's own report.
                shown = name[:NAME_CHARACTERS].encode("utf-8", "backslashreplace").decode()
                context = {"field": shown, "expected": one_of(cls.model_fields)}
                raise PydanticCustomError("unknown_field", "{expected}", context)
        return given

    @model_validator(mode="wrap")
    @classmethod
    def _in_words(cls, given: Any, handler: ModelWrapValidatorHandler[Any]) -> Any:
        if cls.error_type is None:
            return handler(given)
        try:
            return handler(given)
        except ValidationError as error:
            raise _error_of(cls, error, cls.error_type) from None


def _error_of(model: type[BaseModel], error: ValidationError, error_type: type[SplatliftError]) -> SplatliftError:
    """The first thing that does not fit, with all that its field takes."""
    first = error.errors(include_url=False)[0]
    context, place = first.get("ctx", {}), [str(part) for part in first["loc"]]
    place = [context["field"]] if first["type"] == "unknown_field" else place
    got = repr(first["input"])[:NAME_CHARACTERS] if first["type"] != "unknown_field" else "a field that is not there"
    expected = context.get("expected") or re.sub(r"^\w+ should (be|have) ", "", first["msg"])
    if first["type"] == "literal_error":
        expected = one_of(re.findall(r"'([^']*)'", expected))
    elif place and place[0] in model.model_fields and first["type"] in ("greater_than_equal", "less_than_equal"):
        low, high = bounds_of(model.model_json_schema()["properties"][place[0]])
        expected = f"{low} to {high}" if None not in (low, high) else expected
    return error_type(".".join(place) or model.__name__.lower(), expected=expected, got=got)


def bounds_of(schema: dict[str, Any]) -> tuple[Any, Any]:
    """The least and the greatest number of a field, by its JSON schema; None where it has none."""
    parts = [schema, *schema.get("anyOf", ())]
    low, high = (next((part[name] for part in parts if name in part), None) for name in ("minimum", "maximum"))
    return low, high
