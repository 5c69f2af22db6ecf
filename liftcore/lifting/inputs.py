"""The inputs of a lift: checked, and features paired with cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from liftcore.raster import check_splats_and_threads
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Splats
from liftcore.solve.clusters import require_hdbscan
from liftcore.values.lift_views import LiftViews, ViewValues
from liftcore.values.pack import Views, as_views
from liftcore.values.settings import LiftSettings, Preset


@dataclass(frozen=True)
class LiftInputs:
    """Splats, views and settings that fit each other."""

    splats: Splats
    source_views: Views  # as the caller passed them
    views: LiftViews  # paired with cameras
    settings: LiftSettings

    @classmethod
    def of(
        cls,
        splats: Splats,
        cameras: Cameras | Mapping[str, Camera],
        views: ViewValues,
        preset: Preset | str | LiftSettings,
        settings: Mapping[str, Any] = MappingProxyType({}),
        threads: int | None = None,
    ) -> LiftInputs:
        """Check the arguments of `liftcore.lift`, and raise as it does."""
        lift_settings = LiftSettings.from_preset(preset, settings)
        splats = check_splats_and_threads(splats, threads)
        lift_settings, source_views = lift_settings.for_splats(splats), as_views(views)
        lifted = LiftViews.of(source_views, cameras, lift_settings)
        if lift_settings.aggregation:
            require_hdbscan()
        return cls(splats, source_views, lifted, lift_settings)
