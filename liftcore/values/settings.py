"""The settings of a lift: presets by name, and the knobs that they set.

Importing this module loads neither torch nor numba: the service validates requests with it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import ConfigDict, Field, ModelWrapValidatorHandler, model_validator

from liftcore.errors import InvalidSettings
from liftcore.runtime.arguments import device_name
from liftcore.runtime.fields import Body, takes
from liftcore.scene.compositing import LARGEST_ALPHA, MOST_OF_A_RAY, CompositingParams, Weighting, check_antialiased

if TYPE_CHECKING:  # it loads torch
    from liftcore.scene.splats import Splats

TIKHONOV_GAIN = 1.2  # lambda of the paper's Tikhonov Guidance (App. Tikhonov, lambda sweep)
NO_MASKS = "grids, or maps without a label"
DIRECTIONS = 256  # no loss with masks; 128 lower the mask IoU by .0025 with few views (docs/results.md)


class Preset(StrEnum):
    """Named groups of settings: `default` is this project's method, which tolerates wrong masks.

    The others are published methods, which differ in the weights of a ray that count.
    """

    DEFAULT = "default"  # row-sum, reweighted by mask consensus, by region reliability and by view consistency
    ROW_SUM = "row-sum"  # x_j = sum w b / sum w, Eq. 6
    TIKHONOV = "tikhonov"  # x_j = sum w~^2 b / sum w~^2 with alpha~ = sigmoid(1.2 theta)
    ARGMAX = "argmax"  # the largest w of a ray alone
    TOP_K = "top-k"  # the 40 largest w of a ray (Dr. Splat's paper)


_PRESETS: dict[str, dict[str, Any]] = {
    Preset.DEFAULT: {"robust": True},
    Preset.ROW_SUM: {},
    Preset.TIKHONOV: {"power": 2, "gain": TIKHONOV_GAIN},
    Preset.ARGMAX: {"top_k": 1},
    Preset.TOP_K: {"top_k": 40},
}


class Quality(StrEnum):
    """Level of the trade-off between speed and accuracy."""

    EXACT = "exact"  # every pixel of every view
    BALANCED = "balanced"
    FAST = "fast"
    DRAFT = "draft"


_LEVELS: dict[str, dict[str, Any]] = {
    Quality.EXACT: {},
    Quality.BALANCED: {"stride": 2, "diagnostic_rays": 2_000},
    Quality.FAST: {
        "stride": 3,
        "robust_directions": 128,
        "view_cosine": 0.992,
        "coverage": 40,
        "transmittance_stop": 0.003,
        "diagnostic_rays": 500,
    },
    Quality.DRAFT: {
        "stride": 4,
        "robust_directions": 64,
        "objects": False,
        "view_cosine": 0.98,
        "coverage": 20,
        "transmittance_stop": 0.01,
        "diagnostic_rays": 200,
    },
}


MOST_DIAGNOSTIC_RAYS = 1_000_000  # 10 million rays of one view took 8 GB


class LiftSettings(Body):
    """All that decides the result of a lift, and where it runs. Knobs left out take the preset's values."""

    model_config = ConfigDict(frozen=True)
    error_type: ClassVar = InvalidSettings
    noun: ClassVar = "setting"
    groups: ClassVar = {  # of the settings, for people who read all of them
        "a choice of many": ("preset", "quality"),
        "weights of a ray that count": ("top_k", "power"),
        "pixels, views and levels": ("stride", "view_stride", "coverage", "view_cosine", "levels"),
        "the rasterizer": ("kernel", "antialiased", "gain", "alpha_cap", "transmittance_stop"),
        "wrong masks": ("robust", "robust_directions"),
        "objects and clusters": ("objects", "aggregation", "aggregation_iou", "aggregation_cluster_size"),
        "neighbours": ("smoothness",),
        "the result and its place": ("dtype", "codes", "diagnostic_rays", "reference_channels", "seed", "device"),
    }  # fmt: skip

    preset: Preset = Field(Preset.DEFAULT, description="sets `top_k`, `power` and `gain`; `default` also `robust`")
    quality: Quality = Field(
        Quality.EXACT,
        description="level of quality: `exact`, `balanced`, `fast` or `draft`, from the slowest to the fastest. It "
        "sets others; what you set yourself wins",
    )
    top_k: int = Field(
        0,
        ge=0,
        le=MOST_OF_A_RAY,
        description="only this many of the largest weights of a ray count, 1 to 64; of equal ones the nearest to the "
        "camera. 0: all",
    )
    power: int = Field(1, ge=1, le=2, description="exponent of the weights that count")
    gain: float = Field(
        1.0, gt=0, le=16, description="gain on the opacity logits, in lifting and in rendering scores"
    )
    alpha_cap: float = Field(0.99, gt=0, le=LARGEST_ALPHA, description="largest alpha of a splat on a ray")
    transmittance_stop: float = Field(
        1e-4, ge=0, lt=1, description="a ray ends before its transmittance falls to this"
    )
    antialiased: Annotated[bool | Literal["auto"], takes("a valid boolean or 'auto'")] = Field(
        "auto",
        description="true: `alpha~ = sigmoid(gain theta) sqrt(det(cov) / det(cov + low-pass))`, for 3DGS scenes "
        "that were trained so; refused for 2DGS and DBS. `auto`: true if the file's metadata has it, else "
        "false. The lift's metadata have what was used, and every answer uses the same",
    )
    stride: int = Field(
        1,
        ge=1,
        le=64,
        description="lift from every n-th pixel in x and in y; the total weight is scaled to all pixels",
    )
    view_stride: int = Field(1, ge=1, description="lift from every n-th view by name, from the first on")
    coverage: int = Field(
        0,
        ge=0,
        description="choose views until each splat is shown this many times on average (before occlusion); 0 "
        "takes all. With `view_cosine` it is the minimum",
    )
    view_cosine: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="choose the fewest views from which features are expected to have this mean cosine to those "
        "from all views (before reweighting); for 33 views and more. 0 takes all",
    )
    levels: Annotated[
        Literal["rows"] | Annotated[int, Field(strict=True, ge=0)], takes("'rows' or the number of a level")
    ] = Field("rows", description="levels of a region map: `rows` are those of all, a number is the one to take")
    robust: bool = Field(
        False,
        description="multiply each region's weight at a splat by its agreement with the other views; masks also by "
        "their reliability and by what masks of other views keep together",
    )
    robust_directions: int = Field(
        DIRECTIONS,
        ge=1,
        le=4_096,
        description="principal directions of the features in which a robust step compares regions, where channels "
        "are more and regions have many splats each; fewer are faster",
    )
    objects: Annotated[bool | Literal["auto"], takes("a valid boolean or 'auto'")] = Field(
        "auto",
        description="find objects without words: `auto` where there are masks (with several levels only beside a "
        "robust step), `true` always (region weights of several levels then take twice as long), "
        "`false` never",
    )
    dtype: Literal["float16", "float32"] = Field(
        "float16", description="how features are stored, or `float32`; what float16 cannot hold is stored as float32"
    )
    codes: bool = Field(
        True,
        description="the file has two bytes a splat for features, the number of one of at most 8,192 rows, where a "
        "held-out sample loses little by it; `false` keeps a row a splat",
    )
    aggregation: bool = Field(False, description="one feature a cluster of splats, by HDBSCAN")
    aggregation_iou: float = Field(
        0.75,
        gt=0,
        le=1,
        description="a region is kept if its IoU with the silhouette of its cluster is at least this; rays with a "
        "row sum below a half are in no silhouette",
    )
    aggregation_cluster_size: int = Field(
        500, ge=2, le=10_000_000, description="the least number of splats in a cluster"
    )
    diagnostic_rays: int = Field(
        4_000, ge=0, le=MOST_DIAGNOSTIC_RAYS, description="rays sampled for the diagnostics, a million at most"
    )
    seed: int = Field(
        0,
        ge=0,
        lt=2**31,
        description="of all samples, of a stride's first pixel in each view, and of random projections",
    )
    smoothness: float = Field(
        0.0,
        ge=0,
        le=1e6,
        description="strength of the smoothing over splats that are near in place and in colour: 0 is off, 4 helps "
        "grids and few views of masks. A large number loses accuracy where features vary within an object; "
        "`splatlift tradeoff` tries it on held-out views. "
        "It runs on the CPU, also with `device=cuda`",
    )
    reference_channels: int = Field(
        0,
        ge=0,
        le=1_024,
        description="compare the lift with the least-squares optimum in the diagnostics, in this many random "
        "projections of the channels: 12 bytes of memory for each splat on a ray",
    )
    kernel: Literal["auto", "3dgs", "2dgs", "dbs"] = Field(
        "auto",
        description="`3dgs`, `2dgs` or `dbs`; `auto` decides by the file's properties and metadata. A "
        "2DGS scene with three scales and without metadata looks like 3DGS: set `2dgs`",
    )
    device: Literal["auto", "cpu", "cuda"] = Field(
        "auto", description="`cpu`, `cuda`, or `auto` for a GPU where one can be used"
    )

    @model_validator(mode="wrap")
    @classmethod
    def _fill_from_preset_and_quality(cls, values: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if not isinstance(values, dict):
            return handler(values)
        if "device" in values:
            values = values | {"device": device_name(values["device"])}
        preset, quality = values.get("preset", Preset.DEFAULT), values.get("quality", Quality.EXACT)
        weights = _PRESETS.get(preset, {}) if isinstance(preset, str) else {}
        level = _LEVELS.get(quality, {}) if isinstance(quality, str) else {}
        settings = handler({**weights, **level, **values})
        settings.model_fields_set.intersection_update(values)  # set by the caller; they stay when the preset changes
        return settings

    @property
    def compositing(self) -> CompositingParams:
        """Compositing of a lift, at every pixel, and of attention maps and masks of it."""
        antialiased = self.antialiased is True  # `for_splats` replaces "auto" by the file's mode; before, it is False
        return CompositingParams(self.gain, self.alpha_cap, self.transmittance_stop, antialiased)

    def for_splats(self, splats: Splats) -> Self:
        """Return the same with ``antialiased`` as true or false: what auto means for these splats.

        Raises:
            InvalidSettings: it is true, and the splats are no 3D Gaussians.
        """
        antialiased = splats.antialiased if self.antialiased == "auto" else self.antialiased
        check_antialiased(splats.kernel, antialiased)
        return self if antialiased == self.antialiased else self.model_copy(update={"antialiased": antialiased})

    @property
    def weighting(self) -> Weighting:
        """Definition of a weight while lifting."""
        return Weighting(self.power, self.top_k)

    @property
    def weighs_rows(self) -> bool:
        """True if W needs a column for each region; else levels may share one for each distinct tuple of labels."""
        return self.robust or self.objects is True

    def finds_objects(self, masks: bool) -> bool:
        """Return True if objects are looked for, where views have masks or not.

        Raises:
            InvalidSettings: objects are required, and no view has masks.
        """
        if self.objects is True and not masks:
            expected = "views with masks: objects are what masks of several views keep together"
            raise InvalidSettings("objects", expected=expected, got=NO_MASKS, hint="take auto")
        return masks and bool(self.objects)

    @classmethod
    def of(cls, /, **values: Any) -> Self:
        """Return settings from keyword arguments; texts may stand for numbers, as on a command line.

        Raises:
            InvalidSettings: an unknown name or a value out of range.
        """
        return cls(**values)

    @classmethod
    def or_default(cls, settings: Self | None) -> Self:
        """Return settings as they are, or the default ones for None.

        Raises:
            InvalidSettings: ``settings`` are something else.
        """
        if settings is not None and not isinstance(settings, cls):
            expected, hint = "LiftSettings, or None", "LiftSettings.of(**values) makes them"
            raise InvalidSettings("settings", expected=expected, got=repr(settings)[:80], hint=hint)
        return cls.of() if settings is None else settings

    @classmethod
    def from_preset(cls, preset: Preset | str | Self, changes: Mapping[str, Any]) -> Self:
        """Return a preset by its name, or settings as they are, with others in place of some.

        Raises:
            InvalidSettings: an unknown name or a value out of range.
        """
        if not isinstance(preset, cls):
            return cls.of(preset=preset, **changes)
        if not changes:
            return preset
        base = {"preset": preset.preset, "quality": preset.quality}
        values, defaults = preset.model_dump(), cls.of(**base).model_dump()
        explicit = preset.model_fields_set
        explicit = explicit if len(explicit) < len(values) else set()  # all of them: settings of a file
        overrides = {name: value for name, value in values.items() if name in explicit or value != defaults[name]}
        return cls.of(**base | overrides | {**changes})

    @classmethod
    def of_json(cls, values: Mapping[str, Any]) -> Self:
        """Return settings from JSON, where a boolean is no number.

        Raises:
            InvalidSettings: an unknown name, or a value of another type or out of range.
        """
        # Some write a whole number as 2.0.
        normalised = {
            name: int(value) if isinstance(value, float) and value.is_integer() else value
            for name, value in values.items()
        }
        # A lone surrogate cannot be encoded: it becomes "?", which is refused as an unknown value.
        text = json.dumps(normalised, ensure_ascii=False).encode("utf-8", "replace")
        return cls.model_validate_json(text, strict=True)
