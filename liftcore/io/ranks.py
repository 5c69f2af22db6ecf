"""Checkpoints that gsplat writes on several GPUs, told by their names: one a rank, each with splats of its own."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

_OF_RANK = re.compile(r"(?P<step>.*?(?P<number>[0-9]*))_rank(?P<rank>[0-9]{1,6})(?P<suffix>\.[a-z]+)")


def rank_files(path: Path) -> list[Path]:
    """The checkpoints of all ranks of a training step, by their rank; none where nothing is named so.

    Args:
        path: one of them; or a folder of them, of which the last step counts.
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
    own = _OF_RANK.fullmatch(path.name) if not path.is_dir() else None
    step = (own["step"], own["suffix"]) if own else max(numbers, key=lambda key: numbers[key], default=("", ""))
    ranks = steps.get(step, {}) if own or path.is_dir() else {}
    return [ranks[rank] for rank in sorted(ranks)]


def missing_ranks(files: Sequence[Path]) -> list[int]:
    """The ranks below the last of these files that have none."""
    ranks = {int(match["rank"]) for file in files if (match := _OF_RANK.fullmatch(file.name))}
    return sorted(set(range(max(ranks, default=-1) + 1)) - ranks)
