from __future__ import annotations

import pytest

from tests.wording import Report, excess, report_on_code

CLEAN = '''
class Answer:
    """One answer to a question."""

    def read(self, path):
        left, top = path.corner
        found_rows = [row for row in path if row > top]
        return left, found_rows
'''


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("found = 1", "found"),
        ("def rows(given): return given", "given"),
        ("def f(*, told=()): return told", "told"),
        ("class Answer:\n    kept: int = 0", "kept"),
        ("def f(self):\n    self._seen = 1", "_seen"),
        ("def made(): ...", "made"),
        ("class Found: ...", "Found"),
        ("f = lambda thing: 1", "thing"),
        ("rows = [1 for one in range(3)]", "one"),
        ("with open(path) as drawn: ...", "drawn"),
        ("import numpy as things", "things"),
        ("match x:\n    case [first, *others]: ...", "others"),
        ("left = 1", "left"),
        ("def f():\n    if (asked := 1): ...", "asked"),
    ],
)
def test_every_way_to_bind_a_listed_name_counts_once(source: str, name: str) -> None:
    assert [place[1] for place in report_on_code(source).places["names"]] == [name]


def test_nouns_and_sides_and_readers_are_not_listed() -> None:
    assert report_on_code(CLEAN).counts() == {}


def test_docstrings_with_a_question_word_and_the_word_told_are_listed_with_their_lines() -> None:
    report = report_on_code('"""Rows."""\n\n\ndef rows():\n    """Which rows are told."""\n')
    assert report.places["docstrings"] == [(5, "Which rows are told")]
    assert [line for line, _ in report.places["told"]] == [5]
    assert (report.docstrings, report.functions, report.functions_with_participle) == (2, 1, 0)


def test_a_share_above_its_bar_fails_with_every_place_and_one_within_it_does_not() -> None:
    functions = "\n".join(f"def read_{number}(): ..." for number in range(200))
    few = {"a.py": report_on_code(f"found = given = 1\n{functions}"), "b.py": Report()}
    assert list(excess(few)) == []
    lines = list(excess(few | {"b.py": report_on_code("seen = 1")}))
    assert lines == ["3 names, at most 2 may stay:", "  a.py:1 found", "  a.py:1 given", "  b.py:1 seen"]
