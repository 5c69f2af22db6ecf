"""The documents as tests read them."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCUMENTS = ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md")
GUIDE, SETTINGS, PYTHON, SERVICE, RESULTS = (
    f"docs/{page}.md" for page in ("guide", "settings", "python", "service", "results")
)
FOR_USERS = ("README.md", GUIDE, SETTINGS, PYTHON, SERVICE, RESULTS)
PAGES = (*DOCUMENTS, *sorted(str(page.relative_to(ROOT)) for page in ROOT.glob("docs/*.md")))


def text(name: str) -> str:
    """A document, by its path in the repository."""
    return (ROOT / name).read_text(encoding="utf-8")


def blocks(name: str, language: str) -> list[str]:
    """Return the fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text(name), flags=re.MULTILINE | re.DOTALL)


def inline_code(name: str) -> list[str]:
    """Return the inline code outside of fenced blocks, each on one line."""
    prose = re.sub(r"^```.*?^```", "", text(name), flags=re.MULTILINE | re.DOTALL)
    return [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose)]


def shell_commands(name: str) -> list[str]:
    """Return the arguments of ``splatlift`` in lines of shell blocks, whatever precedes the command."""
    lines = "\n".join(blocks(name, "sh")).splitlines()
    # Not the first of `run splatlift splatlift keys`, which names a service of the compose file.
    matches = [re.search(r"(?:^|[ (])(?:\.venv/bin/)?splatlift (?!splatlift )([^#()]+)", line) for line in lines]
    return [match[1].strip() for match in matches if match]
