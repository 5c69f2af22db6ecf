from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tests.commit_subjects import subject_faults, subjects_since

AUTHOR = ("-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")


@pytest.mark.parametrize(
    "subject",
    ["Read version 1.2 of lens.json, by rows", "Take views at 12:30", "x" * 72],
)
def test_a_subject_of_one_clause_in_72_characters_has_no_fault(subject: str) -> None:
    assert subject_faults([subject]) == []


@pytest.mark.parametrize(
    "subject", ["x" * 73, "Read rows; write them", "Read rows.", "fix: read rows", "Read. Write"]
)
def test_long_subjects_and_those_of_several_clauses_are_faults_and_are_printed(subject: str) -> None:
    (fault,) = subject_faults(["Read rows", subject])
    assert subject in fault


def test_commits_after_the_start_are_read_and_missing_history_is_none(tmp_path: Path) -> None:
    def git(*words: str) -> str:
        command = ["git", "-C", str(tmp_path), *AUTHOR, *words]
        return subprocess.run(command, capture_output=True, check=True, text=True).stdout.strip()

    git("init", "-q")
    git("commit", "-q", "--allow-empty", "-m", "An old one; of two clauses.")
    start = git("rev-parse", "HEAD")
    git("commit", "-q", "--allow-empty", "-m", "Read rows\n\nReasons; in sentences.")
    assert subjects_since(start, tmp_path) == ["Read rows"]
    assert subjects_since("0" * 40, tmp_path) is None
    assert subjects_since(start, tmp_path / "none") is None
