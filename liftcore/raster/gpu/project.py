"""Splats to projected splats on the device: ``cpu.project``, written for all splats at once.

The arithmetic is float64 and the formulas, their order included, are those of the CPU backend. It is a few dozen
operations a splat, so plain tensor operations serve; they run on the CPU as well, which is how they are tested.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from liftcore.raster.cpu.project import HALF_LOG2_E, HORIZON, MARGIN, RELATIVE, Scene, View, low_pass_curvature
from liftcore.scene.compositing import EDGE_ON, NEAR_PLANE
from liftcore.scene.splats import Kernel

# What the walk reads of a splat. PLACES [n, PLACE] f64 holds what is taken at a row's first pixel, where large
# numbers are subtracted; INKS [n, INK] f32 what every pixel needs. A row a splat that the view may see, near to far.
MX, MY, SLOPE, KY = range(4)  # 3DGS and DBS, as in cpu.project
CENTRE_X, CENTRE_Y, S_X, S_Y, T_X, T_Y, D_ZERO, D_X, D_Y = range(9)  # 2DGS, likewise
PLACE = 9

OPACITY, PLAIN, KX, BETA = range(4)  # KX is the low-pass's curvature for 2DGS
S_STEP, S_STEP_REST, T_STEP, T_STEP_REST, D_STEP, D_STEP_REST = range(4, 10)  # 2DGS: forms by pixel
INK = 10


class DeviceScene(NamedTuple):
    """``liftcore.raster.cpu.project.Scene`` as tensors, a row a splat, on the device."""

    means: Tensor  # [P, 3] f32, world
    axes: Tensor  # [P, 3, 3] f64 ([P, 3, 2] for 2DGS), scaled axes in columns, world
    opacity: Tensor  # [P] f64, with the gain
    plain: Tensor  # [P] f64, without it
    cutoff: Tensor  # [P] f64, the largest e (or sigma) with a weight; negative for none
    beta: Tensor  # [P] f64, DBS only ([0] otherwise): the exponent


class Outlines(NamedTuple):
    """What the tile lists need of the projected splats, a row a splat, near to far; all f64."""

    mx: Tensor  # [n] the outline ``(root_x (x - mx - slope dy))^2 + ky dy^2 <= cutoff``, as in cpu.project
    my: Tensor
    slope: Tensor
    root_x: Tensor
    ky: Tensor
    cutoff: Tensor
    extent_x: Tensor
    extent_y: Tensor
    lean: Tensor
    circle_x: Tensor  # [n] centre and radius, px, of what is reached beside the outline ([0] where a kernel has none)
    circle_y: Tensor
    circle: Tensor

    def at(self, rows: Tensor | slice) -> "Outlines":
        """Some rows, in their order."""
        return Outlines(*(column[rows] if column.numel() else column for column in self))


class ProjectedSplats(NamedTuple):
    """The splats that touch the image, near to far; ties in the order of the file."""

    ids: Tensor  # [n] i32, the splat
    outlines: Outlines
    places: Tensor  # [n, PLACE] f64
    inks: Tensor  # [n, INK] f32


def scene_on(device: torch.device, scene: Scene) -> DeviceScene:
    """The activated splats, moved: the numbers are those of the CPU backend."""
    parts = (torch.from_numpy(getattr(scene, name)) for name in DeviceScene._fields)
    return DeviceScene(*(part.movedim(-1, 0).contiguous().to(device) for part in parts))


def with_opacity(scene: DeviceScene, changed: Scene) -> DeviceScene:
    """The same splats with the opacities and reaches of ``changed``."""
    device = scene.means.device
    opacity, cutoff = (torch.from_numpy(part).to(device) for part in (changed.opacity, changed.cutoff))
    return scene._replace(opacity=opacity, cutoff=cutoff)


class Seen(NamedTuple):
    """Splats before the camera, their centres and axes in its frame."""

    first: int  # the splat that their block begins with
    rows: Tensor  # [n] i64, of the block
    x: Tensor  # [n] f64
    y: Tensor
    z: Tensor
    axes: Tensor  # [n, 3, K] f64, axis k in column k
    cutoff: Tensor  # [n] f64


def project(scene: DeviceScene, view: View, kernel: Kernel, antialiased: bool, at_once: int) -> ProjectedSplats:
    """The splats of a scene that touch the image, near to far.

    Args:
        at_once: splats: bounds the memory of what lies between a splat and its projection.
    """
    parts, depths = [], []
    for first in range(0, scene.means.shape[0], at_once):
        block = DeviceScene(*(part[first : first + at_once] for part in scene))
        seen = _before_the_camera(block, view, first)
        if kernel is Kernel.GAUSSIAN_2D:
            part, z = _project_discs(block, view, seen)
        else:
            unit = 1.0 if kernel is Kernel.BETA else HALF_LOG2_E
            part, z = _project_ellipses(block, view, seen, unit, antialiased)
        parts.append(part)
        depths.append(z.to(torch.float32))
    order = torch.sort(_joined(depths), stable=True).indices
    outlines = Outlines(*map(_joined, zip(*(part.outlines for part in parts), strict=True)))
    names = "ids", "places", "inks"
    ids, places, inks = (_joined([getattr(part, name) for part in parts])[order] for name in names)
    return ProjectedSplats(ids, outlines.at(order), places, inks)


def _joined(parts: Sequence[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))


def _before_the_camera(scene: DeviceScene, view: View, first: int) -> Seen:
    pose = view.pose.tolist()
    px, py, pz = scene.means.double().unbind(1)
    x, y, z = (own[0] * px + own[1] * py + own[2] * pz + own[3] for own in pose)
    kept = ((scene.cutoff >= 0) & (z >= NEAR_PLANE)).nonzero()[:, 0]
    ax, ay, az = scene.axes[kept].unbind(1)
    axes = torch.stack([own[0] * ax + own[1] * ay + own[2] * az for own in pose], dim=1)
    return Seen(first, kept, x[kept], y[kept], z[kept], axes, scene.cutoff[kept])


def _project_ellipses(
    scene: DeviceScene, view: View, seen: Seen, unit: float, antialiased: bool
) -> tuple[ProjectedSplats, Tensor]:
    fx, fy, cx, cy = view.intrinsics.tolist()
    left, right, top, bottom = view.limits.tolist()
    _, _, x, y, z, axes, reach = seen
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
    reach = reach + torch.log2(faded).clamp(max=0.0)  # -inf where nothing is left
    spread = torch.sqrt(reach.clamp(min=0.0) / unit)
    extent_x, extent_y = spread * torch.sqrt(xx), spread * torch.sqrt(yy)
    mx, my = fx * x / z + cx, fy * y / z + cy
    # The nearest pixel centres lie half a pixel inside the image.
    touches = (reach >= 0) & (mx + extent_x >= 0.5) & (mx - extent_x <= view.width - 0.5)
    touches &= (my + extent_y >= 0.5) & (my - extent_y <= view.height - 0.5)
    kept = touches.nonzero()[:, 0]
    mx, my, xx, xy, yy, det, reach, faded, extent_x, extent_y, z = (
        part[kept] for part in (mx, my, xx, xy, yy, det, reach, faded, extent_x, extent_y, z)
    )
    rows = seen.rows[kept]
    slope, kx, ky = xy / yy, unit * yy / det, unit / yy
    lean = xy / xx * extent_x
    outlines = Outlines(mx, my, slope, torch.sqrt(kx), ky, reach, extent_x, extent_y, lean, *_no_circles(mx))
    places = mx.new_zeros(mx.shape[0], PLACE)
    places[:, MX], places[:, MY], places[:, SLOPE], places[:, KY] = mx, my, slope, ky
    inks = mx.new_zeros(mx.shape[0], INK, dtype=torch.float32)
    faded = faded.clamp(max=1.0)
    inks[:, OPACITY], inks[:, PLAIN], inks[:, KX] = faded * scene.opacity[rows], faded * scene.plain[rows], kx
    if scene.beta.numel():
        inks[:, BETA] = scene.beta[rows]
    return ProjectedSplats((rows + seen.first).to(torch.int32), outlines, places, inks), z


_COARSE = -32  # a float32 without its last five bits: 19 are left, so its product with a lane below 16 is exact


def _project_discs(scene: DeviceScene, view: View, seen: Seen) -> tuple[ProjectedSplats, Tensor]:
    """The discs that touch the image, and their depths [n] f64, in the block's order."""
    fx, fy, cx, cy = view.intrinsics.tolist()
    curvature = low_pass_curvature(view)
    near = torch.sqrt(seen.cutoff / curvature)
    mx, my = fx * seen.x / seen.z + cx, fy * seen.y / seen.z + cy
    crossed, forms = _crossing(seen, fx, fy)
    own = _chosen(crossed, _outline(seen, (mx, my), view), _circle(mx, my, near))
    own = own._replace(circle_x=mx, circle_y=my, circle=near)
    left, right = torch.minimum(mx - near, own.mx - own.extent_x), torch.maximum(mx + near, own.mx + own.extent_x)
    top, bottom = torch.minimum(my - near, own.my - own.extent_y), torch.maximum(my + near, own.my + own.extent_y)
    # The nearest pixel centres lie half a pixel inside the image.
    touches = (right >= 0.5) & (left <= view.width - 0.5) & (bottom >= 0.5) & (top <= view.height - 0.5)
    kept = touches.nonzero()[:, 0]
    outlines = own.at(kept)
    rows, mx, my, forms = seen.rows[kept], mx[kept], my[kept], forms[kept]
    places = mx.new_zeros(mx.shape[0], PLACE)
    places[:, CENTRE_X], places[:, CENTRE_Y] = mx, my
    places[:, [S_X, S_Y, T_X, T_Y, D_ZERO, D_X, D_Y]] = forms
    inks = mx.new_zeros(mx.shape[0], INK, dtype=torch.float32)
    inks[:, OPACITY], inks[:, PLAIN], inks[:, KX] = scene.opacity[rows], scene.plain[rows], curvature
    for form, step, rest in ((0, S_STEP, S_STEP_REST), (2, T_STEP, T_STEP_REST), (5, D_STEP, D_STEP_REST)):
        inks[:, step], inks[:, rest] = _halved(forms[:, form])
    return ProjectedSplats((rows + seen.first).to(torch.int32), outlines, places, inks), seen.z[kept]


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


def _ellipse(middle: tuple[Tensor, Tensor], covariance: tuple[Tensor, Tensor, Tensor], det: Tensor) -> Outlines:
    """``(p - middle)^T covariance^-1 (p - middle) <= 1``; the determinant has digits of its own."""
    xx, xy, yy = covariance
    root_x, half_width = torch.sqrt(yy / det), torch.sqrt(xx)
    return Outlines(
        *middle, xy / yy, root_x, 1.0 / yy, torch.ones_like(xx), half_width, torch.sqrt(yy), xy / half_width,
        *_no_circles(xx),
    )  # fmt: skip


def _no_circles(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The circles of outlines that reach nothing beside them."""
    return values[:0], values[:0], values[:0]


def _circle(mx: Tensor, my: Tensor, near: Tensor) -> Outlines:
    """The low-pass alone."""
    square = near * near + MARGIN**2
    return _ellipse((mx, my), (square, torch.zeros_like(square), square), square * square)


def _outline(seen: Seen, middle: tuple[Tensor, Tensor], view: View) -> Outlines:
    """All pixels whose ray can cross the disc; see ``liftcore.raster.cpu.project._write_outline``."""
    fx, fy = view.intrinsics.tolist()[:2]
    z, largest = seen.z, seen.cutoff / HALF_LOG2_E
    a, b = seen.axes.unbind(2)
    u = [fx * (axis[:, 0] - seen.x / z * axis[:, 2]) for axis in (a, b)]
    v = [fy * (axis[:, 1] - seen.y / z * axis[:, 2]) for axis in (a, b)]
    w = [a[:, 2], b[:, 2]]
    room = z * z - largest * (w[0] * w[0] + w[1] * w[1])
    uu, vv, uv, uw, vw = (p[0] * q[0] + p[1] * q[1] for p, q in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    before = room > HORIZON * z * z
    g = largest / torch.where(before, room, 1.0)
    x0, y0 = -g * uw, -g * vw
    xx, yy = x0 * x0 + g * uu, y0 * y0 + g * vv
    minor = g * (u[0] * v[1] - u[1] * v[0])
    margin = MARGIN**2 + RELATIVE**2 * (xx + yy)
    det = minor * minor * (z * z / torch.where(before, room, 1.0)) + margin * (xx + yy) + margin * margin
    covariance = xx + margin, x0 * y0 + g * uv, yy + margin
    ellipse = _ellipse((middle[0] + x0, middle[1] + y0), covariance, det)
    left, right = _reached(middle[0], largest * uw, largest * uu, room, view.width)
    top, bottom = _reached(middle[1], largest * vw, largest * vv, room, view.height)
    return _chosen(before, ellipse, _box(left, right, top, bottom))


def _box(left: Tensor, right: Tensor, top: Tensor, bottom: Tensor) -> Outlines:
    """Half of the reach for each side: the ellipse through the corners, of which the tiles know the sides."""
    half_x, half_y = 0.5 * (right - left), 0.5 * (bottom - top)
    zero = torch.zeros_like(left)
    root_x, ky = 1.0 / half_x.clamp(min=MARGIN), 1.0 / half_y.clamp(min=MARGIN) ** 2
    cutoff = torch.full_like(left, 2.0)
    return Outlines(
        left + half_x, top + half_y, zero, root_x, ky, cutoff, half_x, half_y, zero, *_no_circles(left)
    )  # fmt: skip


def _reached(origin: Tensor, p: Tensor, q: Tensor, room: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """See ``liftcore.raster.cpu.project._reached``."""
    square = p * p + room * q
    met, root = square >= 0, torch.sqrt(square.clamp(min=0.0))
    high = torch.where(met & (p + root > 0), q / (p + root), math.inf)
    low = torch.where(met & (p - root < 0), q / (p - root), -math.inf)
    low = origin + low * (1.0 + RELATIVE) - MARGIN
    high = origin + high * (1.0 + RELATIVE) + MARGIN
    return low.clamp(min=-1.0), high.clamp(max=size + 1.0)


def _chosen(mask: Tensor, yes: Outlines, no: Outlines) -> Outlines:
    """Row by row, of two that have no circles."""
    return Outlines(*(torch.where(mask, *pair) if pair[0].numel() else pair[0] for pair in zip(yes, no, strict=True)))
