"""``docs/benchmarks.md``: peers side by side, how they grow, what they need, and who could not come."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from liftcore.evaluate.hardware import hardware, machine_line
from tests.benchmarks.peers.agreement import SAME, SEEN
from tests.benchmarks.peers.tried import DAY, RAN, STOPPED
from tests.benchmarks.peers.work import LEVELS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from tests.benchmarks.peers.peer import Peer
    from tests.benchmarks.peers.side_by_side import Axis, Limits, Run
    from tests.benchmarks.peers.work import Size

CHART = "images/peers.png"  # beside the page


@dataclass(frozen=True)
class Findings:
    """All that the page tells."""

    peers: Sequence[Peer]  # that took part, ours first
    absent: Mapping[str, str]  # name -> why
    limits: Limits
    base: Size  # around which growth is measured
    tables: Mapping[str, Mapping[str, Run]]  # title -> name -> run
    growth: Sequence[tuple[Axis, Mapping[str, Sequence[Run]]]]
    cuts: Sequence[str]
    alone: Mapping[str, Mapping[str, float]]  # name -> figures of a process of its own
    cold: Mapping[str, Mapping[str, float]]  # the same with an empty cache of kernels
    load: tuple[float, float]  # the machine's, over a minute, before and after
    seconds: float  # of the whole comparison


def page(found: Findings) -> str:
    """The page as Markdown."""
    return "\n".join([*_head(found), *_side_by_side(found), *_growth(found), *_needs(found), *_tried()]) + "\n"


def in_words(size: Size) -> str:
    """A size for people."""
    return (
        f"{size.splats:,} splats, {size.width} x {size.height}, {size.views} view{'s' * (size.views > 1)}, "
        f"{size.channels} channels"
    )


def _head(found: Findings) -> Iterator[str]:
    machine = machine_line(hardware())
    yield "# Peers on the same work"
    yield ""
    yield (
        "Other ways to lift the same features onto the same splats, on the CPU, in one run with ours. Made whole by "
        f"`python -m tests.benchmarks.peers docs/benchmarks.md`: {datetime.now(UTC):%Y-%m-%d}, {found.seconds:.0f} "
        f"s; {machine}; load {found.load[0]:.1f} before and {found.load[1]:.1f} after (with more work on the machine "
        "than its cores, seconds are too large and ratios uncertain)."
    )
    yield ""
    yield (
        f"The work is a synthetic room with label maps of {LEVELS} levels over random unit codebooks (float16), and "
        "`X = (A^T B) / (A^T n)` in float32: the weights of `row-sum`. Each peer starts from splats, cameras, label "
        "maps and codebooks and ends with X. The others make an image of all channels a view first, levels added up "
        "(a quarter of the work of a pass a level), which is part of their time. All may use every core."
    )
    yield ""
    yield "| peer | how |"
    yield "|---|---|"
    for peer in found.peers:
        yield f"| {peer.name} | {peer.computes} |"
    yield ""
    yield (
        "`dense numba` starts with our projection, depth order, tile lists and pixel bounds, so it shows what the "
        "accumulation alone costs, with a geometry that peers would have to write first; each thread has sums of its "
        "own, as a CPU has no cheap atomic additions. `torch autograd` makes its weights once for all channels."
    )
    for name, why in found.absent.items():
        yield ""
        yield f"**{name}** did not take part: {why}."
    yield ""


def _side_by_side(found: Findings) -> Iterator[str]:
    yield "## Side by side"
    yield ""
    yield (
        f"Medians of up to {found.limits.rounds} lifts, in turns; a peer takes part in another round if that keeps "
        f"it within {found.limits.peer_s:g} s. *Processor*: seconds of all cores together, the least. *Cosine*: of a "
        f"splat's feature with ours, the mean by evidence; below {SAME} a peer would compute another thing. *Error*: "
        f"the largest difference of a channel, over splats with evidence of {SEEN:g} or more."
    )
    for title, runs in found.tables.items():
        yield ""
        if not runs:
            yield f"**{title}**: not measured, see the cut-offs below."
            continue
        yield f"**{title}**: {in_words(next(iter(runs.values())).size)}"
        yield ""
        yield "| peer | seconds | fastest | processor | lifts | times ours | cosine | error |"
        yield "|---|---|---|---|---|---|---|---|"
        ours = next(iter(runs.values()))
        for name, run in runs.items():
            same = "" if run.agreement.same else " (another X)"
            yield (
                f"| {name} | {_s(run.median)} | {_s(min(run.seconds))} | {_s(run.processor)} | {len(run.seconds)} | "
                f"{run.median / ours.median:.1f} | {run.agreement.cosine:.6f}{same} | {run.agreement.error:.1e} |"
            )
    yield ""


def _growth(found: Findings) -> Iterator[str]:
    yield "## Growth"
    yield ""
    yield f"![Seconds of a lift over splats, pixels, views and channels]({CHART})"
    yield ""
    yield (
        f"One thing grows, the rest stays at {in_words(found.base)}. Medians of seconds; the last row is the "
        "exponent k of `seconds ~ n^k`, a straight line through what was measured. `-` is not measured: no figure "
        "here is extrapolated."
    )
    for axis, runs in found.growth:
        names = list(runs)
        yield ""
        yield f"| {axis.name} | " + " | ".join(names) + " |"
        yield "|---" * (len(names) + 1) + "|"
        for size in axis.sizes:
            cells = [next((_s(run.median) for run in runs[name] if run.size == size), "-") for name in names]
            yield f"| {axis.of(size):,} | " + " | ".join(cells) + " |"
        yield "| k | " + " | ".join(_exponent(axis, runs[name]) for name in names) + " |"
    lowest = {
        name: min((run.agreement.cosine for _, runs in found.growth for run in runs.get(name, ())), default=math.nan)
        for name in (peer.name for peer in found.peers)
    }
    told = ", ".join(f"{name} {value:.6f}" for name, value in lowest.items() if not math.isnan(value))
    yield ""
    yield f"The lowest cosine with ours in all of these runs: {told}."
    yield ""
    yield "Cut off:" if found.cuts else "Nobody was cut off."
    for cut in found.cuts:
        yield f"- {cut}"
    yield ""


def _needs(found: Findings) -> Iterator[str]:
    yield "## Memory, and what is paid once"
    yield ""
    yield (
        f"Each in a process of its own, at {in_words(found.base)}, or at the small size if it was cut off there. "
        "*Before* is the process with its libraries and inputs, *peak* its largest size during the lift. *Loading* "
        "is what the first lift of a tiny scene takes more than the second, kernels in the cache; *compiling* the "
        "same with an empty cache: once a machine, and left out of all times above."
    )
    yield ""
    yield "| peer | before, MiB | peak, MiB | the lift adds, MiB | loading, s | compiling, s |"
    yield "|---|---|---|---|---|---|"
    for name, figures in found.alone.items():
        before, peak = figures["before_bytes"] / 2**20, figures["peak_bytes"] / 2**20
        cold = f"{_once(found.cold[name]):.1f}" if name in found.cold else "nothing to compile"
        yield f"| {name} | {before:.0f} | {peak:.0f} | {peak - before:.0f} | {_once(figures):.1f} | {cold} |"
    yield ""
    yield "The compiled code of `dense numba` contains our projection and tile lists."
    yield ""


def _tried() -> Iterator[str]:
    yield "## Public rasterizers"
    yield ""
    yield f"Looked for on {DAY}. {RAN} What stopped the others:"
    yield ""
    yield "| package | what stopped it |"
    yield "|---|---|"
    for name, why in STOPPED.items():
        yield f"| {name} | {why} |"


def load_now() -> float:
    """Runnable processes, the mean of the last minute."""
    return os.getloadavg()[0]


def _once(figures: Mapping[str, float]) -> float:
    return max(0.0, figures["first_s"] - figures["again_s"])


def _s(seconds: float) -> str:
    return f"{seconds:.3f}" if seconds < 1 else f"{seconds:.2f}"


def _exponent(axis: Axis, runs: Sequence[Run]) -> str:
    """The slope of a least-squares line through the points of a log-log plot."""
    if len(runs) < 3:
        return "-"
    x = [math.log(axis.of(run.size)) for run in runs]
    y = [math.log(run.median) for run in runs]
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    slope = sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)) / sum((a - mean_x) ** 2 for a in x)
    return f"{slope:.2f}"
