"""The chart: accuracy over time, the front of what is worth its time, and how near the dial stays to exact."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NAMES = {
    "mask_iou": "held-out mask IoU",
    "held_out_cosine": "held-out view cosine",
    "cosine": "cosine against exact",
}
COLOURS = {"dial": "#1b6ca8", "preset": "#b5651d"}
SIZE = (10.0, 4.6)  # inches
CLOSE = 0.055  # of the axes' height, between two labels


def draw(figure: Figure, document: Mapping[str, Any]) -> None:
    """Two panels: accuracy against seconds for all runs, and the dial's cosine against the exact run."""
    figure.set_size_inches(*SIZE)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    choice = document["choice"]
    _accuracy(left, document["runs"], choice)
    _faithful(right, document["runs"])
    views = document["views"]
    figure.suptitle(
        f"{document['scene']}: {views['lifted']} views lifted, take {choice['name']!r}", fontsize="medium"
    )


def _accuracy(axes: Axes, runs: Sequence[Mapping[str, Any]], choice: Mapping[str, Any]) -> None:
    accuracy = choice["accuracy"]
    shown = [run for run in runs if run[accuracy] is not None]
    front = [run for name in choice["front"] for run in shown if run["name"] == name]
    axes.plot([run["wall_s"] for run in front], [run[accuracy] for run in front], color="#999999", lw=1, zorder=1)
    for kind, marker in (("dial", "o"), ("preset", "s")):
        own = [run for run in shown if run["kind"] == kind]
        places = [run["wall_s"] for run in own], [run[accuracy] for run in own]
        axes.scatter(*places, color=COLOURS[kind], marker=marker, s=34, zorder=2, label=kind)
    taken = next(run for run in shown if run["name"] == choice["name"])
    ring = {"facecolors": "none", "edgecolors": "#222222", "s": 130, "zorder": 3}
    axes.scatter([taken["wall_s"]], [taken[accuracy]], label="taken", **ring)
    axes.set_xscale("log")
    axes.margins(x=0.22, y=0.12)
    _label(axes, shown, accuracy)
    _finish(axes, "seconds of the lift (wall, without reading)", NAMES[accuracy])
    axes.legend(fontsize="small", loc="lower right", frameon=False)


def _faithful(axes: Axes, runs: Sequence[Mapping[str, Any]]) -> None:
    dial = sorted((run for run in runs if run["kind"] == "dial"), key=lambda run: run["wall_ratio"])
    ratios = [run["wall_ratio"] for run in dial]
    for name, label, style in (
        ("cosine", "mean by evidence", "o-"),
        ("cosine_plain", "mean over splats", "^--"),
        ("cosine_q05", "5 % of splats below", "v:"),
    ):
        axes.plot(ratios, [run[name] for run in dial], style, label=label, color=COLOURS["dial"], ms=5, lw=1)
    for run, ratio in zip(dial, ratios, strict=True):
        axes.annotate(
            run["name"], (ratio, run["cosine"]), (0, 7), textcoords="offset points", ha="center", fontsize=8
        )
    axes.margins(x=0.14, y=0.12)
    _finish(axes, "times faster than exact (wall, without reading)", NAMES["cosine"])
    axes.legend(fontsize="small", loc="lower left", frameon=False)


def _label(axes: Axes, runs: Sequence[Mapping[str, Any]], accuracy: str) -> None:
    """Names beside their points, moved apart where they would meet."""
    axes.autoscale_view()
    low, high = axes.get_ylim()
    placed: list[tuple[float, float]] = []
    for run in sorted(runs, key=lambda run: -run[accuracy]):
        x, y = run["wall_s"], run[accuracy]
        while any(abs(y - other) < CLOSE * (high - low) and 0.5 < x / at < 2.0 for at, other in placed):
            y -= 0.2 * CLOSE * (high - low)
        placed.append((x, y))
        place = {"textcoords": "offset points", "va": "center", "fontsize": 8, "color": COLOURS[run["kind"]]}
        axes.annotate(run["name"], (x, y), (9, 0), **place)


def _finish(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x, fontsize="small")
    axes.set_ylabel(y, fontsize="small")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
