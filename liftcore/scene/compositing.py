"""Parameters of compositing along rays: the field's constants, and the choices of a lift or a render.

Nothing here loads torch: settings share these values with processes that never compute.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from numbers import Real

from liftcore.errors import InvalidInput, InvalidSettings
from liftcore.runtime.one_line import one_line
from liftcore.scene.kernel import Kernel

# The constants of the field, named once. They move results at the 1e-3 level: state them with every number.
LOW_PASS = 0.3  # px^2, added to both axes of every projected covariance (3DGS; gsplat's eps2d)
NEAR_PLANE = 0.01  # scene units; a splat whose centre is nearer to the camera plane is not drawn
ALPHA_FLOOR = 1.0 / 255.0  # a smaller alpha counts as none (3DGS and 2DGS; DBS has compact support instead)
FIELD_MARGIN = 0.3  # the projection's Jacobian is clamped this share of tan(half field) outside the image
MAX_SIDE = 32_768  # pixels; larger images are a broken header, not a photo
MAX_LOG_SCALE = 60.0  # log scales are clamped to +-this, so that squares stay finite in float64
TILE = 16  # px, side of a tile
LARGEST_EXPONENT = 120.0  # a falloff below 2^-120 counts as none: float32 holds no smaller alphas
EDGE_ON = 1e-6  # sine of a disc's plane with the ray of its centre; up to this only the low-pass counts (2DGS)
LARGEST_ALPHA = 0.9999999  # a larger one may round to 1 in float32, and no transmittance would remain
MOST_OF_A_RAY = 64  # the largest k of top-k


@dataclass(frozen=True)
class CompositingParams:
    """Parameters of compositing along a ray, front to back.

    ``antialiased``: alpha at a splat's centre is ``sigmoid(scale theta) sqrt(det(cov) / det(cov + low-pass))``: the
    low-pass makes a small splat larger on the screen, and the compensation takes as much of its opacity. The scale
    acts on the logit first, the alpha floor on both together. Scenes trained so (gsplat's ``antialiased``,
    Mip-Splatting) are to be composited so.
    """

    opacity_logit_scale: float = 1.0  # lambda: alpha~ = sigmoid(lambda theta)
    alpha_cap: float = 0.99  # the largest alpha of a splat on a ray
    transmittance_stop: float = 1e-4  # exclusive: the splat that would bring T to it or below adds nothing
    antialiased: bool = False  # the mip filter's opacity compensation, 3DGS only
    stride: int = 1  # region weights sample every n-th pixel in x and in y; renders have all pixels
    offset: tuple[int, int] = (0, 0)  # the first such pixel (x, y), each below the stride

    def __post_init__(self) -> None:
        """Refuse invalid numbers.

        Raises:
            InvalidSettings: one is out of its range; the error names it.
        """
        for name, fits, expected in (
            ("opacity_logit_scale", lambda x: 0 < x < math.inf, "a finite number above 0"),
            ("alpha_cap", lambda x: 0 < x <= LARGEST_ALPHA, f"a number above 0, at most {LARGEST_ALPHA}"),
            ("transmittance_stop", lambda x: 0 <= x < 1, "a number from 0 to below 1"),
        ):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, Real) or not fits(value):
                raise InvalidSettings(name, expected=expected, got=repr(value)[:80])

    def __repr__(self) -> str:
        changed_fields = [field for field in fields(self) if getattr(self, field.name) != field.default]
        return one_line(self, *(f"{field.name}={getattr(self, field.name)!r}" for field in changed_fields))


@dataclass(frozen=True)
class Weighting:
    """The definition of a splat's weight on a ray: ``w = alpha T``, to a power."""

    power: int = 1  # 1 or 2
    top_k: int = 0  # only the k largest of a ray count, equal ones near to far (argmax lifting: 1); 0: all


def check_antialiased(kernel: Kernel, antialiased: bool) -> None:
    """Refuse the mip filter's compensation where it has no meaning."""
    if antialiased and kernel is not Kernel.GAUSSIAN_3D:
        raise InvalidSettings(
            "antialiased",
            expected="false for splats that are no 3D Gaussians",
            got=f"true with kernel {kernel}",
            hint="the opacity compensation of the mip filter is defined for 3DGS alone",
        )


def check_weighting(weighting: Weighting) -> None:
    """Refuse what is out of its range."""
    if weighting.power not in (1, 2):
        raise InvalidInput("power", expected="1 or 2", got=str(weighting.power))
    if not 0 <= weighting.top_k <= MOST_OF_A_RAY:
        raise InvalidInput("top_k", expected=f"0 to {MOST_OF_A_RAY} weights of a ray", got=str(weighting.top_k))


def every_pixel(params: CompositingParams) -> CompositingParams:
    """Return the parameters without a stride, as renderings have all pixels."""
    return replace(params, stride=1, offset=(0, 0))
