"""A comparison of settings and its report: ``tradeoff.png``, ``.md`` and ``.json`` in a folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from liftcore.errors import InvalidInput, InvalidSettings, Unavailable
from liftcore.evaluate.hardware import machine_line
from liftcore.evaluate.ranking import NAMES
from liftcore.evaluate.tradeoff import SceneFiles, compare
from liftcore.io.files import whole_file
from liftcore.io.json_file import finite
from liftcore.runtime.progress import Progress, shown_progress
from liftcore.scene.kernel import Kernel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEADS = ("run", "views", "wall s", "CPU s", "faster by CPU", "peak MiB", "cosine", "5 %", "lost", "centred",
         "mask IoU", "phrase IoU", "95 %")  # fmt: skip
KEY = (
    "*exact* is your settings as they are (`default` where they name no preset), which the levels of quality "
    "and *aggregation* keep. Seconds are of the lift without reading its files. *cosine* is against the exact run, "
    "over the splats that it saw: the mean by total weight, and what 5 % of the splats stay below; *lost* is the "
    "share of them without a feature. *centred* is the cosine of what is rendered into views that no run lifted "
    "with what these observe, "
    "both less the mean of what is observed, a region at a time. *95 %* is the interval of what runs are judged by, "
    "over draws of its views."
)
TITLE = "Speed against accuracy"
LOST_SHARE = 0.001  # of the splats, above which the verdict mentions them


@dataclass(frozen=True)
class SpeedComparison:
    """Runs of a scene at several levels of quality and presets, and the recommended one."""

    document: dict[str, Any]
    """plain numbers, ready for JSON"""

    def lines(self) -> list[str]:
        """Return the table, the verdict and the conditions as lines of Markdown."""
        views, not_run = self.document["views"], ", ".join(self.document["over_budget"])
        over_budget = f" Not run for want of time: {not_run}." if not_run else ""
        subset = "" if views["lifted"] == views["of"] else f" (every n-th of {views['of']}, to fit the budget)"
        command, date, seconds = (self.document[name] for name in ("command", "date", "seconds"))
        return [
            *table_of(self.document),
            "",
            KEY,
            "",
            verdict_of(self.document),
            "",
            f"`{command}`, {date}, {seconds:.0f} s; {views['lifted']} views lifted{subset}, {views['held_out']} with "
            f"features and {self.document['labelled_views']} with masks held out.{over_budget} "
            f"{machine_line(self.document['hardware'])}",
        ]

    def save(self, folder: Path) -> list[Path]:
        """Write ``tradeoff.json``, ``.png`` (a chart) and ``.md`` in a folder; return their paths."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        folder.mkdir(parents=True, exist_ok=True)
        data, chart, table = (folder / f"tradeoff.{ending}" for ending in ("json", "png", "md"))
        with whole_file(data) as handle:
            handle.write((json.dumps(self.document, indent=1, allow_nan=False) + "\n").encode())
        figure = Figure(dpi=150, layout="constrained")  # no window is opened, no display is needed
        draw(figure, self.document)
        with whole_file(chart) as handle:
            FigureCanvasAgg(figure).print_png(handle)
        with whole_file(table) as handle:
            handle.write(("\n".join(self.lines()) + "\n").encode())
        return [data, chart, table]


def compare_speeds(
    files: SceneFiles,
    *,
    budget: float = 600.0,
    settings: Mapping[str, Any] = MappingProxyType({}),
    kernel: Kernel | None = None,
    threads: int | None = None,
    progress: Progress | bool | None = None,
    scene: str = "",
    command: str = "",
) -> SpeedComparison:
    """Lift a scene at several levels of quality and by several presets, as many as fit a budget of time, and choose.

    Each run is a process of its own.

    Args:
        files: of the scene, and labels for the evaluation; without labels held-out views are used.
        budget: seconds. The exact run is always made, from few views if necessary.
        settings: of all runs, beside ``quality``, which is compared.
        kernel: of the splats, to compile all kernels before the budget begins.
        threads, progress: as in `liftcore.lift`.
        scene, command: that the report names.

    Raises:
        InvalidSettings: ``quality`` among the settings.
        InvalidInput: the scene lacks an input, or a lift rejects one.
        Unavailable: matplotlib is not installed, which draws the chart; a run did not end within a day.
    """
    if not isinstance(files, SceneFiles):
        raise InvalidInput("files", expected="SceneFiles", got=repr(files)[:80])
    run_settings = dict(settings) if isinstance(settings, Mapping) else None
    if run_settings is None or "quality" in run_settings:
        got = repr(settings)[:80] if run_settings is None else "quality"
        raise InvalidSettings("settings", expected="settings that are the same in all runs", got=got)
    _check_chart()
    with shown_progress(progress) as reporter:
        facts = compare(files, budget, run_settings, threads, reporter, kernel)
    document = finite({"title": TITLE, "scene": scene, "command": command} | facts)
    return SpeedComparison(document)


def _check_chart() -> None:
    try:
        import_module("matplotlib")
    except ImportError as error:
        hint = "pip install 'splatlift[evaluate]'"
        expected = "the package matplotlib"
        raise Unavailable("chart of a trade-off", expected=expected, got=str(error), hint=hint) from None


def verdict_of(document: Mapping[str, Any]) -> str:
    """Return the recommendation, or that there is none, and the runs that leave splats without a feature."""
    choice, exact = document["choice"], document["runs"][0]["name"]
    verdict = f"**Take {choice['name']}**: {choice['why']}" if choice["recommended"] else choice["why"]
    lost_lines = [
        f"{run['name']} leaves {run['lost_share']:.1%} of the splats without the feature that {exact} gives them"
        for run in document["runs"]
        if run["kind"] == "dial" and run["lost_share"] > LOST_SHARE  # of presets the table tells it
    ]
    return ". ".join([verdict, *lost_lines]) + "."


def table_of(document: Mapping[str, Any]) -> list[str]:
    """Format the runs as a Markdown table, the fastest first; those of the front in bold."""
    rows = sorted(document["runs"], key=lambda run: run["cpu_s"])
    lines = [" | ".join(HEADS), "|".join("---" for _ in HEADS)]
    lines += [" | ".join(_cells(run, document["choice"])) for run in rows]
    return [f"|{line}|" if line.startswith("---") else f"| {line} |" for line in lines]


def _cells(run: Mapping[str, Any], choice: Mapping[str, Any]) -> list[str]:
    return [
        f"**{run['name']}**" if run["name"] in choice["front"] else run["name"],
        str(run["views"]),
        f"{run['wall_s']:.2f}",
        f"{run['cpu_s']:.2f}",
        f"{run['cpu_ratio']:.1f}",
        f"{run['peak_memory_bytes'] / 2**20:.0f}" if run["peak_memory_bytes"] else "-",
        *(_number(run[key]) for key in ("cosine", "cosine_q05")),
        f"{run['lost_share']:.1%}",
        *(_number(run[key]) for key in ("centred_cosine", "mask_iou", "phrase_iou")),
        " to ".join(map(_number, choice["intervals"].get(run["name"], [None]))),
    ]


def _number(figure: float | None) -> str:
    return "-" if figure is None else f"{figure:.4f}"


COLOURS = {"dial": "#1b6ca8", "preset": "#b5651d"}
SIZE = (7.0, 4.6)  # inches
LABEL_OFFSETS = (7, -10)  # points above a run's place, in turns: names of neighbours do not meet


def draw(figure: Figure, document: Mapping[str, Any]) -> None:
    """Draw the accuracy of all runs against their seconds."""
    figure.set_size_inches(*SIZE)
    axes, runs, choice = figure.subplots(), document["runs"], document["choice"]
    accuracy = choice["accuracy"]
    plotted = sorted((run for run in runs if run[accuracy] is not None), key=lambda run: run["cpu_s"])
    front = [run for run in plotted if run["name"] in choice["front"]]
    axes.plot([run["cpu_s"] for run in front], [run[accuracy] for run in front], color="#999999", lw=1, zorder=1)
    for kind, marker, label in (("dial", "o", "quality level"), ("preset", "s", "preset")):
        of_kind = [run for run in plotted if run["kind"] == kind]
        places = [run["cpu_s"] for run in of_kind], [run[accuracy] for run in of_kind]
        axes.scatter(*places, color=COLOURS[kind], marker=marker, s=34, zorder=2, label=label)
    recommended = [run for run in plotted if choice["recommended"] and run["name"] == choice["name"]]
    ring = {"facecolors": "none", "edgecolors": "#222222", "s": 130, "zorder": 3}
    axes.scatter([run["cpu_s"] for run in recommended], [run[accuracy] for run in recommended], label="taken", **ring)
    for number, run in enumerate(plotted):
        offset = {"xytext": (5, LABEL_OFFSETS[number % 2]), "textcoords": "offset points", "fontsize": 8}
        axes.annotate(run["name"], (run["cpu_s"], run[accuracy]), color=COLOURS[run["kind"]], **offset)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(_few_ticks)
    axes.margins(x=0.22, y=0.12)
    axes.set_xlabel("processor seconds of the lift, without reading", fontsize="small")
    axes.set_ylabel(NAMES[accuracy], fontsize="small")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize="small", loc="lower right", frameon=False)
    verdict = f"take {choice['name']!r}" if choice["recommended"] else "nothing can be recommended"
    title = f"{document['scene']}: {document['views']['lifted']} views lifted, {verdict}"
    figure.suptitle(title, fontsize="medium")


def _few_ticks(value: float, _: float) -> str:
    """Format twos and fives between the powers of ten."""
    return f"{value:g}" if f"{value:e}"[0] in "25" else ""
