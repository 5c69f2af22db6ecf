"""Settings as JSON and as keyword arguments, and errors of invalid ones."""

from __future__ import annotations

from typing import Any

import pytest

from liftcore.errors import InvalidSettings
from liftcore.values.settings import LiftSettings, Preset


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("antialiased", 1, "a valid boolean or 'auto'"),
        ("gain", float("nan"), "less than or equal to 16"),
        ("preset", "\ud800", "'default', 'row-sum', 'tikhonov', 'argmax' or 'top-k'"),
    ],
)
def test_json_has_types(name: str, value: Any, expected: str) -> None:
    with pytest.raises(InvalidSettings) as raised:
        LiftSettings.of_json({name: value})
    assert (raised.value.argument, raised.value.expected) == (name, expected)
    assert len(raised.value.got) <= 80


def test_json_may_write_whole_numbers_with_a_point() -> None:
    settings = LiftSettings.of_json({"stride": 2.0, "gain": 2, "preset": "row-sum", "levels": 1.0})
    assert settings == LiftSettings.of(stride=2, gain=2.0, preset=Preset.ROW_SUM, levels=1)
    assert isinstance(settings.stride, int)


@pytest.mark.parametrize("preset", list(Preset))
def test_a_preset_only_fills_settings_that_are_not_given(preset: Preset) -> None:
    preset_settings = LiftSettings.of(preset=preset)
    explicit = LiftSettings.of(preset=preset, power=1, top_k=7, alpha_cap=0.5)
    assert (explicit.power, explicit.top_k, explicit.alpha_cap) == (1, 7, 0.5)
    assert explicit.gain == preset_settings.gain
    assert LiftSettings.of(**preset_settings.model_dump(mode="json")) == preset_settings
