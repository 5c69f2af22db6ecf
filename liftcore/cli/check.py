"""``splatlift check``: check that splats, cameras, photos and features match."""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from liftcore.cli.lift import pairs_of
from liftcore.cli.options import BAD_INPUT, Parser, add_verbose
from liftcore.cli.reply import check_outputs, reply, write_files

if TYPE_CHECKING:
    from collections.abc import Iterable

    from liftcore.evaluate import CheckReport


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_argument("splats", type=Path, help="trained splats")
    parser.add_argument("cameras", type=Path, help="COLMAP folder or .zip, transforms.json or cameras.json")
    parser.add_argument("others", type=Path, nargs="*", help="folders of photos, and feature packs (.safetensors)")
    parser.add_argument("--worst", type=Path, metavar="PNG", help="write the worst view: its photo and the render")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one setting of the lift")
    add_verbose(parser)


def run(options: argparse.Namespace) -> int:
    """Check the scene, and print the problems; the exit status is 2 if there are any."""
    from liftcore import LiftSettings
    from liftcore.evaluate import check_scene

    settings = LiftSettings.of(**pairs_of(options.set))
    files = {"worst": options.worst} if options.worst else {}
    check_outputs(files, options)
    packs = [path for path in options.others if path.suffix == ".safetensors"]
    photos = [path for path in options.others if path not in packs]
    begin = time.perf_counter()
    report = check_scene(options.splats, options.cameras, photos, packs or None, True, settings)
    document = {name: value for name, value in asdict(report).items() if name != "worst"}
    document |= {"healthy": not report.wrong, "seconds": time.perf_counter() - begin}
    if (picture := report.worst) is not None:
        document |= write_files(files, {"worst": lambda path: path.write_bytes(picture)})
    reply(document, as_json=options.json, lines=_lines(report, document, options.verbose))
    return BAD_INPUT if report.wrong else 0


def _lines(report: CheckReport, document: dict, verbose: bool) -> Iterable[str]:
    if verbose:
        for view in report.views:
            photo_match = "" if view.psnr is None else f", {view.psnr:.1f} dB to its photo"
            other_match = "" if view.other_psnr is None else f" and {view.other_psnr:.1f} to others"
            yield f"  {view.view}: row sums {view.row_sum:.3f}{photo_match}{other_match}"
        yield f"  {report.in_view:.1%} of the splats are in some view"
        yield from (f"  features, {name.replace('_', ' ')}: {value:.3f}" for name, value in report.features.items())
    photo_views = [view for view in report.views if view.psnr is not None]
    if photo_views:
        worst = min(photo_views, key=lambda view: view.psnr or 0.0)
        typical = median(view.psnr for view in photo_views if view.psnr is not None)
        yield f"renders are {typical:.1f} dB from their photos in the median, {worst.psnr:.1f} in {worst.view}"
    yield from (f"note: {text}" for text in report.notes)
    yield from (f"wrong: {text}" for text in report.wrong)
    if "worst" in document:
        yield f"  worst: {document['worst']}"
    if report.wrong:
        yield "not healthy: fix the problems before you lift"
    else:
        yield f"healthy: no contradictions between the inputs ({document['seconds']:.0f} s); next: splatlift lift"
