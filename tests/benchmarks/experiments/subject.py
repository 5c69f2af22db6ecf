"""The scene of an experiment: its files, and lifts of them."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liftcore.errors import InvalidInput
from liftcore.features.views import ViewFeatures
from liftcore.features.write_pack import write_pack
from liftcore.io.inria import write_inria_cameras
from liftcore.lift import lift
from liftcore.settings import LiftSettings
from tests.benchmarks.scene_files import cameras_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from liftcore.io.lift_file import LiftResult
    from liftcore.scene.cameras import Cameras
    from liftcore.scene.splats import Splats


@dataclass(frozen=True)
class Subject:
    """A scene folder: ``point_cloud.ply``, cameras and feature packs.

    ``every`` takes every n-th feature view only: an experiment in a fraction of the time, said in its document.
    """

    folder: Path
    every: int = 1

    @property
    def cameras(self) -> Path:
        """What the cameras are read from."""
        return cameras_of(self.folder)

    def pack(self, name: str) -> Path:
        """The path of a pack of the scene, by its name without extension.

        Raises:
            InvalidInput: the scene has no such pack.
        """
        path = self.folder / f"{name}.safetensors"
        if not path.is_file():
            raise InvalidInput("scene", expected=f"a folder with {path.name}", got=str(self.folder))
        return path

    def packs(self, *names: str) -> list[str]:
        """Which of these packs the scene has."""
        return [name for name in names if (self.folder / f"{name}.safetensors").is_file()]

    def lift(self, pack: str | Path, **settings: Any) -> LiftResult:
        """A lift of one pack, with a small certificate unless the settings ask for more."""
        return self._lift(self.folder / "point_cloud.ply", self.cameras, pack, settings)

    def lift_from(self, cameras: Cameras, pack: str, **settings: Any) -> LiftResult:
        """The same from other cameras."""
        with tempfile.TemporaryDirectory(prefix="splatlift-experiment-") as folder:
            path = Path(folder) / "cameras.json"
            write_inria_cameras(cameras, path)
            return self._lift(self.folder / "point_cloud.ply", path, pack, settings)

    def lift_of(self, splats: Splats, pack: str, **settings: Any) -> LiftResult:
        """The same onto other splats."""
        from liftcore.io.ply import write_splats

        with tempfile.TemporaryDirectory(prefix="splatlift-experiment-") as folder:
            path = Path(folder) / "splats.ply"
            write_splats(splats, path)
            return self._lift(path, self.cameras, pack, settings)

    def lift_seeing(self, observations: Mapping[str, ViewFeatures], **settings: Any) -> LiftResult:
        """The same with other observations."""
        with tempfile.TemporaryDirectory(prefix="splatlift-experiment-") as folder:
            path = Path(folder) / "features.safetensors"
            write_pack(path, observations, {"normalised": "true"})
            return self.lift(path, **settings)

    def _lift(self, splats: Path, cameras: Path, pack: str | Path, settings: dict[str, Any]) -> LiftResult:
        path = self.pack(pack) if isinstance(pack, str) else pack
        chosen = LiftSettings.of(**{"certificate_rays": 0, "view_stride": self.every, **settings})
        return lift(splats, cameras, [path], chosen)
