"""The published rows are the papers' own."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from liftcore.evaluate.published import Published, published

SPELLING = {
    "LeRF": "LERF",
    "LeGaussian": "LEGaussians",
    "SuperGseg": "SuperGSeg",
    "GS Grouping": "Gaussian Grouping",
    "LAGA": "LaGa",
    "DrSplat": "Dr. Splat",
    "OccamLGS": "Occam's LGS",
    "Ours": "Splat Feature Solver",
}
MARKS = {"dagger": "own paper", "ddagger": "official code", "": ""}


@pytest.fixture(scope="module")
def paper(shared_data: Path) -> str:
    path = shared_data.parent / "paper" / "splat_feature_solver.tex"
    if not path.is_file():
        pytest.skip("the paper is not here")
    return path.read_text(encoding="utf-8")


def table(paper: str, first: str) -> list[tuple[str, list[str]]]:
    """The first cell and the others of a table's rows, from the row that begins so."""
    body = paper[paper.index(first) :]
    rows = body[: body.index("\\bottomrule")].split("\\\\")
    cells = [
        [re.sub(r"\\cellcolor\{\d\}|\\textbf\{([^}]*)\}", r"\1", cell).strip() for cell in row.split("&")]
        for row in rows
    ]
    return [(row[0].replace("\\midrule", "").strip(), row[1:]) for row in cells if len(row) > 5]


def test_lerf_ovs_rows_are_those_of_the_table(paper: str) -> None:
    ours = iter(row for row in published("lerf-ovs") if row.scenes)
    for head, cells in table(paper, "$\\text{LSeg}"):
        found = re.match(r"\$\\text\{([^}]*)\}\^\\(\w+)", head)
        name, mark = found.groups() if found else (head, "")
        row = next(ours)
        assert row.method == SPELLING.get(name, name) and MARKS[mark] in row.note
        # The table's columns are Figurines, Teatime, Ramen, Waldo kitchen.
        assert [*row.scenes.values(), row.mean] == [float(cell) for cell in cells]
    [vala] = ours  # the one row of another paper that gives its scenes
    assert vala.method == "VALA" and sum(vala.scenes.values()) / 4 == pytest.approx(vala.mean, abs=0.01)


def test_3d_ovs_rows_are_those_of_the_table(paper: str) -> None:
    rows = published("3d-ovs")
    for k, (name, cells) in enumerate(table(paper, "LAGA   & 84.9")):
        for room, row in enumerate(rows[2 * k : 2 * k + 2]):
            assert row.method == SPELLING[name]
            values = [cell.split("/")[room if "/" in cell else 0] for cell in cells]
            assert [*row.scenes.values(), row.mean] == [float(value) for value in values]
    assert len(rows) == 4


def off(row: Published) -> float:
    return abs(sum(row.scenes.values()) / len(row.scenes) - row.mean)


def test_printed_means_are_the_means_of_their_scenes_but_where_the_paper_slips() -> None:
    rows = [row for dataset in ("lerf-ovs", "3d-ovs") for row in published(dataset) if row.scenes]
    assert {row.method for row in rows if off(row) > 0.11} == {"N2F2"}
