"""The settings of a lift: presets by name, and the knobs that they set.

Importing this module loads neither torch nor numba: the service validates requests with it.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from liftcore.errors import InvalidSettings

TIKHONOV_GAIN = 1.2  # lambda of the paper's Tikhonov Guidance (App. Tikhonov, lambda sweep)
LARGEST_ALPHA = 0.9999999  # nearer to one, float32 says one, and the ray has no light left to go on with
_SHOWN = 80  # characters of a wrong value in an error


class Preset(StrEnum):
    """A published choice of weights on the same ray walk."""

    ROW_SUM = "row-sum"  # x_j = sum w b / sum w, Eq. 6
    TIKHONOV = "tikhonov"  # x_j = sum w~^2 b / sum w~^2 with alpha~ = sigmoid(1.2 theta)


_PRESETS: dict[Preset, dict[str, Any]] = {
    Preset.ROW_SUM: {"power": 1, "lift_gain": 1.0, "render_gain": 1.0},
    Preset.TIKHONOV: {"power": 2, "lift_gain": TIKHONOV_GAIN, "render_gain": TIKHONOV_GAIN},
}


class LiftSettings(BaseModel):
    """All that decides the result of a lift. Knobs left out take the preset's values."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    preset: Preset = Preset.TIKHONOV
    power: Literal[1, 2] = Field(2, description="the weight's exponent: w or w^2")
    lift_gain: float = Field(TIKHONOV_GAIN, gt=0, le=16, description="lambda on the opacity logits, lifting")
    render_gain: float = Field(TIKHONOV_GAIN, gt=0, le=16, description="lambda on the opacity logits, rendering")
    alpha_cap: float = Field(0.99, gt=0, le=LARGEST_ALPHA, description="the largest alpha of a splat on a ray")
    transmittance_stop: float = Field(1e-4, ge=0, lt=1, description="a ray ends before T falls to this")
    grid_reading: Literal["bilinear", "nearest"] = Field(
        "bilinear", description="what a pixel reads of a feature grid: four cells by distance, or the nearest alone"
    )
    dtype: Literal["float16", "float32"] = Field(
        "float16", description="how features are stored, if it can hold them"
    )
    certificate_rays: int = Field(10_000, ge=0, le=10_000_000, description="rays sampled for the certificate")
    seed: int = Field(0, ge=0, lt=2**31, description="of the certificate's sample")

    @model_validator(mode="before")
    @classmethod
    def _fill_from_preset(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        name = values.get("preset", Preset.TIKHONOV)
        known = isinstance(name, str) and name in set(Preset)
        return {**_PRESETS[Preset(name)], **values} if known else values

    @classmethod
    def of(cls, /, **values: Any) -> Self:
        """Settings from keyword arguments, with errors in the project's own words.

        Raises:
            InvalidSettings: an unknown name or a value out of range.
        """
        try:
            return cls(**values)
        except ValidationError as error:
            first = error.errors()[0]
            name = ".".join(str(part) for part in first["loc"]) or "settings"
            expected = first["msg"][0].lower() + first["msg"][1:]
            known = ", ".join(cls.model_fields)
            hint = f"the settings are {known}" if first["type"] == "extra_forbidden" else ""
            raise InvalidSettings(name, expected=expected, got=repr(first["input"])[:_SHOWN], hint=hint) from None
