"""Four panels: seconds of a lift over splats, pixels, views and channels, both axes logarithmic."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib.ticker import LogLocator

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.figure import Figure

    from tests.benchmarks.peers.side_by_side import Axis, Run

INCHES = (9.0, 6.6)
COLOURS = ("#1b6ca8", "#b5651d", "#4b8b3b", "#8e4585")
MARKERS = ("o", "s", "^", "D")


def draw(figure: Figure, growth: Sequence[tuple[Axis, Mapping[str, Sequence[Run]]]], fixed: str) -> None:
    """A panel an axis; the others' quantities stay at ``fixed``."""
    figure.set_size_inches(*INCHES)
    panels = figure.subplots(2, 2, sharey=True).flat
    for panel, (axis, found) in zip(panels, growth, strict=True):
        for number, (name, runs) in enumerate(found.items()):
            places = [axis.of(run.size) for run in runs], [run.median for run in runs]
            style = {"color": COLOURS[number], "marker": MARKERS[number], "ms": 5, "lw": 1.4}
            panel.plot(*places, label=name, **style)
        panel.set_xscale("log")
        panel.set_yscale("log")
        ticks = [axis.of(size) for size in axis.sizes]
        panel.set_xticks(ticks, [f"{tick:,}" for tick in ticks], fontsize="small")
        panel.minorticks_off()
        panel.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panel.yaxis.set_major_formatter("{x:g}")
        panel.set_xlabel(axis.name, fontsize="small")
        panel.grid(alpha=0.3)
        panel.spines[["top", "right"]].set_visible(False)
    axes = figure.axes
    axes[0].set_ylabel("seconds a lift", fontsize="small")
    axes[2].set_ylabel("seconds a lift", fontsize="small")
    axes[0].legend(fontsize="small", frameon=False)
    figure.suptitle(f"One lift, one thing growing, the rest at {fixed}", fontsize="medium")
