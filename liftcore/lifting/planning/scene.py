"""What every plan says of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from liftcore.scene.cameras import Camera, Cameras, distortion_warning
from liftcore.scene.render_mode import rendering_reason, rendering_warnings
from liftcore.scene.splats import Splats
from liftcore.values.settings import LiftSettings


@dataclass(frozen=True)
class PlannedScene:
    """How many splats there are, and how rays meet them."""

    kernel: str
    antialiased: bool  # opacities are compensated for the low-pass
    rendering: str  # why: what says so, or who
    splats: int  # P

    @property
    def rendered(self) -> str:
        """The kernel and the rendering, for people."""
        return f"{self.kernel}, antialiased: {self.rendering}" if self.antialiased else self.kernel


def first_names(names: Sequence[str], most: int | None) -> str:
    """So many of the names, for people; None for all."""
    return ", ".join(names[:most]) + (", ..." if most is not None and len(names) > most else "")


def planned_scene(splats: Splats, settings: LiftSettings) -> PlannedScene:
    """Of these splats, as a lift with the settings has them."""
    antialiased = settings.lift_params.antialiased
    return PlannedScene(
        str(splats.kernel), antialiased, rendering_reason(splats.render_mode, antialiased), splats.count
    )


def scene_warnings(
    splats: Splats, cameras: Cameras, views: Sequence[Camera], settings: LiftSettings
) -> tuple[str, ...]:
    """Warnings of splats and cameras, and of lenses of the views among these."""
    rendering = rendering_warnings(splats.render_mode, settings.lift_params.antialiased, splats.kernel)
    return *splats.warnings, *rendering, *cameras.warnings, *distortion_warning(views)
