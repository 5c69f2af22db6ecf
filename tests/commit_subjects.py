"""Hold subjects of commits to one clause and 72 characters: ``python -m tests.commit_subjects``.

Commits since `START` are checked, of 27 November 2026: older subjects broke the rule, and history stays as it was
written. The tag of version 0.4.0 lies before that.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
START = "d2aff89a3d2344304b8028f134694185a4e676c9"
MOST_CHARACTERS = 72
STOP = re.compile(r"[.;:]( |$)|…$")  # a second clause, a prefix such as "fix:", a full stop at the end


def subject_faults(subjects: list[str]) -> list[str]:
    """Return a line for each subject that is too long, or has more than one clause."""
    lengths = [
        f"{len(s)} characters, at most {MOST_CHARACTERS} may be: {s}" for s in subjects if len(s) > MOST_CHARACTERS
    ]
    return lengths + [f"must be one clause without a prefix or a full stop: {s}" for s in subjects if STOP.search(s)]


def subjects_since(start: str, root: Path = ROOT) -> list[str] | None:
    """Return subjects from after a commit to HEAD, merges left out; None where `root` has no history back to it."""
    git = ["git", "-C", str(root)]
    try:
        subprocess.run([*git, "merge-base", "--is-ancestor", start, "HEAD"], capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    log = [*git, "log", "--no-merges", "--format=%s", f"{start}..HEAD"]
    return subprocess.run(log, capture_output=True, check=True, encoding="utf-8").stdout.splitlines()


def main() -> int:
    """Print the subjects that break the rule; 1 where there are any."""
    subjects = subjects_since(START)
    if subjects is None:
        print(f"commit subjects SKIPPED: no git history back to {START[:8]} (a shallow clone, or an archive)")
        return 0
    faults = subject_faults(subjects)
    print("\n".join([*faults, f"{len(subjects)} commit subjects since {START[:8]}: {len(faults)} faults"]))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
