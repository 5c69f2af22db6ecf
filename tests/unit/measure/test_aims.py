"""The bench prints the project's aims beside what it found, whether they are met or not."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
import torch

from liftcore import cli
from liftcore.evaluate import aims
from liftcore.evaluate.aims import CHANNELS, FEW, MANY, USUAL, Figure, inputs_bytes
from liftcore.evaluate.bench import Workload
from liftcore.evaluate.synthetic import room_cameras, room_splats
from liftcore.features.views import Regions

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

SMALL = ["bench", "--aims", "--splats", "2000", "--size", "64x48", "--views", "2"]


def test_a_figure_meets_its_aim_up_to_it_and_says_so_only_where_there_is_one() -> None:
    found = [Figure("ratio", found, 1.1).facts["met"] for found in (1.0, 1.1, 1.11)]
    assert found == [True, True, False]
    assert "met" not in Figure("seconds", 1.0, None).facts


def test_bench_prints_every_aim_and_the_figures_behind_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*SMALL, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    found = document["presets"]["row-sum"]
    seconds, ratio, memory = found["aims"]
    walked, solved = found["geometry_s_per_view"], found["solve_s_per_view"]
    assert document["channels"] == list(CHANNELS)
    assert seconds["found"] == pytest.approx(walked + solved[str(USUAL)])
    assert seconds["aim"] is None  # the aim is of a million splats
    assert ratio["found"] == pytest.approx((walked + solved[str(MANY)]) / (walked + solved[str(FEW)]))
    held = found["peak_bytes"] - found["inputs_bytes"] - found["features_bytes"]
    assert memory["found"] == pytest.approx(held / 2**20)
    assert found["features_bytes"] == 2000 * USUAL * 2
    assert cli.main(SMALL) == 0
    lines = capsys.readouterr().out
    assert all(aim["name"] in lines for aim in found["aims"])


def test_the_solution_is_timed_for_each_number_of_channels_on_one_walk(monkeypatch: pytest.MonkeyPatch) -> None:
    walks, solved = [], []
    walk, solve = aims.walk_regions, aims.closed_form

    def counted(*given: Any) -> Any:
        walks.append(given)
        return walk(*given)

    def noted(store: Any, columns: Sequence[Any], *rest: Any) -> Any:
        solved.append(columns[0].codebook.shape[1])
        lengths = torch.linalg.vector_norm(columns[0].codebook.float(), dim=1)
        assert torch.allclose(lengths, torch.ones_like(lengths), atol=2e-3)  # else they would be summed twice
        return solve(store, columns, *rest)

    monkeypatch.setattr(aims, "walk_regions", counted)
    monkeypatch.setattr(aims, "closed_form", noted)
    assert cli.main([*SMALL, "--json"]) == 0
    assert len(walks) == aims.PASSES
    assert solved == list(CHANNELS) * aims.PASSES


def test_inputs_are_splats_without_colour_label_maps_and_codebooks() -> None:
    (camera,) = room_cameras(1, 8, 6)
    observed = Regions(torch.zeros(2, 6, 8, dtype=torch.int32), torch.zeros(3, 1))
    work = Workload("room", room_splats(500), [(camera, observed)])
    assert inputs_bytes(work, 10) == 500 * 4 * (3 + 4 + 3 + 1) + 2 * 6 * 8 * 4 + 2 * 3 * 10


def test_aims_have_channels_of_their_own(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*SMALL, "--channels", "8"]) == 2
    assert "channels" in capsys.readouterr().err
    assert cli.main([*SMALL, "--stages"]) == 2
