"""A lift opened for queries, with the scene that it was made from."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Self

from liftcore.errors import InvalidQuery
from liftcore.io.lift_file import load_lift
from liftcore.query.in_photo import in_photo
from liftcore.query.products import norms_of
from liftcore.query.scores import mean_direction
from liftcore.query.unchanged import unchanged
from liftcore.raster.base import CompositingParams
from liftcore.result import LiftResult
from liftcore.scene.cameras import drawn_by, photo_size

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from torch import Tensor

    from liftcore.features.pack import FeaturePacks
    from liftcore.raster.base import Raster
    from liftcore.scene.cameras import Camera, Cameras
    from liftcore.scene.splats import Splats


MOST_PIXELS = 1 << 26  # of a picture: 67 million take a minute of one core and 2 GB


class QueryScene:
    """Features, and on demand the splats, the cameras and the raster that turn scores into pictures.

    Scores need the lift file alone. The scene's own files are found where the lift remembers them, are
    checked against their digests when first used, and are loaded once.
    """

    def __init__(self, lift: LiftResult, path: Path) -> None:
        self.lift = lift
        self.path = path
        self._packs_at = [Path(file.path) for file in lift.metadata.features]

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open a lift; its features are mapped, not read.

        Raises:
            InvalidLift: the file is missing or is not a lift.
        """
        return cls(load_lift(path), path)

    @cached_property
    def norms(self) -> Tensor:
        """[P] f32, the features' norms, computed once a lift."""
        return norms_of(self.lift.features)

    @cached_property
    def seen(self) -> Tensor:
        """[P] bool, whether a splat has a feature."""
        return self.lift.seen & (self.norms > 0)

    @cached_property
    def all_seen(self) -> bool:
        """Whether every splat has one."""
        return bool(self.seen.all())

    @cached_property
    def weights(self) -> Tensor | None:
        """How much each seen splat counts in a histogram, its evidence; None when none has evidence."""
        weights = self.lift.evidence[self.seen]
        return weights if bool((weights > 0).any()) else None

    @cached_property
    def mean(self) -> Tensor:
        """[F] f32, the mean of the unit features, weighted by evidence: what all the scene's features share."""
        return mean_direction(self.lift.features, self.norms, self.lift.evidence)

    @cached_property
    def principal(self) -> Tensor:
        """[P, 3] f32 in 0..1, the features as colours."""
        from liftcore.query.principal import principal_colours

        return principal_colours(self.lift.features, self.lift.evidence)

    @property
    def channels(self) -> int:
        """F."""
        return int(self.lift.features.shape[1])

    @cached_property
    def splat_file(self) -> Path:
        """The file of the splats that were lifted.

        Raises:
            InvalidLift: it moved, or is another than the one that was lifted.
        """
        return unchanged("splats", self.lift.metadata.splats, self.path)

    @cached_property
    def splats(self) -> Splats:
        """The splats that were lifted.

        Raises:
            InvalidLift: their file moved, or is another than the one that was lifted.
        """
        from liftcore.io.ply import read_splats

        return read_splats(self.splat_file, self.lift.metadata.settings.kernel)

    @cached_property
    def axes(self) -> Tensor:
        """[3, P] f32, the splats' places axis by axis: a box around many of them is found five times faster so."""
        return self.splats.means.T.contiguous()

    @cached_property
    def cameras(self) -> Cameras:
        """The cameras of the scene, all of them, also those that the lift left out.

        Raises:
            InvalidLift: their file moved, or is another than the one that was lifted.
        """
        from liftcore.io.cameras import read_cameras

        # Which of several models was meant, the lift knew: its digest tells that the same is read.
        return read_cameras(unchanged("cameras", self.lift.metadata.cameras, self.path), choosing=False)

    def image(self, view: str, draw: Callable[[Camera], Tensor]) -> Tensor:
        """A picture [H, W, ..] of a view in its photo's pixels, from what draws one of a pinhole (`in_photo`).

        Raises:
            NotFound: no camera has this name.
            InvalidQuery: its image is larger than pictures may be.
            InvalidLift: the cameras moved or changed since the lift.
        """
        camera = self.cameras[view]
        for width, height in (photo_size(camera), photo_size(drawn_by(camera))):
            if width * height > MOST_PIXELS:
                raise InvalidQuery(
                    "view", expected=f"an image of at most {MOST_PIXELS} pixels to draw",
                    got=f"{width}x{height} in {view!r}" + (", for its distorted photo" if camera.lens else ""),
                    hint="give the scene a camera of that pose with width, height, fx, fy, cx and cy divided alike",
                )  # fmt: skip
        return in_photo(camera, draw)

    @cached_property
    def packs(self) -> FeaturePacks:
        """The feature packs that were lifted; queries by region read a row of them.

        Raises:
            InvalidLift: a pack moved, or is another than the one that was lifted.
        """
        from liftcore.features.pack import read_features

        files = zip(self.lift.metadata.features, self._packs_at, strict=True)
        moved = [file.model_copy(update={"path": str(path)}) for file, path in files]
        return read_features(*(unchanged("features", file, self.path) for file in moved))

    def find_packs(self, paths: Sequence[Path]) -> None:
        """Say where the feature packs lie now, when they moved since the lift; in the lift's order."""
        self._packs_at = list(paths)

    @cached_property
    def raster(self) -> Raster:
        """A for this scene."""
        from liftcore.raster.cpu.raster import CpuRaster

        return CpuRaster(self.splats, threads=None)

    @property
    def walk(self) -> CompositingParams:
        """How rays walk when scores are rendered: with the lift's rendering gain (App. Tikhonov)."""
        return self.lift.metadata.settings.render_params
