"""Checks of inputs in a user's first hour: contradictions are reported, healthy inputs are not.

    python -m tests.benchmarks.first_hour SHARED [--json]

SHARED holds the folders ``plush`` and ``tabletop``; the still life is generated. Each case is a row: ``done`` or
``NOT DONE``, and what was seen. A healthy scene is done where `check` finds nothing wrong with all of its views, 20,
10 and 6 of them, a broken one where it is reported, with photos and without:

- ``positions x 0.3``, ``x 0.5``: the cameras' positions in another scale than the splats;
- ``foreign cameras``: the other scene's, under the names of its own;
- ``[F, h, w] under [h, w, F]``: a grid whose bytes lie in another order than its shape says.
"""

import json
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

import liftcore as lc
from liftcore.evaluate.check import check_scene
from liftcore.features.encoders.encode import find_images
from liftcore.values.pack import Views, as_views
from tests.benchmarks.base import command_line, read_scene
from tests.still_life.files import write_still_life
from tests.still_life.scene import still_life

COUNTS = (20, 10, 6)  # of views, beside all
MOST_SECONDS = 20.0  # that `check` may take on plush
PACKS = {
    "plush": ("grids", "regions"),
    "tabletop": ("features", "features_clean", "features_hard", "grids"),
    "still life": ("features",),
}


class Case(NamedTuple):
    """A fault, True if the check is right about it, and the message of the check."""

    fault: str
    passed: bool
    message: str


Scene = tuple[lc.Splats, lc.Cameras, Mapping[str, Path] | None]  # as `check` takes it


def main() -> int:
    """Run the cases and print them; 1 where one is not done."""
    options = command_line("tests.benchmarks.first_hour", __doc__, ("shared", {"type": Path})).parse_args()
    cases = []
    with tempfile.TemporaryDirectory() as scratch:
        for case in _cases(options.shared, Path(scratch)):
            cases.append(case)
            if not options.json:
                print(f"{'done' if case.passed else 'NOT DONE':<9} {case.fault}: {case.message}", flush=True)
    passed = sum(case.passed for case in cases)
    print(json.dumps([case._asdict() for case in cases]) if options.json else f"{passed} of {len(cases)} are done")
    return 0 if passed == len(cases) else 1


def _cases(shared: Path, scratch: Path) -> Iterator[Case]:
    write_still_life(scratch, still_life())
    folders = {"plush": shared / "plush", "tabletop": shared / "tabletop", "still life": scratch}
    scenes = {name: _open_scene(folder) for name, folder in folders.items()}
    for name, scene in scenes.items():
        foreign = scenes["tabletop" if name == "plush" else "plush"][1]
        for pack in PACKS[name]:
            views = lc.read_features(folders[name] / f"{pack}.safetensors")
            yield from _healthy(f"{name} {pack}", scene, views)
            yield from _broken(f"{name} {pack}", scene, views, foreign)
    begin = time.perf_counter()
    check_scene(*scenes["plush"], lc.read_features(shared / "plush" / "grids.safetensors"))
    took = time.perf_counter() - begin
    yield Case(f"check of plush within {MOST_SECONDS:g} s", took <= MOST_SECONDS, f"{took:.1f} s")


def _open_scene(folder: Path) -> Scene:
    photos = folder / "images"
    return *read_scene(folder), find_images([photos]) if photos.is_dir() else None


def _healthy(name: str, scene: Scene, views: Views) -> Iterator[Case]:
    for count in (len(views), *(count for count in COUNTS if count < len(views))):
        sample = [views.views[int(k)] for k in np.linspace(0, len(views) - 1, count)]
        report = check_scene(*scene, as_views({view: views[view] for view in sample}))
        agreement = report.features.get("agreement_of_views", float("nan"))
        message = report.wrong[0] if report.wrong else f"nothing is reported, views agree to {agreement:.2f}"
        yield Case(f"{name}, healthy, {len(sample)} views", not report.wrong, message)


def _broken(name: str, scene: Scene, views: Views, foreign: lc.Cameras) -> Iterator[Case]:
    splats, cameras, photos = scene
    foreign_cameras = [
        camera.replace(name=camera_name)
        for camera_name, camera in zip(cameras, cycle(foreign.values()), strict=False)
    ]
    broken = {
        "positions x 0.3": (_scaled(cameras, 0.3), views),
        "positions x 0.5": (_scaled(cameras, 0.5), views),
        "foreign cameras": (lc.Cameras(foreign_cameras), views),
    }
    if not views.is_regions(views.views[0]):
        broken["[F, h, w] under [h, w, F]"] = (cameras, _turn_views(views))
    for fault, (wrong_cameras, wrong_features) in broken.items():
        for check_photos in (photos, None) if photos else (None,):
            report = check_scene(splats, wrong_cameras, check_photos, wrong_features)
            suffix = "with photos" if check_photos else "without photos"
            message = report.wrong[0] if report.wrong else "nothing is reported"
            yield Case(f"{name}, {fault}, {suffix}", bool(report.wrong), message)


def _scaled(cameras: lc.Cameras, factor: float) -> lc.Cameras:
    scale = np.ones((4, 4))
    scale[:3, 3] = factor
    return lc.Cameras([camera.replace(viewmat=camera.viewmat * scale) for camera in cameras.values()])


def _turn_views(views: Views) -> Views:
    turned_views = {}
    for name, view in views.items():
        assert isinstance(view, lc.FeatureGrid)
        turned_views[name] = lc.FeatureGrid(
            torch.clone(view.grid.permute(2, 0, 1).contiguous()).reshape(view.grid.shape)
        )
    return as_views(turned_views)


if __name__ == "__main__":
    sys.exit(main())
