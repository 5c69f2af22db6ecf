"""The bars on the objects of tabletop: as many as stand there, where they stand."""

from __future__ import annotations

from pathlib import Path

from tests.benchmarks.objects import rows_of


def test_the_objects_of_hard_masks_are_the_things_of_the_scene(shared_data: Path) -> None:
    (row,) = rows_of(shared_data / "tabletop", ["features_hard"], ["tikhonov"])
    assert row["one"] == row["things"] == 12
    assert row["box"] > 0.93 and row["worst"] > 0.85  # .943 and .865; .059 around all selected splats
    assert row["middle"] < 0.01
    assert row["apart"] == row["pairs"] == 66
