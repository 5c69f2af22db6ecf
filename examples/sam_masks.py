# pyright: strict
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# numpy, scipy and torch leave types of what they compute open
"""Lift masks of a segmenter with a vector each, as SAM and CLIP give them, and export every thing that was found.

python examples/sam_masks.py scene.ply sparse/0 masks things.zip

``masks`` is a folder of an ``.npz`` a view, named as the view: ``masks`` [M, H, W] booleans, which may overlap, and
``vectors`` [M, F], the embedding of each.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import liftcore as lc


def views_of(folder: Path) -> Iterator[tuple[str, lc.Regions]]:
    """Give one view after the other: the masks of all of them need not fit in memory."""
    for file in sorted(folder.glob("*.npz")):
        with np.load(file, allow_pickle=False) as arrays:
            yield file.stem, lc.Regions.from_masks(arrays["masks"], arrays["vectors"])


def main(splats_path: str, cameras_path: str, masks_path: str, out: str) -> None:
    """Write ``out``: a ``.zip`` of everything, or a ``.glb``, ``.ply``, ``.spz`` or ``.jsonl`` with labels."""
    splats, cameras = lc.read_splats(splats_path), lc.read_cameras(cameras_path)
    result = lc.lift(splats, cameras, views_of(Path(masks_path)))
    scene = result.scene(splats, cameras)
    things = scene.catalogue()
    print(things.explanation)
    for thing in things.objects:
        print(f"object {thing.id}: {thing.splats} splats about {', '.join(f'{c:.2f}' for c in thing.centre)}")
    scene.export(out, things)


if __name__ == "__main__":
    main(*sys.argv[1:5])
