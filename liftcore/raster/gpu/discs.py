"""Discs to footprints on the device: ``liftcore.raster.cpu.project``, written for all discs at once."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from liftcore.raster.base import EDGE_ON, LOW_PASS
from liftcore.raster.cpu.project import HALF_LOG2_E
from liftcore.raster.gpu.scene import (
    CENTRE_X,
    CENTRE_Y,
    D_STEP,
    D_STEP_REST,
    D_X,
    D_Y,
    D_ZERO,
    INK,
    KX,
    OPACITY,
    PLACE,
    PLAIN,
    S_STEP,
    S_STEP_REST,
    S_X,
    S_Y,
    T_STEP,
    T_STEP_REST,
    T_X,
    T_Y,
    Footprints,
    Outlines,
)

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.raster.cpu.project import View
    from liftcore.raster.gpu.projection import Seen
    from liftcore.raster.gpu.scene import Block

_MARGIN = 1e-3  # px that an outline is wider than the crossings, for float32 at its edge
_RELATIVE = 1e-4  # and this share of its size
_HORIZON = 1e-9  # a disc that comes this near to the camera's plane, in its depth squared, has a box for an outline
_COARSE = -32  # a float32 without its last five bits: 19 are left, so its product with a lane below 16 is exact

Ellipse = tuple["Tensor", "Tensor", "Tensor", "Tensor", "Tensor", "Tensor", "Tensor", "Tensor", "Tensor"]
"""mx, my, slope, root_x, ky, reach, extent_x, extent_y, lean: the outline of ``Outlines``."""


def project_discs(block: Block, view: View, seen: Seen) -> tuple[Footprints, Tensor]:
    """The footprints of the discs that touch the image, and their depths [n] f64, in the block's order."""
    fx, fy, cx, cy = view.intrinsics.tolist()
    curvature = 2.0 * HALF_LOG2_E * LOW_PASS / view.low_pass  # of exp(-g / 2), g = 2 |p - mu|^2 in full pixels
    near = torch.sqrt(seen.cutoff / curvature)
    mx, my = fx * seen.x / seen.z + cx, fy * seen.y / seen.z + cy
    crossed, forms = _crossing(seen, fx, fy)
    ellipse = _chosen(crossed, _outline(seen, (mx, my), view), _circle(mx, my, near))
    left, right = torch.minimum(mx - near, ellipse[0] - ellipse[6]), torch.maximum(mx + near, ellipse[0] + ellipse[6])
    top, bottom = torch.minimum(my - near, ellipse[1] - ellipse[7]), torch.maximum(my + near, ellipse[1] + ellipse[7])
    # The nearest pixel centres lie half a pixel inside the image.
    touches = (right >= 0.5) & (left <= view.width - 0.5) & (bottom >= 0.5) & (top <= view.height - 0.5)
    kept = touches.nonzero()[:, 0]
    outlines = Outlines(*ellipse, mx, my, near).at(kept)
    rows, mx, my, forms = seen.rows[kept], mx[kept], my[kept], forms[kept]
    places = mx.new_zeros(mx.shape[0], PLACE)
    places[:, CENTRE_X], places[:, CENTRE_Y] = mx, my
    places[:, [S_X, S_Y, T_X, T_Y, D_ZERO, D_X, D_Y]] = forms
    inks = mx.new_zeros(mx.shape[0], INK, dtype=torch.float32)
    inks[:, OPACITY], inks[:, PLAIN], inks[:, KX] = block.scene.opacity[rows], block.scene.plain[rows], curvature
    for form, step, rest in ((0, S_STEP, S_STEP_REST), (2, T_STEP, T_STEP_REST), (5, D_STEP, D_STEP_REST)):
        inks[:, step], inks[:, rest] = _halved(forms[:, form])
    return Footprints(block.ids[rows].to(torch.int32), outlines, places, inks), seen.z[kept]


def _halved(values: Tensor) -> tuple[Tensor, Tensor]:
    """A float64 as a float32 of 19 bits and the rest of it."""
    coarse = (values.to(torch.float32).view(torch.int32) & _COARSE).view(torch.float32)
    return coarse, (values - coarse.double()).to(torch.float32)


def _crossing(seen: Seen, fx: float, fy: float) -> tuple[Tensor, Tensor]:
    """Whether there is a crossing [n], and the forms [n, 7]: s, t by x and y; d at the centre, by x and y."""
    centre = torch.stack([seen.x, seen.y, seen.z], dim=1)
    a, b = seen.axes[:, :, 0], seen.axes[:, :, 1]
    normal = torch.linalg.cross(a, b)
    facing = (normal * centre).sum(dim=1)
    lengths = torch.sqrt((normal * normal).sum(dim=1) * (centre * centre).sum(dim=1))
    crossed = facing.abs() > EDGE_ON * lengths
    scale = seen.z / torch.where(crossed, facing, 1.0)
    unit = scale * math.sqrt(HALF_LOG2_E)
    along_a, along_b = torch.linalg.cross(b, centre), torch.linalg.cross(centre, a)
    forms = torch.stack(
        [
            unit * along_a[:, 0] / fx, unit * along_a[:, 1] / fy,
            unit * along_b[:, 0] / fx, unit * along_b[:, 1] / fy,
            torch.ones_like(scale), scale * normal[:, 0] / fx, scale * normal[:, 1] / fy,
        ],
        dim=1,
    )  # fmt: skip
    nowhere = forms.new_tensor([0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0])  # d < 0 on every ray
    return crossed, torch.where(crossed[:, None], forms, nowhere)


def _ellipse(middle: tuple[Tensor, Tensor], covariance: tuple[Tensor, Tensor, Tensor], det: Tensor) -> Ellipse:
    """``(p - middle)^T covariance^-1 (p - middle) <= 1``; the determinant has digits of its own."""
    xx, xy, yy = covariance
    slope, root_x, ky = xy / yy, torch.sqrt(yy / det), 1.0 / yy
    half_width = torch.sqrt(xx)
    return *middle, slope, root_x, ky, torch.ones_like(xx), half_width, torch.sqrt(yy), xy / half_width


def _circle(mx: Tensor, my: Tensor, near: Tensor) -> Ellipse:
    """The low-pass alone."""
    square = near * near + _MARGIN**2
    return _ellipse((mx, my), (square, torch.zeros_like(square), square), square * square)


def _outline(seen: Seen, middle: tuple[Tensor, Tensor], view: View) -> Ellipse:
    """All pixels whose ray can cross the disc; see ``liftcore.raster.cpu.project._write_outline``."""
    fx, fy = view.intrinsics.tolist()[:2]
    z, largest = seen.z, seen.cutoff / HALF_LOG2_E
    a, b = seen.axes.unbind(2)
    u = [fx * (axis[:, 0] - seen.x / z * axis[:, 2]) for axis in (a, b)]
    v = [fy * (axis[:, 1] - seen.y / z * axis[:, 2]) for axis in (a, b)]
    w = [a[:, 2], b[:, 2]]
    room = z * z - largest * (w[0] * w[0] + w[1] * w[1])
    uu, vv, uv, uw, vw = (p[0] * q[0] + p[1] * q[1] for p, q in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    before = room > _HORIZON * z * z
    g = largest / torch.where(before, room, 1.0)
    x0, y0 = -g * uw, -g * vw
    xx, yy = x0 * x0 + g * uu, y0 * y0 + g * vv
    minor = g * (u[0] * v[1] - u[1] * v[0])
    margin = _MARGIN**2 + _RELATIVE**2 * (xx + yy)
    det = minor * minor * (z * z / torch.where(before, room, 1.0)) + margin * (xx + yy) + margin * margin
    covariance = xx + margin, x0 * y0 + g * uv, yy + margin
    ellipse = _ellipse((middle[0] + x0, middle[1] + y0), covariance, det)
    left, right = _reached(middle[0], largest * uw, largest * uu, room, view.width)
    top, bottom = _reached(middle[1], largest * vw, largest * vv, room, view.height)
    return _chosen(before, ellipse, _box(left, right, top, bottom))


def _box(left: Tensor, right: Tensor, top: Tensor, bottom: Tensor) -> Ellipse:
    """Half of the reach for each side: the ellipse through the corners, of which the tiles know the sides."""
    half_x, half_y = 0.5 * (right - left), 0.5 * (bottom - top)
    zero = torch.zeros_like(left)
    root_x, ky = 1.0 / half_x.clamp(min=_MARGIN), 1.0 / half_y.clamp(min=_MARGIN) ** 2
    return left + half_x, top + half_y, zero, root_x, ky, torch.full_like(left, 2.0), half_x, half_y, zero


def _reached(origin: Tensor, p: Tensor, q: Tensor, room: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """See ``liftcore.raster.cpu.project._reached``."""
    square = p * p + room * q
    met, root = square >= 0, torch.sqrt(square.clamp(min=0.0))
    high = torch.where(met & (p + root > 0), q / (p + root), math.inf)
    low = torch.where(met & (p - root < 0), q / (p - root), -math.inf)
    low = origin + low * (1.0 + _RELATIVE) - _MARGIN
    high = origin + high * (1.0 + _RELATIVE) + _MARGIN
    return low.clamp(min=-1.0), high.clamp(max=size + 1.0)


def _chosen(mask: Tensor, yes: Ellipse, no: Ellipse) -> Ellipse:
    first, second, third, fourth, fifth, sixth, seventh, eighth, ninth = (
        torch.where(mask, own, other) for own, other in zip(yes, no, strict=True)
    )
    return first, second, third, fourth, fifth, sixth, seventh, eighth, ninth
