"""The views of a lift: features and cameras, paired by name."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from liftcore.runtime.version import __version__
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Splats
from liftcore.values.fit import camera_of
from liftcore.values.lift import LiftMetadata, landmarks_of
from liftcore.values.lift_file import poses_of
from liftcore.values.pack import Views, as_views, pair
from liftcore.values.settings import LiftSettings
from liftcore.values.views import ViewFeatures

ViewValues = Mapping[str, ViewFeatures] | Iterable[tuple[str, ViewFeatures]]


@dataclass(frozen=True)
class LiftViews:
    """The views of a lift, features and cameras paired by name; each view is read at its access."""

    cameras: Cameras
    features: Views  # paired with the cameras
    names: tuple[str, ...]  # that are lifted, in the order of the sums
    unpaired: list[str]  # views with features and no camera, which are skipped

    @classmethod
    def of(cls, views: ViewValues, cameras: Cameras | Mapping[str, Camera], settings: LiftSettings) -> "LiftViews":
        """Pair views with cameras by name, every ``view_stride``-th of them."""
        by_name = cameras if isinstance(cameras, Cameras) else Cameras(cameras)
        features, unpaired = pair(as_views(views), by_name)
        return cls(by_name, features, features.views[:: settings.view_stride], unpaired)

    def only(self, names: Iterable[str]) -> "LiftViews":
        """Return those of these names, in their order."""
        return replace(self, names=tuple(names))

    @property
    def lifted(self) -> list[Camera]:
        """The cameras, in the order of the sums."""
        return [self.cameras[name] for name in self.names]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, number: int) -> tuple[Camera, ViewFeatures]:
        """Return the camera of the view of that number, and what it observes."""
        return self.camera(number), self.features[self.names[number]]

    def __iter__(self) -> Iterator[tuple[Camera, ViewFeatures]]:
        """Return the views, one in memory at a time."""
        return (self[number] for number in range(len(self)))

    def metadata(
        self, settings: LiftSettings, splats: Splats, diagnostics: dict[str, Any], timings: dict[str, float]
    ) -> LiftMetadata:
        """Return the metadata of a lift of these views, of any engine."""
        table = self.features.table
        return LiftMetadata(
            version=__version__,
            settings=settings,
            encoder=self.features.encoder,
            text_space=self.features.text_space,
            words=table.words if table else (),
            views=self.names,
            poses=poses_of(self.lifted),
            origin=splats.origin,
            world=splats.world.known_or(self.cameras.world),
            landmarks=landmarks_of(splats),
            diagnostics=diagnostics,
            timings=timings,
        )

    def camera(self, number: int) -> Camera:
        """Return the camera of what a view observes, by its number: of its photo, or of the part that a map shows."""
        camera = self.cameras[self.names[number]]
        return camera_of(self.features.window(self.names[number], camera), camera)
