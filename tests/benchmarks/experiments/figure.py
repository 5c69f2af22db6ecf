"""One way to keep what an experiment found: its document as JSON and its plot as PNG, side by side."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.io.whole_file import whole_file

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from matplotlib.figure import Figure

INCHES = (7.0, 4.2)
DOTS_AN_INCH = 150


def save_experiment(
    name: str, document: Mapping[str, Any], draw: Callable[[Figure, Mapping[str, Any]], None], out: Path
) -> tuple[Path, Path]:
    """Write ``out/NAME.json`` and ``out/NAME.png``; gives both paths. No window is opened, no display is needed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    out.mkdir(parents=True, exist_ok=True)
    paths = out / f"{name}.json", out / f"{name}.png"
    with whole_file(paths[0]) as handle:
        handle.write((json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
    figure = Figure(figsize=INCHES, dpi=DOTS_AN_INCH, layout="constrained")
    draw(figure, document)
    with whole_file(paths[1]) as handle:
        FigureCanvasAgg(figure).print_png(handle)
    return paths


def lines(figure: Figure, x: str, y: str) -> Any:
    """Axes for curves: a light grid, no frame on top and at the right."""
    axes = figure.add_subplot()
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    return axes
