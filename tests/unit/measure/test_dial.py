"""The bench of the dial."""

from __future__ import annotations

import pytest

from liftcore.settings import Preset, Speed
from tests.benchmarks.dial import main, measure_dial
from tests.benchmarks.room_scene import Room, write_room
from tests.benchmarks.room_scene import main as room_main


@pytest.fixture
def room(tmp_path):
    write_room(tmp_path, Room(splats=1_000, views=6, size=(64, 48), channels=16, alike=0.6))
    return tmp_path


def test_the_exact_lift_is_measured_whatever_is_asked_for_and_others_beside_it(room):
    exact, fast = measure_dial(room, [Speed.FAST], 1, Preset.ROW_SUM)
    assert (exact["speed"], fast["speed"]) == ("exact", "fast")
    assert exact["views"] == fast["views"] == 6  # too few for a pilot
    assert exact["cosine"] == pytest.approx(1.0)
    assert 0.5 < fast["cosine"] < 1.0
    assert exact["less_than_exact"] == 1.0
    assert fast["less_than_exact"] == exact["processor_seconds"] / fast["processor_seconds"]


def test_the_table_has_a_line_for_each_speed(room, capsys):
    assert main([str(room), "--speeds", "draft", "--rounds", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:3]] == ["dial", "exact", "draft"]


@pytest.mark.parametrize(
    ("command", "given", "told"),
    [
        (main, ["--rounds", "0"], "--rounds: expected one at least, got 0"),
        (room_main, ["--alike", "1.5"], "--alike: expected a cosine from 0 to below 1, got 1.5"),
    ],
)
def test_what_can_be_neither_counted_nor_made_is_refused_in_words(tmp_path, capsys, command, given, told):
    with pytest.raises(SystemExit, match="2"):
        command([str(tmp_path), *given])
    assert told in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
