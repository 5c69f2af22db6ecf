"""``splatlift check``: do splats, cameras, photos and features belong together?"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from liftcore.cli.lift import pairs_of
from liftcore.cli.options import BAD_INPUT, Parser, add_verbose, place
from liftcore.cli.reply import reply

if TYPE_CHECKING:
    from collections.abc import Iterable

    from liftcore.evaluate import CheckReport


CHECKS = """\
Twelve views are compared. The exit status is 2, and the fault is named, unless
- photos have the shape of their cameras, in any size. Others are crops, or lie
  on their side, and are compared no further;
- rays meet splats, and the render of a view is more like its own photo than
  like others. Causes that are recognised: photos that are turned, mirrored,
  shifted (a wrong principal point) or of another exposure, and camera positions
  in another scale;
- masks follow the edges in the photos better than when mirrored, and
  neighbouring cells of grids are more alike than with the axes in another order;
- views agree on the splats that they share at least a fifth as much as their
  most similar regions would allow, and no better with the camera positions at
  another scale.
Photos without a camera and cameras without a photo are named, too.
"""


def add_arguments(parser: Parser) -> None:
    """The options of the command."""
    parser.add_argument("splats", type=place, help="trained splats")
    parser.add_argument("cameras", type=place, help="COLMAP folder or .zip, transforms.json or cameras.json")
    parser.add_argument("others", type=place, nargs="*", help="folders of photos, and feature packs (.safetensors)")
    parser.add_argument("--worst", type=Path, metavar="PNG", help="write the worst view: its photo and the render")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one setting of the lift")
    add_verbose(parser)
    parser.appendix = lambda: CHECKS


def run(options: argparse.Namespace) -> int:
    """Look, and say what is wrong; the exit status is 2 if something is."""
    from liftcore import LiftSettings
    from liftcore.evaluate import check_scene
    from liftcore.files import check_output, writing

    settings = LiftSettings.of(**pairs_of(options.set))
    if options.worst:
        check_output(options.worst, [options.splats], "png")
    packs = [path for path in options.others if path.suffix == ".safetensors"]
    photos = [path for path in options.others if path not in packs]
    begin = time.perf_counter()
    found = check_scene(options.splats, options.cameras, photos, packs or None, True, settings)
    document = {name: value for name, value in asdict(found).items() if name != "worst"}
    for view in document["views"]:
        view["others"] = view["other_psnr"]  # the older key stays
    document |= {"healthy": not found.wrong, "seconds": time.perf_counter() - begin}
    if options.worst and found.worst is not None:
        with writing(options.worst):
            options.worst.write_bytes(found.worst)
        document["worst"] = str(options.worst)
    reply(document, as_json=options.json, lines=_lines(found, document, options.verbose))
    return BAD_INPUT if found.wrong else 0


def _lines(found: CheckReport, document: dict, verbose: bool) -> Iterable[str]:
    if verbose:
        for view in found.views:
            compared = "" if view.psnr is None else f", {view.psnr:.1f} dB to its photo"
            control = "" if view.other_psnr is None else f" and {view.other_psnr:.1f} to others"
            yield f"  {view.view}: row sums {view.row_sum:.3f}{compared}{control}"
        yield f"  {found.in_view:.1%} of the splats are in some view"
        yield from (f"  features, {name.replace('_', ' ')}: {value:.3f}" for name, value in found.features.items())
    compared = [view for view in found.views if view.psnr is not None]
    if compared:
        worst = min(compared, key=lambda view: view.psnr or 0.0)
        typical = median(view.psnr for view in compared if view.psnr is not None)
        yield f"renders are {typical:.1f} dB from their photos in the median, {worst.psnr:.1f} in {worst.view}"
    yield from (f"note: {text}" for text in found.notes)
    yield from (f"wrong: {text}" for text in found.wrong)
    if "worst" in document:
        yield f"  worst: {document['worst']}"
    if found.wrong:
        yield "not healthy: mend what is wrong before you lift"
    else:
        took = f"{document['seconds']:.0f} s"
        yield f"healthy: nothing contradicts anything that was given ({took}); splatlift lift is next"
