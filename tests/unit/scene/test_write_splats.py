"""Splats written with extra columns."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData

import liftcore as lc
from tests.scenes import random_splats

P = 40
COLUMNS: dict[str, Any] = {
    "object": torch.arange(P, dtype=torch.int32) - 1,
    "class_id": np.arange(P),
    "chosen": np.arange(P) % 2 == 0,
    "score": np.linspace(-1, 1, P, dtype=np.float32),
    "weight": torch.linspace(0, 1, P, dtype=torch.float64)[:, None],
    "half": torch.linspace(0, 1, P).half(),
}


def test_columns_are_properties_that_other_programs_read(tmp_path: Path) -> None:
    splats = random_splats(3)
    lc.write_splats(tmp_path / "s.ply", splats, COLUMNS)
    table = PlyData.read(str(tmp_path / "s.ply"))["vertex"].data
    for name, values in COLUMNS.items():
        np.testing.assert_array_equal(table[name], np.asarray(values).reshape(P))
    assert [table.dtype[name].str for name in ("object", "class_id", "chosen", "score", "weight")] == [
        "<i4", "<i4", "|u1", "<f4", "<f8",
    ]  # fmt: skip
    copy = lc.read_splats(tmp_path / "s.ply")
    assert torch.equal(copy.means, splats.means) and set(copy.extras) >= set(COLUMNS)


def test_columns_of_a_file_that_was_read_stay_and_one_of_the_same_name_is_replaced(tmp_path: Path) -> None:
    lc.write_splats(tmp_path / "s.ply", random_splats(3), {"mask": np.arange(P), "score": np.zeros(P, np.float32)})
    copy = lc.read_splats(str(tmp_path / "s.ply"))
    lc.write_splats(str(tmp_path / "t.ply"), copy[::2], {"score": np.arange(0, P, 2)})
    extras = lc.read_splats(tmp_path / "t.ply").extras
    assert extras["mask"].tolist() == extras["score"].tolist() == list(range(0, P, 2))


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"score": np.ones(3)}, r"columns\['score'\]: expected numbers \[40\], got shape \[3\]"),
        ({"score": np.full(P, 2**40)}, "expected whole numbers of 32 bits"),
        ({"opacity": np.ones(P)}, r"columns\['opacity'\]: expected a name .* that no property of splats has"),
        ({"my score": np.ones(P)}, "a name of letters, digits and underscores"),
    ],
)
def test_what_is_no_column_is_refused_by_its_name(columns: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(lc.InvalidSplats, match=message):
        lc.write_splats(tmp_path / "s.ply", random_splats(3), columns)
    assert not list(tmp_path.iterdir())
