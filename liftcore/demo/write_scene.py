"""The still life written as a scene folder, in the formats of the field."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.demo.masks import Mistakes, observe, true_labels
from liftcore.demo.scene_folder import DemoScene, Truth
from liftcore.demo.still_life import StillLife, still_life

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from liftcore.raster.base import Raster

SEED = 7
PICTURED = "view_07"  # of the held-out views, the one that shows every object whole

# Phrases that name no object: the sentence encoder has to know what they mean.
PHRASES = {
    "something to drink coffee from": ("mug",),
    "fresh fruit": ("red apple", "orange", "yellow banana"),
    "reading light": ("lamp",),
}


def write_still_life(folder: Path, phrases: Sequence[str], scene: StillLife | None = None) -> DemoScene:
    """Make the still life and write ``point_cloud.ply``, ``cameras.json`` and ``features.safetensors``.

    Raises:
        Unavailable: the sentence encoder is not installed.
    """
    from liftcore.features.pack import write_pack
    from liftcore.io.inria import write_inria_cameras
    from liftcore.io.ply import write_splats
    from liftcore.query.text import open_encoder
    from liftcore.raster.cpu.raster import CpuRaster

    scene = scene or still_life(SEED)
    raster = CpuRaster(scene.splats, threads=None)
    observed = observe(scene, raster, open_encoder("minilm"), Mistakes(), SEED)
    splats, cameras, features = (
        folder / name for name in ("point_cloud.ply", "cameras.json", "features.safetensors")
    )
    write_splats(scene.splats, splats)
    write_inria_cameras(scene.cameras, cameras)
    write_pack(
        features,
        observed,
        {"encoder": "generated masks, words of all-MiniLM-L6-v2", "text_space": "minilm", "normalised": "true"},
    )
    return DemoScene(
        name="still life",
        splats=splats,
        cameras=cameras,
        features=features,
        encoder="minilm",
        text_space="minilm",
        phrases=tuple(phrases) or tuple(PHRASES),
        views=tuple(sorted(scene.held_out, key=lambda view: view != PICTURED)),
        truth=_truth(scene, raster),
    )


def _truth(scene: StillLife, raster: Raster) -> Truth:
    return Truth(
        names=scene.things,
        splat_objects=scene.splat_things,
        masks={view: true_labels(scene, raster, view)[0] for view in scene.held_out},
        meant=PHRASES | {f"the {name}": (name,) for name in scene.things},
    )
