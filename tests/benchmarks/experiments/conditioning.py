"""What the gain lambda does to A^T A, beside the claim that Tikhonov Guidance stabilises the solution.

The paper argues that polarised opacities (and squared weights) make A more diagonally dominant, which keeps small
eigenvalues away and lowers beta. Each is measured for lambda from 0.5 to 8, on rays of the scene and on a synthetic
room that is small enough for its whole spectrum:

- own share: how much of what the closed form gives a splat comes from the splat itself, its diagonal over its row;
- dominant: the share of splats whose diagonal outweighs the rest of its row;
- cond: of the unit-diagonal (Jacobi) form of A^T A, and of C^T C with the squared weights C, over splats that lie
  together; a lower bound of the whole scene's. Splats that the gain hides are left out and counted;
- coupling: the largest eigenvalue of the unit-diagonal form over all splats; 1 where splats share no ray;
- noise: how much of white noise in B stays in a splat's closed form (a deviation; a mean over n equal rays has
  n^-1/2), whatever A^T A may be: the closed form never inverts it;
- beta: the paper's, at the closed form of the first pack's regions, in random projections of its vectors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.evaluate.synthetic import room_cameras, room_splats
from liftcore.io.cameras import read_cameras
from liftcore.io.ply import read_splats
from liftcore.raster.cpu.raster import CpuRaster
from tests.benchmarks.conditioning import coupling, neighbourhood, noise_gain, rays_of, self_share, spectrum

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.figure import Figure

    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats
    from tests.benchmarks.experiments.subject import Subject

TITLE = "Conditioning of A^T A"
SOURCE = "the paper's Tikhonov Guidance and its property that diagonal dominance reduces beta"
GAINS = (0.5, 0.8, 1.0, 1.2, 1.5, 2.0, 4.0, 8.0)
RAYS = 150_000  # of the scene
NEIGHBOURS = 1_200  # splats whose dense spectrum is taken
ROOM_SPLATS, ROOM_VIEWS, ROOM_SIZE = 600, 16, (96, 72)
PACKS = ("features", "regions", "features_clean")
COLUMNS = (
    "scene", "gain", "own_share_w", "own_share_w2", "dominant", "coupling", "cond_w", "cond_w2", "lost_w", "hidden",
    "noise_w", "noise_w2", "beta_median",
)  # fmt: skip


def measure(subject: Subject) -> dict[str, Any]:
    """The figures of the scene, over every n-th camera, and of the room, for every gain."""
    splats = read_splats(subject.folder / "point_cloud.ply")
    cameras = list(read_cameras(subject.cameras).values())[:: subject.every]
    betas = _betas(subject)
    rows = [
        *_rows(subject.folder.resolve().name, splats, cameras, betas),
        *_rows("room", room_splats(ROOM_SPLATS), room_cameras(ROOM_VIEWS, *ROOM_SIZE), {}),
    ]
    note = (
        f"{len(cameras)} views, about {RAYS} rays of them; conditions over {NEIGHBOURS} splats around the heaviest. "
        f"The room has {ROOM_SPLATS} splats and {ROOM_VIEWS} views, and its conditions are of all its splats with "
        "evidence over a half. lost: the share of eigenvalues below 1e-6 of the largest. hidden: splats of them that "
        "the gain makes invisible."
    )
    return {"columns": COLUMNS, "rows": rows, "note": note}


def _rows(name: str, splats: Splats, cameras: Sequence[Camera], betas: Mapping[float, Any]) -> list[dict[str, Any]]:
    raster, rows = CpuRaster(splats), []
    evidence = np.asarray(rays_of(raster, cameras, 1.0, RAYS).sum(axis=0)).ravel()
    chosen = neighbourhood(splats.means, evidence, NEIGHBOURS)
    for gain in GAINS:
        A = rays_of(raster, cameras, gain, RAYS)
        own, dominant = self_share(A, 1, evidence)
        plain, squared = spectrum(A, 1, chosen), spectrum(A, 2, chosen)
        rows.append(
            {
                "scene": name,
                "gain": gain,
                "own_share_w": own,
                "own_share_w2": self_share(A, 2, evidence)[0],
                "dominant": dominant,
                "coupling": coupling(A),
                "cond_w": plain.condition,
                "cond_w2": squared.condition,
                "lost_w": plain.lost,
                "hidden": plain.hidden,
                "noise_w": noise_gain(A, 1, chosen),
                "noise_w2": noise_gain(A, 2, chosen),
                "beta_median": betas.get(gain),
            }
        )
    return rows


def _betas(subject: Subject) -> dict[float, float | None]:
    """The certificate's median beta of a row-sum lift at every gain; none where the scene has no pack of regions."""
    packs = subject.packs(*PACKS)
    if not packs:
        return {}
    found = {}
    for gain in GAINS:
        made = subject.lift(packs[0], preset="row-sum", lift_gain=gain, stride=2, certificate_rays=5_000)
        found[gain] = made.metadata.certificate["beta"]["median"]
    return found


def draw(figure: Figure, document: Mapping[str, Any]) -> None:
    """Conditions against lambda, and the splats' own share of what they are given."""
    upper, lower = figure.subplots(2, 1, sharex=True)
    for scene in dict.fromkeys(row["scene"] for row in document["rows"]):
        rows = [row for row in document["rows"] if row["scene"] == scene]
        gains = [row["gain"] for row in rows]
        for key, style, label in (("cond_w", "-o", "w"), ("cond_w2", "--s", "w squared")):
            upper.plot(gains, [row[key] for row in rows], style, label=f"{scene}, {label}")
        for key, style, label in (("own_share_w", "-o", "w"), ("own_share_w2", "--s", "w squared")):
            lower.plot(gains, [row[key] for row in rows], style, label=f"{scene}, {label}")
    upper.set_yscale("log")
    upper.set_ylabel("condition (Jacobi)")
    lower.set_ylabel("own share")
    lower.set_xlabel("lambda")
    lower.set_xscale("log", base=2)
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
    upper.legend(fontsize="small")
