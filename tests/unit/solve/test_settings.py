"""Settings as JSON and as keyword arguments, and what is told of those that do not fit."""

from __future__ import annotations

from enum import StrEnum
from typing import Any, Literal, get_type_hints

import pytest
import torch

from liftcore.errors import InvalidSettings
from liftcore.values.lift import LiftMetadata
from liftcore.values.lift_options import LiftOptions
from liftcore.values.settings import LiftSettings, Preset, Speed

LEVELS = "'rows' or 'composite' or a valid integer"


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("stride", 2.5, "a valid integer"),
        ("power", True, "a valid integer"),
        ("power", 3, "less than or equal to 2"),
        ("antialiased", 1, "a valid boolean or 'auto'"),
        ("lift_gain", "1.2", "a valid number"),
        ("lift_gain", float("nan"), "less than or equal to 16"),
        ("levels", True, LEVELS),
        ("mass", 0, "greater than 0"),
        ("preset", "\ud800", "'default', 'row-sum', 'tikhonov', 'argmax', 'top-k', 'front-mass', 'centre' or 'mean'"),
        ("diagnostic_rays", 1_000_001, "at most 1000000 rays"),
        ("k", 65, "less than or equal to 64"),
    ],
)
def test_json_has_types(name: str, value: Any, expected: str) -> None:
    with pytest.raises(InvalidSettings) as raised:
        LiftSettings.of_json({name: value})
    assert (raised.value.argument, raised.value.expected) == (name, expected)
    assert len(raised.value.got) <= 80


def test_json_may_write_whole_numbers_with_a_point() -> None:
    settings = LiftSettings.of_json({"stride": 2.0, "lift_gain": 2, "preset": "row-sum", "levels": 1.0})
    assert settings == LiftSettings.of(stride=2, lift_gain=2.0, preset=Preset.ROW_SUM, levels=1)
    assert isinstance(settings.stride, int)


def test_texts_may_stand_for_numbers_on_a_command_line() -> None:
    assert LiftSettings.of(stride="2", lift_gain="1.5") == LiftSettings.of_json({"stride": 2, "lift_gain": 1.5})


@pytest.mark.parametrize("made", [LiftSettings.of_json, lambda values: LiftSettings.of(**values)])
def test_what_is_wrong_is_told_in_our_words(made: Any) -> None:
    with pytest.raises(
        InvalidSettings, match=r"^lambda: expected one of preset, speed, .*, got an unknown setting; nearest: "
    ):
        made({"lambda": 1.2})
    with pytest.raises(InvalidSettings, match=r"^settings: expected other levels than composite"):
        made({"aggregation_resolve": True, "levels": "composite"})
    with pytest.raises(InvalidSettings, match=r"^settings: expected aggregation_clusters=hdbscan"):
        made({"aggregation_resolve": True, "aggregation_clusters": "graph"})
    with pytest.raises(InvalidSettings, match=r"^settings: expected robust_steps of 1 or more"):
        made({"robust_steps": 0, "aggregation_guard": True})
    with pytest.raises(InvalidSettings, match=r"^settings: expected cg_steps=0 beside loss=huber"):
        made({"loss": "huber", "cg_steps": 1})


def test_published_schema_has_every_setting_and_what_a_new_lift_may_have() -> None:
    fields = LiftSettings.model_json_schema()["properties"]
    assert set(fields) == set(LiftSettings.model_fields)
    for name, field in fields.items():
        assert field.get("description") or name == "preset", name
        for end in ("minimum", "maximum"):
            if end in field:
                LiftSettings.of_json({name: field[end]})
    with pytest.raises(InvalidSettings):
        LiftSettings.of_json({"diagnostic_rays": fields["diagnostic_rays"]["maximum"] + 1})


def test_regions_are_kept_from_the_papers_tau_on() -> None:
    assert LiftSettings.of().aggregation_iou == 0.75  # tau of the paper, Post Aggregation Filtering


@pytest.mark.parametrize("preset", list(Preset))
def test_a_preset_only_fills_what_is_not_said(preset: Preset) -> None:
    plain = LiftSettings.of(preset=preset)
    said = LiftSettings.of(preset=preset, power=1, weight_floor=0.25, selection="front-mass", mass=0.5)
    assert (said.power, said.weight_floor, said.selection, said.mass) == (1, 0.25, "front-mass", 0.5)
    assert said.render_gain == plain.render_gain
    assert LiftSettings.of(**plain.model_dump(mode="json")) == plain


@pytest.mark.parametrize("speed", Speed)
def test_a_lift_from_before_a_setting_does_not_tell_what_the_dial_sets_today(speed: Speed) -> None:
    settings = LiftSettings.of(speed=speed)
    made = LiftMetadata(version="1", settings=settings, views=("a",), diagnostics={}, timings={})
    told = made.model_dump(mode="json")
    assert LiftMetadata.model_validate(told).settings == settings
    del told["settings"]["robust_directions"], told["settings"]["consensus"]
    old = LiftMetadata.model_validate(told).settings
    assert old == settings.model_copy(update={"robust_directions": 256, "consensus": False})


def test_keyword_arguments_of_a_lift_are_typed_as_its_settings() -> None:
    hints = get_type_hints(LiftOptions, localns={"torch": torch})
    fields = {name: field.annotation for name, field in LiftSettings.model_fields.items() if name != "preset"}
    assert list(hints) == list(fields)
    assert hints.pop("device") == str | torch.device and fields.pop("device")
    for name, annotation in fields.items():
        allowed: Any = annotation
        if isinstance(annotation, type) and issubclass(annotation, StrEnum):
            allowed = annotation | Literal[tuple(str(one) for one in annotation)]
        elif annotation == LiftSettings.model_fields["levels"].annotation:
            allowed = Literal["rows", "composite"] | int
        elif name == "smoothness":
            allowed = float | Literal["auto"]
        assert hints[name] == allowed, name
