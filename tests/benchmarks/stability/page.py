"""``docs/stability.md``: every extreme measured, the sums over many rays, and the flips of wide random scenes."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from liftcore.evaluate.hardware import hardware, machine_line
from tests.benchmarks.stability.accumulation import (
    FEW,
    MOST_CHANNELS,
    MOST_JUDGED,
    MOST_VIEWS,
    SIDES,
    added_one_by_one,
    robust_sums,
    sums_of_entries,
    sums_of_rays,
    sums_of_views,
)
from tests.benchmarks.stability.case import KERNELS
from tests.benchmarks.stability.of_features import LENGTHS, MAPS, REFUSALS
from tests.benchmarks.stability.of_lenses import LENSES
from tests.benchmarks.stability.of_splats import OPACITIES, PLACES, SHAPES
from tests.benchmarks.stability.of_views import VIEWS
from tests.benchmarks.stability.wide import BOUND, CONDITION, SEEDS, survey

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from liftcore.scene.splats import Kernel
    from tests.benchmarks.stability.case import Extreme, Found

TABLES: dict[str, tuple[Extreme, ...]] = {
    "Opacities": OPACITIES,
    "Shapes": SHAPES,
    "Places and crowds": PLACES,
    "Cameras and images": VIEWS,
    "Distorted photos and other frames": LENSES,
    "Features": LENGTHS,
    "Maps, labels and gains": MAPS,
    "Refused": REFUSALS,
}
EXTREMES = tuple(extreme for table in TABLES.values() for extreme in table)

HEAD = """# Numerical stability

What becomes of a lift at the extremes: measured, a row a case, by
`python -m tests.benchmarks.stability docs/stability.md` ({date}; {machine}). Each row is a test too
(`tests/stability/test_table.py`), from the same definition.

The error of weights is the largest difference from the float64 oracle (`liftcore/raster/oracle.py`) over all
weights, their squares, the row sums and the evidence, on all rays of the view and over the kernels that are named;
a row says how many rays float32 decided otherwise at a cut-off, if any did. The error of a distorted photo is how
far from a pixel, in pixels, its ray meets the photo again, once it was carried to the pinhole that draws it. The
error of features is the largest difference from the dense closed form in float64, over the largest value of the
codebook. What float32 gives is shown for the first kernel named. "Told" are the words of `splatlift inspect` and of
the lift's own warnings, where something is lost or taken by convention; where not all kernels tell the same, the
ones that do are named before it.
"""


def page() -> str:
    """Measure everything; the page as Markdown."""
    machine = machine_line(hardware())
    lines = [HEAD.format(date=datetime.now(UTC).date().isoformat(), machine=machine)]
    for title, extremes in TABLES.items():
        lines += [f"## {title}\n", *table_of(extremes), ""]
    return "\n".join([*lines, *_sums(), "", *_wide()]) + "\n"


def table_of(extremes: Sequence[Extreme]) -> Iterator[str]:
    """The rows of some extremes, measured with each of their kernels."""
    yield "| extreme | kernels | exact arithmetic says | float32 gives | error | told |"
    yield "|---|---|---|---|---|---|"
    for extreme in extremes:
        found = [extreme.measure(kernel) for kernel in extreme.kernels]
        kernels = "all" if extreme.kernels == KERNELS else ", ".join(extreme.kernels)
        first = found[0]
        cells = (extreme.name, kernels, extreme.exact, first.gives, _error(found), _told(extreme.kernels, found))
        yield f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def _told(kernels: Sequence[Kernel], found: Sequence[Found]) -> str:
    """What was told, each after the kernels that tell it where not all do."""
    tellers: dict[str, list[Kernel]] = {}
    for kernel, part in zip(kernels, found, strict=True):
        for told in dict.fromkeys(part.told):
            tellers.setdefault(told, []).append(kernel)
    lines = [told if len(by) == len(kernels) else f"{', '.join(by)}: {told}" for told, by in tellers.items()]
    return "; ".join(lines) or "-"


def _error(found: Sequence[Found]) -> str:
    errors = [part.error for part in found if part.error is not None]
    if not errors:
        return "-"
    flips, rays = sum(part.flips for part in found), sum(part.rays for part in found)
    return f"{max(errors):.1e}" + (f"; {flips} of {rays} rays flip" if flips else "")


def _sums() -> Iterator[str]:
    yield "## Sums over many rays\n"
    yield (
        "Relative errors against float64 of the sums of one splat. Region weights and evidence are float32 in a tile "
        "(eight lanes of 32 rays) and float64 from tile to tile, `A^T Y` is float32 throughout; denominators and the "
        "evidence of all views are float64. The closed form adds up to 256 entries of a row and 64 views in float32, "
        "then such parts. The robust step adds up entries in such parts too, and products over channels 64 at a time "
        "in float32, then in float64; the error is of the weights that it leaves. The last column is what one "
        "float32 sum would give. Equal terms are the worst, for then all roundings go one way.\n"
    )
    rays = {side**2: sums_of_rays(side) for side in SIDES}
    names = list(next(iter(rays.values())))
    heads = f"| terms | {' | '.join(names)} | X, a row's entries: random / equal | X, views: random / equal "
    yield f"{heads}| a robust step: entries / channels | equal terms one by one |"
    yield f"|---|{'---|' * (len(names) + 4)}"
    for count, errors in rays.items():
        terms = 10 ** round(math.log10(count))
        entries = " / ".join(f"{sums_of_entries(terms, equal):.0e}" for equal in (False, True))
        views = "-"
        if terms <= MOST_VIEWS:
            views = " / ".join(f"{sums_of_views(terms, equal):.0e}" for equal in (False, True))
        robust = "-"
        if terms <= MOST_JUDGED:
            channels = f"{robust_sums(FEW, terms):.0e}" if terms <= MOST_CHANNELS else "-"
            robust = f"{robust_sums(terms, FEW):.0e} / {channels}"
        cells = [f"{terms:.0e}", *(f"{errors[name]:.0e}" for name in names), entries, views, robust]
        yield f"| {' | '.join(cells)} | {added_one_by_one(terms):.0e} |"


def _wide() -> Iterator[str]:
    surveys = {kernel: survey(kernel) for kernel in KERNELS}
    sound = all(got.finite for got in surveys.values())
    yield "## Wide random scenes\n"
    yield (
        f"{len(SEEDS)} scenes a kernel: logits to +-1e4, footprints of 1e-6 to 1e3 pixels with axes up to 1e9 "
        "apart, depths of 0.003 to 1e6, lenses of a tenth to a thousand image widths, gains of 0.01 to 16 "
        "(`liftcore/measure/stability/wide.py`). Scenes with a projected covariance whose condition is beyond "
        f"{CONDITION:g} are walked, and not judged; discs have none and are all judged. The test holds the errors of "
        "these very scenes to the bound. That of DBS is wider: at the rim of a narrow splat, alpha may change by "
        "16 times what the rounding of sigma changes."
        f"{' In all scenes weights are finite, and no row sum exceeds one.' if sound else ''}\n"
    )
    yield "| kernel | scenes judged | rays | near a cut-off | flipped | largest error elsewhere | bound |"
    yield "|---|---|---|---|---|---|---|"
    for kernel, got in surveys.items():
        yield (
            f"| {kernel} | {got.judged} of {got.scenes} | {got.rays} | {got.near} | {got.flips} | {got.error:.1e} "
            f"| {BOUND:g} |"
            if got.finite
            else f"| {kernel} | NOT FINITE | | | | | |"
        )
