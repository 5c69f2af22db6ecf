# pyright: strict
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# numpy, scipy and torch leave types of what they compute open
"""Lift masks of a segmenter with a vector each, as SAM and CLIP give them, and export every object.

python examples/sam_masks.py scene.ply sparse/0 masks things.glb

``masks`` is a folder of an ``.npz`` a view, named as the view: ``masks`` [M, H, W] booleans, which may overlap, and
``vectors`` [M, F], the embedding of each.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import liftcore as lc


def views_of(folder: Path) -> Iterator[tuple[str, lc.Regions]]:
    """Yield one view after the other, so that the masks of all views need not fit in memory."""
    for file in sorted(folder.glob("*.npz")):
        with np.load(file, allow_pickle=False) as arrays:
            yield file.stem, lc.Regions.from_masks(arrays["masks"], arrays["vectors"])


def main(splats_path: str, cameras_path: str, masks_path: str, out: str) -> None:
    """Write ``out``: a ``.glb`` or ``.ply`` with labels."""
    splats, cameras = lc.read_splats(splats_path), lc.read_cameras(cameras_path)
    result = lc.lift(splats, cameras, views_of(Path(masks_path)))
    scene = result.scene(splats, cameras)
    objects = scene.tree()
    print(objects.explanation)
    for item in objects.objects:
        print(f"object {item.id}: {item.splats} splats about {', '.join(f'{c:.2f}' for c in item.centre)}")
    scene.export(out, objects)


if __name__ == "__main__":
    main(*sys.argv[1:5])
