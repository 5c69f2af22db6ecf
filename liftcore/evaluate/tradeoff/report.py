"""What a comparison leaves behind: ``tradeoff.png``, ``tradeoff.md`` and ``tradeoff.json`` in a folder."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from liftcore.evaluate.hardware import machine_line
from liftcore.evaluate.tradeoff.chart import draw
from liftcore.io.files import whole_file

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

HEADS = ("run", "views", "wall s", "CPU s", "faster", "faster by CPU", "peak MiB",
         "cosine", "plain", "5 %", "held-out cosine", "mask IoU")  # fmt: skip
KEY = (
    "Seconds are of the lift without reading its files. *cosine* is against the exact run, over the splats that it "
    "saw: the mean by evidence, the plain mean, and the value that 5 % of the splats stay below."
)


def save(document: Mapping[str, Any], out: Path) -> list[Path]:
    """Write the three files; their paths."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    out.mkdir(parents=True, exist_ok=True)
    data, chart, table = (out / f"tradeoff.{ending}" for ending in ("json", "png", "md"))
    with whole_file(data) as handle:
        handle.write((json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
    figure = Figure(dpi=150, layout="constrained")  # no window is opened, no display is needed
    draw(figure, document)
    with whole_file(chart) as handle:
        FigureCanvasAgg(figure).print_png(handle)
    with whole_file(table) as handle:
        handle.write(("\n".join(page_of(document)) + "\n").encode())
    return [data, chart, table]


def page_of(document: Mapping[str, Any]) -> list[str]:
    """The table with what it says and how it was made, as Markdown."""
    views, machine = document["views"], document["hardware"]
    skipped = f" Not run for want of time: {', '.join(document['skipped'])}." if document["skipped"] else ""
    subset = "" if views["lifted"] == views["of"] else f" (every n-th of {views['of']}, to fit the budget)"
    return [
        *table_of(document),
        "",
        KEY,
        "",
        f"**Take {document['choice']['name']}**: {document['choice']['why']}.",
        "",
        f"`{document['command']}`, {document['date']}, {document['seconds']:.0f} s; {views['lifted']} views lifted"
        f"{subset}, {views['held_out']} with features and {document['labelled_views']} with masks held out.{skipped} "
        + machine_line(machine),
    ]


def table_of(document: Mapping[str, Any]) -> list[str]:
    """The runs as a Markdown table, the fastest first; those of the front in bold."""
    rows = sorted(document["runs"], key=lambda run: run["cpu_s"])
    lines = [" | ".join(HEADS), "|".join("---" for _ in HEADS)]
    lines += [" | ".join(_cells(run, run["name"] in document["choice"]["front"])) for run in rows]
    return [f"|{line}|" if line.startswith("---") else f"| {line} |" for line in lines]


def _cells(run: Mapping[str, Any], on_front: bool) -> list[str]:
    figures = [run[key] for key in ("cosine", "cosine_plain", "cosine_q05", "held_out_cosine", "mask_iou")]
    return [
        f"**{run['name']}**" if on_front else run["name"],
        str(run["views"]),
        f"{run['wall_s']:.2f}",
        f"{run['cpu_s']:.2f}",
        f"{run['wall_ratio']:.1f}",
        f"{run['cpu_ratio']:.1f}",
        f"{run['peak_memory_bytes'] / 2**20:.0f}",
        *("-" if figure is None else f"{figure:.4f}" for figure in figures),
    ]
