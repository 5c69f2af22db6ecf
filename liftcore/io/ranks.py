"""Checkpoints that gsplat writes on several GPUs, recognised by name: one of each rank, each with other splats."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

_OF_RANK = re.compile(r"(?P<step>.*?(?P<number>[0-9]*))_rank(?P<rank>[0-9]{1,6})(?P<suffix>\.[a-z]+)")


def rank_files(path: Path) -> list[Path]:
    """Return the checkpoints of all ranks of a training step, in the order of ranks; none without such names.

    Args:
        path: one of them, or a folder of them, of which the last step is used.
    """
    folder = path if path.is_dir() else path.parent
    steps: dict[tuple[str, str], dict[int, Path]] = {}
    numbers: dict[tuple[str, str], int] = {}
    for file in sorted(folder.iterdir()) if folder.is_dir() else ():
        match = _OF_RANK.fullmatch(file.name)
        if match and file.is_file():
            step = match["step"], match["suffix"]
            steps.setdefault(step, {})[int(match["rank"])] = file
            numbers[step] = int(match["number"] or 0)
    path_match = _OF_RANK.fullmatch(path.name) if not path.is_dir() else None
    step = (
        (path_match["step"], path_match["suffix"])
        if path_match
        else max(numbers, key=lambda key: numbers[key], default=("", ""))
    )
    ranks = steps.get(step, {}) if path_match or path.is_dir() else {}
    return [ranks[rank] for rank in sorted(ranks)]


def missing_ranks(files: Sequence[Path]) -> list[int]:
    """Return the ranks below the last one that have no file."""
    ranks = {int(match["rank"]) for file in files if (match := _OF_RANK.fullmatch(file.name))}
    return sorted(set(range(max(ranks, default=-1) + 1)) - ranks)
