"""``python -m tests.benchmarks.peers docs/benchmarks.md``: lift beside our peers and write the page and its chart."""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from liftcore.io.whole_file import whole_file
from tests.benchmarks.peers.chart import draw
from tests.benchmarks.peers.child import alone
from tests.benchmarks.peers.everybody import PEERS, SIZES, TINY
from tests.benchmarks.peers.page import CHART, Findings, in_words, load_now, page
from tests.benchmarks.peers.side_by_side import Comparison, Limits
from tests.benchmarks.peers.work import room

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tests.benchmarks.peers.peer import Peer
    from tests.benchmarks.peers.side_by_side import Sizes

LARGE_LIFT_S = 60.0  # that a peer's first lift of the large work may take, by its rays alone
COMPILED = ("splatlift", "dense numba")  # the peers with kernels of their own


def compare(peers: Sequence[Peer], sizes: Sizes, limits: Limits) -> Findings:
    """All measurements, in the order of the page."""
    load, start = load_now(), time.monotonic()
    here = [peer for peer in peers if not peer.missing()]
    threads = len(os.sched_getaffinity(0))
    for peer in here:
        peer.lift(room(TINY, threads))  # load kernels, start threads
    under_way = Comparison(here, threads, limits)
    small = under_way.table("Small", sizes.small, {}, limits.lift_s)
    base = under_way.table("Base", sizes.base, small, limits.lift_s)
    growth = [(axis, under_way.growth(axis, base)) for axis in sizes.axes]
    large = under_way.table("Large", sizes.large, base, LARGE_LIFT_S)
    return Findings(
        peers=here,
        absent={peer.name: peer.missing() for peer in peers if peer.missing()},
        limits=limits,
        base=sizes.base,
        tables={"Small": small, "Base": base, "Large": large},
        growth=growth,
        cuts=under_way.cuts,
        alone={peer.name: alone(peer.name, sizes.base if peer.name in base else sizes.small) for peer in here},
        cold={peer.name: alone(peer.name, TINY, cold=True) for peer in here if peer.name in COMPILED},
        load=(load, load_now()),
        seconds=time.monotonic() - start,
    )


def write(found: Findings, out: Path) -> None:
    """The chart and the page, each whole or not at all."""
    figure = Figure(dpi=150, layout="constrained")
    draw(figure, found.growth, in_words(found.base))
    with whole_file(out.parent / CHART) as handle:
        FigureCanvasAgg(figure).print_png(handle)
    with whole_file(out) as handle:
        handle.write(page(found).encode())


def main() -> None:
    """Compare and write."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.peers", description=__doc__)
    parser.add_argument("page", type=Path, metavar="FILE", help="the Markdown to write; its chart goes to images/")
    out = parser.parse_args().page
    write(compare(PEERS, SIZES, Limits()), out)


if __name__ == "__main__":
    main()
