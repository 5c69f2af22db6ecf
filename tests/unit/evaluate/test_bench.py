"""``splatlift bench``: what it prints, beside the project's aims and stage by stage."""

import json

import pytest

from liftcore import cli

SMALL = ["bench", "--splats", "2000", "--size", "64x48", "--views", "2"]


def bench(capsys: pytest.CaptureFixture[str], *more: str) -> tuple[dict, str]:
    """The JSON of a bench, and its lines for people."""
    assert cli.main([*SMALL, *more, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert cli.main([*SMALL, *more]) == 0
    return document, capsys.readouterr().out


def test_every_preset_has_its_seconds_a_view(capsys: pytest.CaptureFixture[str]) -> None:
    document, lines = bench(capsys, "--channels", "8")
    assert (document["splats"], document["views"], document["channels"]) == (2000, 2, 8)
    for preset, found in document["presets"].items():
        assert found["geometry_s_per_view"] > 0 and found["weights_entries_per_view"] > 0
        assert preset in lines


def test_aims_are_printed_beside_what_was_found(capsys: pytest.CaptureFixture[str]) -> None:
    document, lines = bench(capsys, "--aims")
    seconds, ratio, memory = document["presets"]["row-sum"]["aims"]
    assert seconds["aim"] is None and "met" not in seconds  # the aim is of a million splats
    assert ratio["met"] is (ratio["found"] <= ratio["aim"])
    assert memory["met"] is (memory["found"] <= memory["aim"])
    assert all(aim["name"] in lines for aim in (seconds, ratio, memory))


def test_stages_are_timed_apart(capsys: pytest.CaptureFixture[str]) -> None:
    document, lines = bench(capsys, "--stages", "--channels", "8")
    for preset in document["presets"].values():
        assert {"projection", "walk", "solution"} <= preset["stages"].keys()
        assert all(figures["wall_s"] > 0 for figures in preset["stages"].values())
        assert all(f"  {name} " in lines for name in preset["stages"])


@pytest.mark.parametrize(
    "more", [["--aims", "--channels", "8"], ["--aims", "--stages"], ["--size", "9"], ["--scene", "nowhere"]], ids=str
)
def test_options_that_make_no_bench_are_refused(more: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*SMALL, *more]) == 2
    assert capsys.readouterr().err.count("\n") == 1
