"""Output of ``splatlift bench``."""

import json

import pytest

from liftcore import cli

pytestmark = pytest.mark.slow

SMALL = ["bench", "--splats", "2000", "--size", "64x48", "--views", "2", "--channels", "8"]


def test_every_preset_has_its_seconds_a_view(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*SMALL, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["splats"], document["views"], document["channels"]) == (2000, 2, 8)
    assert cli.main(SMALL) == 0
    lines = capsys.readouterr().out
    for preset, figures in document["presets"].items():
        assert figures["geometry_s_per_view"] > 0 and figures["weights_entries_per_view"] > 0
        assert figures["stages_of_geometry"]["geometry"] == 1 and figures["stages_of_geometry"]["all"] > 1
        assert preset in lines
    assert min(document["machine_speed"].values()) > 1e6


@pytest.mark.parametrize("options", [["--size", "9"], ["--scene", "nowhere"], ["--preset", "magic"]], ids=str)
def test_options_that_make_no_bench_are_refused(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*SMALL, *options]) == 2
    assert capsys.readouterr().err.count("\n") == 1
