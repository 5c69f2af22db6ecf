"""The pipeline, as the paper reads: A from the scene, B from the packs, X in closed form, and its certificate."""

from __future__ import annotations

import hashlib
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from liftcore import __version__
from liftcore.artifact import InputFile, Lift, LiftMetadata
from liftcore.observe.pack import open_packs, pair
from liftcore.progress import Progress, silent
from liftcore.raster.antialiased import check_antialiased
from liftcore.raster.cpu import CpuRaster
from liftcore.raster.warm_up import warm_up
from liftcore.scene.load import camera_files, load_cameras, load_splats
from liftcore.solve.accumulate import accumulate, as_read, lift_walk
from liftcore.solve.aggregation import aggregate
from liftcore.solve.all_rays import AllRays
from liftcore.solve.certificate import certify
from liftcore.solve.checkpoint import Checkpoint, identity, resumed
from liftcore.solve.closed_form import solve_closed_form
from liftcore.solve.least_squares import refine
from liftcore.solve.reference import reference
from liftcore.solve.robust import robust_weights
from liftcore.solve.view_weights import ViewWeights

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from liftcore.solve.settings import LiftSettings


@dataclass
class Timings:
    """Seconds a stage."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block under that name."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def lift(
    splats: Path,
    cameras: Path,
    features: Sequence[Path],
    settings: LiftSettings,
    *,
    threads: int | None = None,
    progress: Progress = silent,
    checkpoint: Checkpoint | None = None,
) -> Lift:
    """Lift the features of the packs onto the splats.

    Args:
        splats: a PLY of any dialect. cameras: COLMAP, transforms.json or cameras.json. features: feature packs.
        threads: None takes the cores that this process may use. The number changes no bit of the result.
        progress: told of every view and slice; an exception from it stops the work.
        checkpoint: keeps walked views on the disk; the same lift goes on from there, identical to the bit.

    Raises:
        InvalidInput: a file is malformed, or the packs do not fit the cameras.
        InvalidSettings: the splats' kernel has no opacity compensation, and the settings ask for it.
    """
    timings = Timings()
    with timings.stage("read"):
        scene, views = load_splats(splats), load_cameras(cameras)
        check_antialiased(scene.kernel, settings.antialiased)
        packs = open_packs(features)
        names, unpaired = pair(packs, views)
        names = names[:: settings.view_stride]
    with timings.stage("digest"):
        inputs = [input_file(path) for path in (splats, cameras, *features)]
    with timings.stage("compile"):
        warm_up(scene.kernel)
    with ViewWeights() as store:
        with timings.stage("geometry"):
            raster = CpuRaster(scene, threads)
            key = identity([part.sha256 for part in inputs], settings) if checkpoint else ""
            with resumed(raster, checkpoint, key) as walked:
                geometry = accumulate(walked, (scene.count, views), packs, names, settings, store, progress)
        codebooks = geometry.codebooks
        with timings.stage("robust"):
            weights = robust_weights(
                store, codebooks, geometry.denominators, settings.robust_steps, progress, threads
            )
        with timings.stage("solve"):
            dtype = getattr(torch, settings.dtype)
            solution = solve_closed_form(
                weights, codebooks.__getitem__, geometry.denominators, dtype, progress, threads
            )
        X, seen, notes = solution.features, geometry.denominators > 0, {}
        rays = None
        if settings.cg_steps or settings.reference_channels:
            with timings.stage("rays"):
                rays = AllRays(
                    raster,
                    scene.count,
                    [views.get(name) for name in names],
                    lambda view: as_read(packs.observation(names[view]), settings, names[view]),
                    lift_walk(settings),
                    progress,
                )
        if rays and settings.cg_steps:
            with timings.stage("refine"):
                refinement = refine(rays, X, seen, codebooks, settings, progress)
                X, notes["refinement"] = refinement.features, refinement.stats
        if rays and settings.reference_channels:
            with timings.stage("reference"):
                notes["reference"] = reference(rays, X, seen, geometry.samples, codebooks, settings, progress)
        aggregation = None
        if settings.aggregation:
            with timings.stage("aggregate"):
                lifted = (raster, views, packs, names)
                aggregation = aggregate(X, geometry.evidence, lifted, settings, progress, threads)
                notes["aggregation"] = aggregation.facts
        with timings.stage("certify"):
            certificate = certify(geometry, X, codebooks.__getitem__, settings, threads) | notes
        certificate |= {"weights_entries": sum(len(part.columns) for part in store), "views_without_camera": unpaired}
    metadata = LiftMetadata(
        version=__version__,
        settings=settings,
        splats=inputs[0],
        cameras=inputs[1],
        features=tuple(inputs[2:]),
        encoder=packs.encoder,
        text_space=packs.text_space,
        views=tuple(names),
        certificate=certificate,
        timings=timings.seconds,
    )
    return Lift(
        features=X,
        evidence=torch.from_numpy(geometry.evidence).to(torch.float32),
        agreement=solution.agreement,
        seen=torch.from_numpy(seen),
        metadata=metadata,
        cluster=aggregation.clusters if aggregation else None,
        cluster_features=aggregation.cluster_features if aggregation else None,
    )


def input_file(path: Path) -> InputFile:
    """Where an input is and what it is: the digest of the file, or of the names and digests of a folder's cameras.

    Photos, features and lifts that lie in the same folder do not count: they may come and go.
    """
    resolved = path.resolve()
    if not resolved.is_dir():
        return InputFile(path=str(resolved), sha256=_digest(resolved))
    total = hashlib.sha256()
    for part in camera_files(resolved):
        total.update(f"{part.relative_to(resolved)} {_digest(part)}\n".encode())
    return InputFile(path=str(resolved), sha256=total.hexdigest())


def _digest(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
