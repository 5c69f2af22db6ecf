"""Shards of a lift with invalid headers or an invalid index are refused in one line."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from liftcore.errors import InvalidLift
from liftcore.io.shards import INDEX, features_file, write_shards
from liftcore.values.lift_file import read_lift


def write(folder: Path) -> Path:
    columns = {
        "total_weight": torch.ones(4),
        "view_consistency": torch.ones(4),
        "has_feature": torch.ones(4, dtype=torch.bool),
    }
    write_shards(folder, {"features": torch.ones(4, 2), **columns}, "{}")
    return folder


def with_header(path: Path, header: Any) -> None:
    content = path.read_bytes()
    length = int.from_bytes(content[:8], "little")
    path.write_bytes(content[:8] + json.dumps(header).encode().ljust(length) + content[8 + length :])


@pytest.mark.parametrize(
    "header",
    [
        [], 3, "x", {}, {"features-00000": 1}, {"features-00000": []}, {"features-00000": {"dtype": "F32"}},
        {"features-00000": {"dtype": "Q9", "shape": [4, 2]}}, {"features-00000": {"dtype": [], "shape": [4, 2]}},
        {"features-00000": {"dtype": "F32", "shape": 3}}, {"features-00000": {"dtype": "F32", "shape": ["4", 2]}},
        {"features-00000": {"dtype": "F32", "shape": [-4, -2]}},
        {"features-00000": {"dtype": "F32", "shape": [4, 2, 1]}},
    ],
)  # fmt: skip
def test_a_shard_that_does_not_describe_its_rows_is_refused(header: Any, tmp_path: Path) -> None:
    folder = write(tmp_path / "a.shards")
    assert read_lift(folder)[0]["features"].shape == (4, 2)
    with_header(folder / features_file(0), header)
    with pytest.raises(InvalidLift) as error:
        read_lift(folder)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "document", [[], 3, None, {}, {"metadata": 1, "weight_map": 2}, {"metadata": [], "weight_map": [1]}]
)
def test_an_index_of_something_else_is_refused(document: Any, tmp_path: Path) -> None:
    folder = write(tmp_path / "a.shards")
    (folder / INDEX).write_text(json.dumps(document))
    with pytest.raises(InvalidLift):
        read_lift(folder)
