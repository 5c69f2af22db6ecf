"""Feature fidelity: the cosine of rendered features against the given ones (the paper's Table 1b).

On sampled pixels of each view, ``A x`` against every row of B that the pixel reads: one a labelled level, or one a
grid. The views of the lifted pack were seen by the lift; a pack ``NAME_test`` beside it has held-out ones.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.sparse import csr_array

from liftcore.features.pack import open_packs, pair
from liftcore.io.cameras import read_cameras
from liftcore.io.ply import read_splats
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.settings import Preset
from liftcore.solve.readout import read_pixels, sample_pixels

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from matplotlib.figure import Figure
    from torch import Tensor

    from liftcore.features.views import ViewFeatures
    from liftcore.raster.base import CompositingParams, Raster
    from liftcore.scene.cameras import Camera, Cameras
    from tests.benchmarks.experiments.subject import Subject

TITLE = "Feature fidelity"
SOURCE = "the paper's Table 1b"
PACKS = ("features_clean", "features", "features_hard", "grids", "regions")
PIXELS = 1_000  # a view
NOTE = (
    "Vectors of one encoder lie in a narrow cone, so that even unlike ones have a large cosine: compare rows, and "
    "read no quality into a figure by itself."
)
PRESETS = tuple(map(str, Preset))
COLUMNS = ("pack", "preset", "views", "cosine", "held_out_views", "held_out_cosine")


def measure(subject: Subject) -> dict[str, Any]:
    """The mean cosine for every pack of the scene and every preset."""
    cameras = read_cameras(subject.cameras)
    raster = CpuRaster(read_splats(subject.folder / "point_cloud.ply"))
    rows = []
    for pack in subject.packs(*PACKS):
        for preset in PRESETS:
            made = subject.lift(pack, preset=preset)
            walk = made.metadata.settings.render_params
            row: dict[str, Any] = {"pack": pack, "preset": preset}
            row["cosine"], row["views"] = rendered_cosine(
                raster, cameras, subject.pack(pack), made.features, walk, subject.every
            )
            row["held_out_cosine"], row["held_out_views"] = None, 0
            if subject.packs(f"{pack}_test"):
                row["held_out_cosine"], row["held_out_views"] = rendered_cosine(
                    raster, cameras, subject.pack(f"{pack}_test"), made.features, walk, subject.every
                )
            rows.append(row)
    return {"columns": COLUMNS, "rows": rows, "pixels_per_view": PIXELS, "note": NOTE}


def rendered_cosine(
    raster: Raster, cameras: Cameras, pack: Path, features: Tensor, walk: CompositingParams, every: int = 1
) -> tuple[float, int]:
    """Mean cosine of ``A x`` with the rows of B on sampled pixels of every n-th view of a pack, and those views.

    Args:
        features: [P, F]. A pixel whose ray meets nothing counts as zero.
    """
    packs = pair(open_packs([pack]), cameras)[0]
    names = packs.views[::every]
    totals = [view_cosines(raster, cameras[name], packs.observation(name), features, walk) for name in names]
    cosines = np.concatenate(totals)
    return float(cosines.mean()), len(names)


def view_cosines(
    raster: Raster, camera: Camera, observation: ViewFeatures, features: Tensor, walk: CompositingParams
) -> np.ndarray:
    """The cosine of every row of B that the sampled pixels of a view read."""
    pixels = sample_pixels(camera, PIXELS, (0, 0), walk)
    rays = raster.ray_rows(camera, pixels, walk)
    readout = read_pixels(observation, camera, pixels)
    used, places = np.unique(rays.splats.numpy(), return_inverse=True)
    entries = (rays.weights.numpy(), places, rays.indptr.numpy())
    A = csr_array(entries, shape=(len(pixels), len(used)))
    rendered = torch.from_numpy((A @ features[torch.from_numpy(used).long()].float().numpy())[readout.rays])
    return torch.nn.functional.cosine_similarity(rendered, readout.observed(observation.codebook), dim=1).numpy()


def draw(figure: Figure, document: Mapping[str, Any]) -> None:
    """Bars of cosine, a group a pack."""
    packs = list(dict.fromkeys(row["pack"] for row in document["rows"]))
    presets = list(dict.fromkeys(row["preset"] for row in document["rows"]))
    axes = figure.add_subplot()
    width = 0.8 / len(presets)
    for k, preset in enumerate(presets):
        heights = [row["cosine"] for row in document["rows"] if row["preset"] == preset]
        axes.bar(np.arange(len(packs)) + (k - len(presets) / 2 + 0.5) * width, heights, width, label=preset)
    axes.set_xticks(range(len(packs)), packs)
    cosines = [row["cosine"] for row in document["rows"]]
    axes.set_ylim(max(0.0, 2 * min(cosines) - 1), None)  # differences are small beside the values
    axes.set_ylabel("cosine, rendered against given")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(ncols=4, fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.08))
