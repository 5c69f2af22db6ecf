"""Edit, the model of a change of a selection, for Python and HTTP; imports neither numpy nor torch."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from liftcore.errors import InvalidQuery
from liftcore.query.question import MOST_CHARACTERS, Box, OwnCamera, Query, as_own_camera
from liftcore.query.terms import Area, parse_example
from liftcore.runtime.fields import Body, NoBoolean

AREAS = "VIEW:box:x0,y0,x1,y1 or VIEW:stroke:x0,y0,x1,y1,..."
MOST_RADIUS = 1000.0  # pixels of a stroke
MOST_STEPS = 100  # that a selection grows or shrinks by at once
SOURCES = ("query", "area", "box", "bits")


class Edit(Body):
    """One change of a selection.

    ``set``, ``add`` and ``remove`` take the splats of one source: a query, an area of a view, a box or bits; ``set``
    without one selects nothing. ``grow`` adds the splats that touch a selected one, ``shrink`` removes those that
    touch one that is not selected.

    Raises:
        InvalidQuery: no source or several, or an area that is neither a box nor a stroke.
    """

    model_config = ConfigDict(frozen=True)
    error_type: ClassVar = InvalidQuery

    operation: Literal["set", "add", "remove", "grow", "shrink"] = Field(description="the kind of change")
    query: Query | None = Field(default=None, description="a question: the splats that answer it")
    area: Annotated[str, Field(min_length=1, max_length=MOST_CHARACTERS, description=AREAS)] | None = Field(
        default=None, description="of a view's image: the splats whose centres are seen there"
    )
    camera: Annotated[OwnCamera | None, BeforeValidator(as_own_camera)] = Field(
        default=None, description="of the area, in place of the view that it names"
    )
    radius: Annotated[float, Field(gt=0, le=MOST_RADIUS, allow_inf_nan=False), NoBoolean] = Field(
        default=8.0, description="of a stroke, in pixels of the view's image"
    )
    through: bool = Field(default=False, description="of an area: also the splats that others hide")
    box: Box | None = Field(default=None, description="the splats whose centres lie in it, world frame")
    bits: str | None = Field(
        default=None,
        description="base64 of a bit for each splat, in the order of their rows: the first is the lowest of its byte",
    )
    steps: Annotated[int, Field(ge=1, le=MOST_STEPS), NoBoolean] = Field(
        default=1, description="of grow and shrink: how many splats far"
    )

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        sources = [name for name in SOURCES if getattr(self, name) is not None]
        maximum, minimum = (0, 0) if self.operation in ("grow", "shrink") else (1, int(self.operation != "set"))
        if not minimum <= len(sources) <= maximum:
            expected = "no source" if not maximum else f"one of {', '.join(SOURCES)}"
            got = " and ".join(sources) or "none"
            raise InvalidQuery("operation", expected=f"{expected} with {self.operation}", got=got)
        if self.area is not None:
            self.parsed_area()
        return self

    def parsed_area(self) -> Area:
        """Parse the area; InvalidQuery if it is neither a box nor a stroke."""
        area = parse_example(str(self.area), "area")
        if not isinstance(area, Area) or area.kind == "pixel":
            raise InvalidQuery("area", expected=AREAS, got=repr(self.area))
        return area
