"""Folders in views' names, told to people: a folder too many is what keeps a view from its camera."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

_SHOWN = 8


def folders_of(views: Iterable[str]) -> list[str]:
    """The folders that are part of names like ``camA/000``, sorted."""
    return sorted({view.rpartition("/")[0] for view in views if "/" in view})


def told_folders(folders: Sequence[str]) -> list[str]:
    """A line about them, if there are any."""
    shown = ", ".join(folders[:_SHOWN]) + (" ..." if len(folders) > _SHOWN else "")
    return [f"  of sub-folders, whose names are part of their views': {shown}"] if folders else []
