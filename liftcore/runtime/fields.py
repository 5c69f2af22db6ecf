"""Base models of requests and answers: strict fields, old names, and one readable error for an invalid value."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, ClassVar, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    GetJsonSchemaHandler,
    ModelWrapValidatorHandler,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    computed_field,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError

from liftcore.errors import InvalidInput, SplatliftError
from liftcore.runtime.aliases import add_deprecated_properties, current_names, deprecated_getter, with_old_names
from liftcore.runtime.arguments import one_of
from liftcore.runtime.one_line import one_line, value_text

NAME_CHARACTERS = 80  # of an invalid name or value, in an error


def takes(expected: str) -> WrapValidator:
    """Return a validator of a union with one error, in place of one error a branch."""

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


class AliasedModel(BaseModel):
    """A model that is read by old names of its fields too, and written by the new (`liftcore.runtime.aliases`)."""

    old_names: ClassVar[Mapping[str, str]] = {}  # new names of fields by old ones
    old_values: ClassVar[Mapping[str, Mapping[str, str]]] = {}  # by field: new values by old ones
    error_type: ClassVar[type[SplatliftError] | None] = None  # in place of pydantic's errors; None: these

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        cls.old_names = {old: new for base in reversed(cls.__mro__) for old, new in _old_names(base).items()}
        add_deprecated_properties(cls, {old: new for old, new in cls.old_names.items() if not hasattr(cls, old)})

    @model_validator(mode="before")
    @classmethod
    def _by_current_names(cls, values: Any) -> Any:
        return cls.current_names(values) if isinstance(values, dict) else values

    @classmethod
    def current_names(cls, values: dict[str, Any]) -> dict[str, Any]:
        """Return values of fields under their new names, with new values in place of old ones.

        Raises:
            SplatliftError: of the model's type of errors; an old and a new name have different values.
        """
        if cls.old_values:
            values = {name: cls.current_value(cls.old_names.get(name, name), value) for name, value in values.items()}
        return current_names(values, cls.old_names, cls.error_type or InvalidInput) if cls.old_names else values

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with other values of some fields, by old names too; they are not validated."""
        return super().model_copy(update=update and self.current_names(dict(update)), deep=deep)

    @classmethod
    def current_value(cls, name: str, value: Any) -> Any:
        """Return the new value of a field for an old one; other values stay."""
        return cls.old_values.get(name, {}).get(value, value) if isinstance(value, str) else value

    @classmethod
    def with_old_names(cls, values: dict[str, Any]) -> dict[str, Any]:
        """Return values of fields with each old name behind its new one, as replies have both."""
        return with_old_names(cls.current_names(values), cls.old_names)

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the model's schema; of what is read, old names are deprecated properties."""
        document = handler(schema)
        properties = handler.resolve_ref_schema(document).get("properties", {})
        for old, new in cls.old_names.items() if handler.mode == "validation" else ():
            if new in properties:
                properties[old] = {**properties[new], "description": f"the old name of {new}", "deprecated": True}
        return document


def _old_names(model: type) -> Mapping[str, str]:
    return vars(model).get("old_names", {})


def old_field(new: str, annotation: Any) -> Any:
    """Return a field that a reply has beside the one of the new name, with the same value, marked as deprecated."""
    description = f"the old name of {new}"
    field = property(deprecated_getter(new, readers=("pydantic",)), doc=f"Deprecated: `{new}`.")
    decorate = computed_field(return_type=annotation, description=description, json_schema_extra={"deprecated": True})
    return decorate(field)


class PlainModel(AliasedModel):
    """A model whose representation is one line: the fields that were set."""

    def __repr__(self) -> str:
        names = self.model_fields_set
        return one_line(self, *(f"{name}={value_text(value)}" for name, value in self if name in names))

    def __str__(self) -> str:
        return repr(self)


class Body(PlainModel):
    """The body of a request, or a part of one. An unknown field is an error that lists the known ones."""

    model_config = ConfigDict(extra="forbid", defer_build=True)  # help lists fields, and checks none

    @model_validator(mode="before")
    @classmethod
    def _check_names(cls, values: Any) -> Any:
        if isinstance(values, dict):
            values = cls.current_names(values)
        for name in values if isinstance(values, dict) else ():
            if name not in cls.model_fields:
                # Half a surrogate pair, which JSON can name, would break pydantic's own report.
                text = name[:NAME_CHARACTERS].encode("utf-8", "backslashreplace").decode()
                context = {"field": text, "expected": one_of(cls.model_fields)}
                raise PydanticCustomError("unknown_field", "{expected}", context)
        return values

    @model_validator(mode="wrap")
    @classmethod
    def _in_words(cls, values: Any, handler: ModelWrapValidatorHandler[Any]) -> Any:
        if cls.error_type is None:
            return handler(values)
        try:
            return handler(values)
        except ValidationError as error:
            raise _error_of(cls, error, cls.error_type) from None


def _error_of(model: type[BaseModel], error: ValidationError, error_type: type[SplatliftError]) -> SplatliftError:
    """Return the error of the first invalid field, with the values that it may have."""
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
    """Return the minimum and the maximum of a field, by its JSON schema; None for no bound."""
    parts = [schema, *schema.get("anyOf", ())]
    low, high = (next((part[name] for part in parts if name in part), None) for name in ("minimum", "maximum"))
    return low, high
