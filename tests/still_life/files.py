"""The still life written as a scene folder, in the formats of the field."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from safetensors.numpy import save_file

from liftcore.io.splats import write_splats
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.text.table import TableEncoder
from liftcore.values.pack import write_pack
from tests.inria_file import write_inria_cameras
from tests.still_life.masks import Mistakes, observe
from tests.still_life.scene import StillLife

SEED = 7
CHANNELS = 64  # random directions of so many channels are nearly orthogonal


def write_still_life(folder: Path, scene: StillLife) -> Path:
    """Write ``point_cloud.ply``, ``cameras.json``, ``features.safetensors``, a table of words; the table's path."""
    words = list(dict.fromkeys([*scene.objects, *scene.parts]))
    vectors = np.random.default_rng(SEED).standard_normal((len(words), CHANNELS)).astype(np.float32)
    observed = observe(scene, CpuRaster(scene.splats), TableEncoder("words", words, vectors), Mistakes(), SEED)
    write_splats(folder / "point_cloud.ply", scene.splats)
    write_inria_cameras(scene.cameras, folder / "cameras.json")
    metadata = {"encoder": "generated masks", "text_space": "words", "normalised": "true"}
    write_pack(folder / "features.safetensors", observed, metadata)
    table = folder / "text_table.safetensors"
    save_file({"embeddings": vectors}, table, metadata={"words": json.dumps(words)})
    return table
