"""Projection of splats on the device: ``cpu.project`` as tensor operations over all splats.

The arithmetic is float64 and the formulas, their order included, are those of the CPU backend. A few dozen operations
per splat need no kernel; the tensor operations run on the CPU as well, where they are tested.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from liftcore.raster.cpu.project import HALF_LOG2_E, HORIZON, MARGIN, RELATIVE, Scene, View, low_pass_curvature
from liftcore.scene.compositing import EDGE_ON, NEAR_PLANE
from liftcore.scene.splats import Kernel

# Columns of a splat that the compositing kernels read. Places [n, PLACE] f64 are used at a row's first pixel, where
# large numbers are subtracted; inks [n, INK] f32 at every pixel. A row per projected splat, near to far.
MX, MY, SLOPE, C = range(4)  # 3DGS and DBS, as in cpu.project
CENTRE_X, CENTRE_Y, S_X, S_Y, T_X, T_Y, D_ZERO, D_X, D_Y = range(9)  # 2DGS, likewise
PLACE = 9

OPACITY, UNSCALED_OPACITY, A, BETA = range(4)  # A is the low-pass's curvature for 2DGS
S_STEP, S_STEP_REST, T_STEP, T_STEP_REST, D_STEP, D_STEP_REST = range(4, 10)  # 2DGS: change of the forms per pixel
INK = 10


class DeviceScene(NamedTuple):
    """``liftcore.raster.cpu.project.Scene`` as tensors on the device, one row per splat."""

    means: Tensor  # [P, 3] f32, world
    axes: Tensor  # [P, 3, 3] f64 ([P, 3, 2] for 2DGS), scaled axes in columns, world
    opacity: Tensor  # [P] f64, sigmoid(opacity_logit_scale theta)
    unscaled_opacity: Tensor  # [P] f64, sigmoid(theta)
    cutoff: Tensor  # [P] f64, the largest e (or sigma) with a weight; negative for none
    beta: Tensor  # [P] f64, DBS only ([0] otherwise): the exponent


class Outlines(NamedTuple):
    """Outlines of projected splats for the tile lists, one row per splat, near to far; all f64."""

    mx: Tensor  # [n] the outline ``(sqrt_a (x - mx - slope dy))^2 + c dy^2 <= cutoff``, as in cpu.project
    my: Tensor
    slope: Tensor
    sqrt_a: Tensor
    c: Tensor
    cutoff: Tensor
    extent_x: Tensor
    extent_y: Tensor
    rightmost_dy: Tensor
    circle_x: Tensor  # [n] centre and radius, px, of a circle covered beside the outline; [0] for kernels without
    circle_y: Tensor
    circle: Tensor

    def at(self, rows: Tensor | slice) -> "Outlines":
        """Return some rows, in their order."""
        return Outlines(*(column[rows] if column.numel() else column for column in self))


class ProjectedSplats(NamedTuple):
    """The splats that touch the image, near to far; ties in order of their rows."""

    ids: Tensor  # [n] i32, the splat
    outlines: Outlines
    places: Tensor  # [n, PLACE] f64
    inks: Tensor  # [n, INK] f32


def scene_on(device: torch.device, scene: Scene) -> DeviceScene:
    """Copy the activated splats of the CPU backend to the device."""
    parts = (torch.from_numpy(getattr(scene, name)) for name in DeviceScene._fields)
    return DeviceScene(*(part.movedim(-1, 0).contiguous().to(device) for part in parts))


def with_opacity(scene: DeviceScene, host_scene: Scene) -> DeviceScene:
    """Return the same splats with the opacities and cut-offs of ``host_scene``."""
    device = scene.means.device
    opacity, cutoff = (torch.from_numpy(part).to(device) for part in (host_scene.opacity, host_scene.cutoff))
    return scene._replace(opacity=opacity, cutoff=cutoff)


class CameraSplats(NamedTuple):
    """Splats in front of the camera, with centres and axes in its frame."""

    first: int  # splat index of the block's first row
    rows: Tensor  # [n] i64, rows of the block
    x: Tensor  # [n] f64
    y: Tensor
    z: Tensor
    axes: Tensor  # [n, 3, K] f64, axis k in column k
    cutoff: Tensor  # [n] f64


def project(scene: DeviceScene, view: View, kernel: Kernel, antialiased: bool, at_once: int) -> ProjectedSplats:
    """Return the splats of a scene that touch the image, near to far.

    Args:
        at_once: splats per block, which bounds the memory of intermediate tensors.
    """
    parts, depths = [], []
    for first in range(0, scene.means.shape[0], at_once):
        block = DeviceScene(*(part[first : first + at_once] for part in scene))
        splats = _before_the_camera(block, view, first)
        if kernel is Kernel.GAUSSIAN_2D:
            part, z = _project_discs(block, view, splats)
        else:
            unit = 1.0 if kernel is Kernel.BETA else HALF_LOG2_E
            part, z = _project_ellipses(block, view, splats, unit, antialiased)
        parts.append(part)
        depths.append(z.to(torch.float32))
    order = torch.sort(_concatenate(depths), stable=True).indices
    outlines = Outlines(*map(_concatenate, zip(*(part.outlines for part in parts), strict=True)))
    names = "ids", "places", "inks"
    ids, places, inks = (_concatenate([getattr(part, name) for part in parts])[order] for name in names)
    return ProjectedSplats(ids, outlines.at(order), places, inks)


def _concatenate(parts: Sequence[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))


def _before_the_camera(scene: DeviceScene, view: View, first: int) -> CameraSplats:
    pose = view.pose.tolist()
    px, py, pz = scene.means.double().unbind(1)
    x, y, z = (row[0] * px + row[1] * py + row[2] * pz + row[3] for row in pose)
    rows = ((scene.cutoff >= 0) & (z >= NEAR_PLANE)).nonzero()[:, 0]
    ax, ay, az = scene.axes[rows].unbind(1)
    axes = torch.stack([row[0] * ax + row[1] * ay + row[2] * az for row in pose], dim=1)
    return CameraSplats(first, rows, x[rows], y[rows], z[rows], axes, scene.cutoff[rows])


def _project_ellipses(
    scene: DeviceScene, view: View, splats: CameraSplats, unit: float, antialiased: bool
) -> tuple[ProjectedSplats, Tensor]:
    fx, fy, cx, cy = view.intrinsics.tolist()
    left, right, top, bottom = view.limits.tolist()
    _, _, x, y, z, axes, reach = splats
    slope_x = fx * (x / z).clamp(-left, right) / z
    slope_y = fy * (y / z).clamp(-top, bottom) / z
    # L = J W R S, the projected axes: cov = L L^T + low-pass.
    u = (fx / z)[:, None] * axes[:, 0] - slope_x[:, None] * axes[:, 2]
    v = (fy / z)[:, None] * axes[:, 1] - slope_y[:, None] * axes[:, 2]
    (u0, u1, u2), (v0, v1, v2) = u.unbind(1), v.unbind(1)
    xx = view.low_pass + u0 * u0 + u1 * u1 + u2 * u2
    yy = view.low_pass + v0 * v0 + v1 * v1 + v2 * v2
    xy = u0 * v0 + u1 * v1 + u2 * v2
    minors = (u0 * v1 - v0 * u1) ** 2 + (u1 * v2 - v1 * u2) ** 2 + (u0 * v2 - v0 * u2) ** 2
    det = minors + view.low_pass * (xx + yy - view.low_pass)
    faded = torch.sqrt(minors / det) if antialiased else torch.ones_like(det)
    reach = reach + torch.log2(faded).clamp(max=0.0)  # -inf where the compensation is zero
    spread = torch.sqrt(reach.clamp(min=0.0) / unit)
    extent_x, extent_y = spread * torch.sqrt(xx), spread * torch.sqrt(yy)
    mx, my = fx * x / z + cx, fy * y / z + cy
    # The nearest pixel centres lie half a pixel inside the image.
    touches = (reach >= 0) & (mx + extent_x >= 0.5) & (mx - extent_x <= view.width - 0.5)
    touches &= (my + extent_y >= 0.5) & (my - extent_y <= view.height - 0.5)
    touching = touches.nonzero()[:, 0]
    mx, my, xx, xy, yy, det, reach, faded, extent_x, extent_y, z = (
        part[touching] for part in (mx, my, xx, xy, yy, det, reach, faded, extent_x, extent_y, z)
    )
    rows = splats.rows[touching]
    slope, a, c = xy / yy, unit * yy / det, unit / yy
    rightmost_dy = xy / xx * extent_x
    outlines = Outlines(mx, my, slope, torch.sqrt(a), c, reach, extent_x, extent_y, rightmost_dy, *_no_circles(mx))
    places = mx.new_zeros(mx.shape[0], PLACE)
    places[:, MX], places[:, MY], places[:, SLOPE], places[:, C] = mx, my, slope, c
    inks = mx.new_zeros(mx.shape[0], INK, dtype=torch.float32)
    faded = faded.clamp(max=1.0)
    inks[:, OPACITY], inks[:, UNSCALED_OPACITY], inks[:, A] = (
        faded * scene.opacity[rows],
        faded * scene.unscaled_opacity[rows],
        a,
    )
    if scene.beta.numel():
        inks[:, BETA] = scene.beta[rows]
    return ProjectedSplats((rows + splats.first).to(torch.int32), outlines, places, inks), z


_COARSE = -32  # mask of a float32's upper bits: 19 of the mantissa stay, so its product with a lane below 16 is exact


def _project_discs(scene: DeviceScene, view: View, splats: CameraSplats) -> tuple[ProjectedSplats, Tensor]:
    """Return the discs that touch the image, and their depths [n] f64, in the block's order."""
    fx, fy, cx, cy = view.intrinsics.tolist()
    curvature = low_pass_curvature(view)
    near = torch.sqrt(splats.cutoff / curvature)
    mx, my = fx * splats.x / splats.z + cx, fy * splats.y / splats.z + cy
    crossed, forms = _crossing(splats, fx, fy)
    candidates = _select_rows(crossed, _outline(splats, (mx, my), view), _circle(mx, my, near))
    candidates = candidates._replace(circle_x=mx, circle_y=my, circle=near)
    left, right = (
        torch.minimum(mx - near, candidates.mx - candidates.extent_x),
        torch.maximum(mx + near, candidates.mx + candidates.extent_x),
    )
    top, bottom = (
        torch.minimum(my - near, candidates.my - candidates.extent_y),
        torch.maximum(my + near, candidates.my + candidates.extent_y),
    )
    # The nearest pixel centres lie half a pixel inside the image.
    touches = (right >= 0.5) & (left <= view.width - 0.5) & (bottom >= 0.5) & (top <= view.height - 0.5)
    touching = touches.nonzero()[:, 0]
    outlines = candidates.at(touching)
    rows, mx, my, forms = splats.rows[touching], mx[touching], my[touching], forms[touching]
    places = mx.new_zeros(mx.shape[0], PLACE)
    places[:, CENTRE_X], places[:, CENTRE_Y] = mx, my
    places[:, [S_X, S_Y, T_X, T_Y, D_ZERO, D_X, D_Y]] = forms
    inks = mx.new_zeros(mx.shape[0], INK, dtype=torch.float32)
    inks[:, OPACITY], inks[:, UNSCALED_OPACITY], inks[:, A] = (
        scene.opacity[rows],
        scene.unscaled_opacity[rows],
        curvature,
    )
    for form, step, rest in ((0, S_STEP, S_STEP_REST), (2, T_STEP, T_STEP_REST), (5, D_STEP, D_STEP_REST)):
        inks[:, step], inks[:, rest] = _split_float(forms[:, form])
    return ProjectedSplats((rows + splats.first).to(torch.int32), outlines, places, inks), splats.z[touching]


def _split_float(values: Tensor) -> tuple[Tensor, Tensor]:
    """Split float64 values into float32 values of 19 bits and the rest."""
    coarse = (values.to(torch.float32).view(torch.int32) & _COARSE).view(torch.float32)
    return coarse, (values - coarse.double()).to(torch.float32)


def _crossing(splats: CameraSplats, fx: float, fy: float) -> tuple[Tensor, Tensor]:
    """Return the mask [n] of discs with a crossing, and the forms [n, 7]: s, t by x, y; d at the centre, by x, y."""
    centre = torch.stack([splats.x, splats.y, splats.z], dim=1)
    a, b = splats.axes[:, :, 0], splats.axes[:, :, 1]
    normal = torch.linalg.cross(a, b)
    facing = (normal * centre).sum(dim=1)
    lengths = torch.sqrt((normal * normal).sum(dim=1) * (centre * centre).sum(dim=1))
    crossed = facing.abs() > EDGE_ON * lengths
    scale = splats.z / torch.where(crossed, facing, 1.0)
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
    no_crossing = forms.new_tensor([0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0])  # d < 0 on every ray
    return crossed, torch.where(crossed[:, None], forms, no_crossing)


def _ellipse(middle: tuple[Tensor, Tensor], covariance: tuple[Tensor, Tensor, Tensor], det: Tensor) -> Outlines:
    """Return ``(p - middle)^T covariance^-1 (p - middle) <= 1``; det comes apart, at full precision."""
    xx, xy, yy = covariance
    sqrt_a, half_width = torch.sqrt(yy / det), torch.sqrt(xx)
    return Outlines(
        *middle, xy / yy, sqrt_a, 1.0 / yy, torch.ones_like(xx), half_width, torch.sqrt(yy), xy / half_width,
        *_no_circles(xx),
    )  # fmt: skip


def _no_circles(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the empty circle columns of kernels without circles."""
    return values[:0], values[:0], values[:0]


def _circle(mx: Tensor, my: Tensor, near: Tensor) -> Outlines:
    """Return the outline of the low-pass alone."""
    square = near * near + MARGIN**2
    return _ellipse((mx, my), (square, torch.zeros_like(square), square), square * square)


def _outline(splats: CameraSplats, middle: tuple[Tensor, Tensor], view: View) -> Outlines:
    """Return outlines around all pixels whose ray can cross the disc; see ``cpu.project._write_outline``."""
    fx, fy = view.intrinsics.tolist()[:2]
    z, largest = splats.z, splats.cutoff / HALF_LOG2_E
    a, b = splats.axes.unbind(2)
    u = [fx * (axis[:, 0] - splats.x / z * axis[:, 2]) for axis in (a, b)]
    v = [fy * (axis[:, 1] - splats.y / z * axis[:, 2]) for axis in (a, b)]
    w = [a[:, 2], b[:, 2]]
    clearance = z * z - largest * (w[0] * w[0] + w[1] * w[1])
    uu, vv, uv, uw, vw = (p[0] * q[0] + p[1] * q[1] for p, q in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    before = clearance > HORIZON * z * z
    g = largest / torch.where(before, clearance, 1.0)
    x0, y0 = -g * uw, -g * vw
    xx, yy = x0 * x0 + g * uu, y0 * y0 + g * vv
    minor = g * (u[0] * v[1] - u[1] * v[0])
    margin = MARGIN**2 + RELATIVE**2 * (xx + yy)
    det = minor * minor * (z * z / torch.where(before, clearance, 1.0)) + margin * (xx + yy) + margin * margin
    covariance = xx + margin, x0 * y0 + g * uv, yy + margin
    ellipse = _ellipse((middle[0] + x0, middle[1] + y0), covariance, det)
    left, right = _clip_to_side(middle[0], largest * uw, largest * uu, clearance, view.width)
    top, bottom = _clip_to_side(middle[1], largest * vw, largest * vv, clearance, view.height)
    return _select_rows(before, ellipse, _box(left, right, top, bottom))


def _box(left: Tensor, right: Tensor, top: Tensor, bottom: Tensor) -> Outlines:
    """Return the ellipse through the corners of a box: half of the cut-off per side; the extents are the box's."""
    half_x, half_y = 0.5 * (right - left), 0.5 * (bottom - top)
    zero = torch.zeros_like(left)
    sqrt_a, c = 1.0 / half_x.clamp(min=MARGIN), 1.0 / half_y.clamp(min=MARGIN) ** 2
    cutoff = torch.full_like(left, 2.0)
    return Outlines(
        left + half_x, top + half_y, zero, sqrt_a, c, cutoff, half_x, half_y, zero, *_no_circles(left)
    )  # fmt: skip


def _clip_to_side(origin: Tensor, p: Tensor, q: Tensor, clearance: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Return the clipped range of ``liftcore.raster.cpu.project._clip_to_side``."""
    square = p * p + clearance * q
    has_roots, root = square >= 0, torch.sqrt(square.clamp(min=0.0))
    high = torch.where(has_roots & (p + root > 0), q / (p + root), math.inf)
    low = torch.where(has_roots & (p - root < 0), q / (p - root), -math.inf)
    low = origin + low * (1.0 + RELATIVE) - MARGIN
    high = origin + high * (1.0 + RELATIVE) + MARGIN
    return low.clamp(min=-1.0), high.clamp(max=size + 1.0)


def _select_rows(mask: Tensor, yes: Outlines, no: Outlines) -> Outlines:
    """Select rows of ``yes`` where ``mask``, else of ``no``; neither has circles."""
    return Outlines(*(torch.where(mask, *pair) if pair[0].numel() else pair[0] for pair in zip(yes, no, strict=True)))
