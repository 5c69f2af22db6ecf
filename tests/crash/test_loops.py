"""The short forms of the long proofs; ``make soak`` runs them for long."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.soak import POOLED, fault_points, kill_loop, leak_loop, scene_files

IN_SHORT = (
    "after the job is in line, before the 202",
    "after the lift is published, before it has a row",
    "before the trade-off has its row",
)


@pytest.mark.parametrize("point", IN_SHORT)
def test_acknowledged_job_survives_sigkill_of_the_server(point: str) -> None:
    assert fault_points([point]) == {point: "finished once"}


def test_jobs_survive_kills_at_random_points_with_the_same_bits(tmp_path: Path) -> None:
    files = scene_files(tmp_path, views=8, splats=2_000, width=160)
    outcome = kill_loop(files, kills=2, seconds=float("inf"))
    assert (outcome["lost"], outcome["doubled"]) == (0, 0) and outcome["digests_equal"] == outcome["jobs"] > 0


def test_nothing_leaks_over_jobs() -> None:
    outcome = leak_loop(jobs=10)
    assert outcome["growth"]["descriptors"] <= POOLED and outcome["growth"]["threads"] <= 1
    assert outcome["growth"]["resident_kb"] < 8_192
    assert outcome["left_over"] == []
