"""Direction of up in a scene, and length of its unit, as far as they are known.

Splats and COLMAP's models have neither. glTF and USD have both, nerfstudio's frames the up axis; users can set it
(``--up``, ``--metres-per-unit``). Nothing is estimated. Without it sizes and distances are
in scene units, and no object is on another.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, ConfigDict, Field
from pydantic_core import PydanticCustomError

from liftcore.errors import InvalidInput
from liftcore.runtime.fields import Body, NoBoolean

if TYPE_CHECKING:
    import numpy as np

    from liftcore.scene.similarity import Similarity

LARGEST = 1e12  # metres of a unit, and coordinates
Number = Annotated[float, NoBoolean]
Positive = Annotated[float, Field(ge=1 / LARGEST, le=LARGEST), NoBoolean]
Point = tuple[Number, Number, Number]  # x y z, frame of the splats


def _direction(direction: Point) -> Point:
    length = math.hypot(*direction)
    if not 1 / LARGEST <= length <= LARGEST:
        expected = "a direction x y z, finite and not zero"
        raise PydanticCustomError("world", "{expected}", {"expected": expected})
    x, y, z = (axis / length + 0.0 for axis in direction)  # 0.0 of -0.0
    return x, y, z


class WorldFrame(Body):
    """Direction of up and length of a unit in the frame of some splats; null is not known."""

    model_config = ConfigDict(frozen=True)
    error_type: ClassVar = InvalidInput

    up: Annotated[Point, AfterValidator(_direction)] | None = Field(
        default=None, description="the direction against gravity, in the frame of the splats"
    )
    metres_per_unit: Positive | None = Field(default=None, description="the length of a scene unit")

    @property
    def unit(self) -> Literal["metres", "scene units"]:
        """Unit of reported lengths."""
        return "scene units" if self.metres_per_unit is None else "metres"

    def length(self, value: float) -> float:
        """Convert a length in scene units to `unit`."""
        return value * (self.metres_per_unit or 1.0)

    def known_or(self, other: WorldFrame) -> WorldFrame:
        """Return the values known here, else those of the other."""
        values = {name: value for name, value in self if value is not None}
        return other.model_copy(update=values)

    def transformed(self, move: Similarity) -> WorldFrame:
        """Return the frame of a scene that was transformed."""
        up = None if self.up is None else tuple((move.rotation @ self.up).tolist())
        metres = None if self.metres_per_unit is None else self.metres_per_unit / move.scale
        return WorldFrame(up=up, metres_per_unit=metres)

    def upright(self, axes: np.ndarray) -> np.ndarray:
        """Return [4] f64, w x y z: the shortest turn that brings up to +Y in a frame; none where it is not known.

        Args:
            axes: [3, 3], a rotation of the frame of the splats to that frame.
        """
        import numpy as np

        x, y, z = (0.0, 1.0, 0.0) if self.up is None else (axes @ self.up).tolist()
        if y < 1e-9 - 1:  # upside down: half a turn about z
            return np.array([0.0, 0.0, 0.0, 1.0])
        turn = np.array([1 + y, -z, 0.0, x])  # 1 + a.b and a x b of the half way between a and b
        return turn / np.linalg.norm(turn)

    def placement(self, axes: np.ndarray, *, in_metres: bool) -> np.ndarray:
        """Return the transform [4, 4] f64 of a frame (`upright`) to +Y up, and to metres if they are known."""
        import numpy as np

        from liftcore.scene.quaternions import rotation_matrices

        matrix = np.eye(4)
        matrix[:3, :3] = rotation_matrices(self.upright(axes)) * (self.length(1.0) if in_metres else 1.0)
        return matrix


UNKNOWN = WorldFrame()
UPRIGHT = WorldFrame(up=(0.0, -1.0, 0.0))  # of splats in the frame of PLYs that come from one with +Y up


def world_of(entry: Any) -> WorldFrame:
    """Parse the frame stored in a file of ours; unknown if it is invalid."""
    try:
        return WorldFrame.model_validate(entry if isinstance(entry, dict) else {})
    except InvalidInput:
        return UNKNOWN
