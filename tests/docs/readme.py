"""The documents as tests read them."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCUMENTS = ("README.md", "ARCHITECTURE.md")


def text(name: str) -> str:
    """A document of the repository's root."""
    return (ROOT / name).read_text(encoding="utf-8")


def blocks(name: str, language: str) -> list[str]:
    """The fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text(name), flags=re.MULTILINE | re.DOTALL)


def table_heads(name: str) -> list[str]:
    """The first cell of every table row."""
    return re.findall(r"^\| (.*?) \|", text(name), flags=re.MULTILINE)
