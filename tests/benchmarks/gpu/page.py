"""``docs/benchmarks_gpu.md``: what the figures of a card say, with the card, the versions and the day."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from liftcore.evaluate.hardware import hardware, machine_line
from tests.benchmarks.gpu.figures import SEEN

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from liftcore.device import Device
    from tests.benchmarks.gpu.figures import Agreement, Pieces
    from tests.benchmarks.gpu.gsplat_lift import SideBySide
    from tests.benchmarks.gpu.room_files import RoomSize

BAR_VIEW_MS, BAR_TOTAL_S = 10.0, 5.0  # on an H100: a view, and the whole lift of BAR with its save


@dataclass(frozen=True)
class Findings:
    """All that the page tells."""

    device: Device
    sizes: tuple[RoomSize, RoomSize]  # of the whole lift, and of what both devices lift
    whole: Mapping[str, Any]
    benches: Mapping[str, Mapping[str, Any]]  # workload -> what ``splatlift bench`` says
    agreements: Mapping[str, Agreement]
    tabletop: Sequence[Mapping[str, Any]] | None  # None where the scene is not here
    peer: SideBySide | str  # in words why not
    pieces: Pieces | None  # None off a card
    command: str


def page(found: Findings) -> str:
    """The page as Markdown."""
    parts = (_head, _whole, _repeated, _benches, _agreement, _tabletop, _peer)
    return "\n".join(line for part in parts for line in part(found)) + "\n"


def _head(found: Findings) -> Iterator[str]:
    facts = found.device.facts()
    versions = ", ".join(f"{name} {version}" for name, version in facts["versions"].items())
    machine = machine_line(hardware())
    yield "# On a GPU"
    yield ""
    yield f"{facts['name']} ({versions}; {machine}), {datetime.now(UTC):%Y-%m-%d}, written by `{found.command}`."
    yield ""


def _whole(found: Findings) -> Iterator[str]:
    size, whole = found.sizes[0], found.whole
    yield "## A whole lift"
    yield ""
    yield (
        f"{_in_words(size)}, `tikhonov`, files to file, the second lift of two: {whole['total_s']:.2f} s with "
        f"reading, digests, certificate and saving (the bar for an H100 is {BAR_TOTAL_S:g} s); geometry takes "
        f"{whole['geometry_ms_a_view']:.1f} ms a view (bar {BAR_VIEW_MS:g} ms), with its part on the processor."
    )
    peak = whole["peak_device_bytes"]
    if peak is not None:
        parts = ", ".join(
            f"{name} {_mib(size)}" for name, size in (whole["planned"] or {"parts": {}})["parts"].items()
        )
        yield f"Peak on the card: {_mib(peak)} MiB by torch's count; the plan said, in MiB: {parts}."
    yield ""
    yield "| stage | seconds |"
    yield "|---|---|"
    yield from (f"| {name} | {seconds:.2f} |" for name, seconds in whole["stages_s"].items())
    yield ""


def _repeated(found: Findings) -> Iterator[str]:
    yield "## The same to the bit"
    yield ""
    again = found.whole["differing"]
    yield "Both of these lifts are the same to the bit." if not again else f"**They differ in {', '.join(again)}.**"
    if found.pieces is not None:
        cut = found.pieces
        given = f"a view in strips, given {_mib(cut.free)} MiB where one piece is planned at {_mib(cut.whole)} MiB"
        yield f"**Not as promised, of {given}: {', '.join(cut.broken)}.**" if cut.broken else f"So is {given}."
        if cut.peak is not None:
            yield f"It took {_mib(cut.peak)} MiB at its peak by torch's count."
    yield ""


def _benches(found: Findings) -> Iterator[str]:
    yield "## A view (`splatlift bench --device cuda`)"
    yield ""
    yield "| scene | preset | geometry, ms a view | least | solution, ms a view |"
    yield "|---|---|---|---|---|"
    for name, bench in found.benches.items():
        size = f"{name}, {bench['splats']} splats, {bench['width']} x {bench['height']}, {bench['channels']} channels"
        for preset, row in bench["presets"].items():
            keys = ("geometry_s_per_view", "geometry_s_per_view_min", "solve_s_per_view")
            yield f"| {size} | `{preset}` | " + " | ".join(f"{1e3 * row[key]:.1f}" for key in keys) + " |"
    yield ""


def _agreement(found: Findings) -> Iterator[str]:
    yield "## Beside the processor"
    yield ""
    yield f"The same lift on both, over splats with evidence over {SEEN:g}. A ray at a cut-off may fall either way."
    yield ""
    yield "| scene | splats | least cosine | largest difference / largest value | evidence, relative | seen by one |"
    yield "|---|---|---|---|---|---|"
    for name, near in found.agreements.items():
        yield (
            f"| {name} | {near.splats} | {near.least_cosine:.6f} | {near.largest_difference:.1e} | "
            f"{near.largest_evidence_difference:.1e} | {near.only_one_sees} |"
        )
    yield ""


def _tabletop(found: Findings) -> Iterator[str]:
    yield "## Accuracy on tabletop"
    yield ""
    if found.tabletop is None:
        yield "The scene is not here."
        yield ""
        return
    yield "| features, weights | splat accuracy | of the data's README | mIoU | of the data's README | seconds |"
    yield "|---|---|---|---|---|---|"
    for row in found.tabletop:
        figures, given = row["figures"], [_given(row[key]) for key in ("base", "base_miou")]
        yield (
            f"| {row['name']} | {figures.accuracy:.4f} | {given[0]} | {figures.miou:.4f} | {given[1]} | "
            f"{figures.seconds:.1f} |"
        )
    yield ""


def _peer(found: Findings) -> Iterator[str]:
    yield "## gsplat, by autograd"
    yield ""
    peer = found.peer
    if isinstance(peer, str):
        yield f"Not measured: {peer}."
        return
    yield (
        f"{_in_words(found.sizes[1])}, both in turns in one process, from tensors to X, medians: splatlift "
        f"{peer.ours_s:.2f} s, the gradient through gsplat {peer.gsplat} {peer.theirs_s:.2f} s "
        f"({peer.theirs_s / peer.ours_s:.1f} times). Their features have a cosine of {peer.cosine:.5f} with ours "
        "(mean by evidence; gsplat caps alphas elsewhere)."
    )


def _in_words(size: RoomSize) -> str:
    return (
        f"a synthetic room of {size.splats:,} splats, {size.views} views of {size.width} x {size.height}, "
        f"{size.levels} levels, {size.channels} channels"
    )


def _given(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _mib(size: int) -> str:
    return f"{size / 2**20:.0f}"
