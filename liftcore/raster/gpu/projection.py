"""Splats to footprints on the device: ``liftcore.raster.cpu.project``, written for all splats at once.

The arithmetic is float64 and the formulas, their order included, are those of the CPU backend. It is a few dozen
operations a splat, so plain tensor operations serve; they run on the CPU as well, which is how they are tested.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch

from liftcore.raster.base import NEAR_PLANE
from liftcore.raster.cpu.project import HALF_LOG2_E
from liftcore.raster.gpu.discs import project_discs
from liftcore.raster.gpu.scene import (
    BETA,
    INK,
    KX,
    KY,
    MX,
    MY,
    OPACITY,
    PLACE,
    PLAIN,
    SLOPE,
    Footprints,
    Outlines,
    block_of,
)
from liftcore.scene.splats import Kernel

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.raster.cpu.project import View
    from liftcore.raster.gpu.scene import Block, DeviceScene


class Projection(NamedTuple):
    """How a view projects the splats of a scene."""

    scene: DeviceScene  # on the device, or on the host, from where it comes in blocks
    view: View
    kernel: Kernel
    antialiased: bool
    device: torch.device
    at_once: int  # splats: bounds the memory of what lies between a splat and its footprint


class Seen(NamedTuple):
    """Splats before the camera, their centres and axes in its frame."""

    rows: Tensor  # [n] i64, of their block
    x: Tensor  # [n] f64
    y: Tensor
    z: Tensor
    axes: Tensor  # [n, 3, K] f64, axis k in column k
    cutoff: Tensor  # [n] f64


def footprints_of(projection: Projection, rows: slice | Tensor) -> tuple[Footprints, Tensor]:
    """The footprints of the splats among ``rows`` that touch the image, in their order, and their depths [n] f32."""
    block = block_of(projection.scene, rows, projection.device)
    seen = _before_the_camera(block, projection.view)
    if projection.kernel is Kernel.GAUSSIAN_2D:
        part, z = project_discs(block, projection.view, seen)
    else:
        unit = 1.0 if projection.kernel is Kernel.BETA else HALF_LOG2_E
        part, z = _project_ellipses(block, projection.view, seen, unit, projection.antialiased)
    return part, z.to(torch.float32)


def project(projection: Projection) -> Footprints:
    """The footprints of all splats that touch the image, near to far."""
    parts, depths = [], []
    for rows in blocks(projection.scene.means.shape[0], projection.at_once):
        part, z = footprints_of(projection, rows)
        parts.append(part)
        depths.append(z)
    order = torch.sort(torch.cat(depths), stable=True).indices
    return _joined(parts, order)


def project_again(projection: Projection, ids: Tensor) -> Footprints:
    """The footprints of splats [n] i32 that are known to touch the image, in their order."""
    every = blocks(ids.shape[0], projection.at_once)
    return _joined([footprints_of(projection, ids[rows])[0] for rows in every], None)


def blocks(count: int, at_once: int) -> list[slice]:
    """``count`` rows in runs, at least one of them."""
    return [slice(first, first + at_once) for first in range(0, max(count, 1), at_once)]


def _joined(parts: list[Footprints], order: Tensor | None) -> Footprints:
    columns = [torch.cat(column) for column in zip(*(part.outlines for part in parts), strict=True)]
    rest = [torch.cat([getattr(part, name) for part in parts]) for name in ("ids", "places", "inks")]
    outlines = Outlines(*columns)
    if order is None:
        return Footprints(rest[0], outlines, rest[1], rest[2])
    return Footprints(rest[0][order], outlines.at(order), rest[1][order], rest[2][order])


def _before_the_camera(block: Block, view: View) -> Seen:
    pose, scene = view.pose.tolist(), block.scene
    px, py, pz = scene.means.double().unbind(1)
    x, y, z = (own[0] * px + own[1] * py + own[2] * pz + own[3] for own in pose)
    kept = ((scene.cutoff >= 0) & (z >= NEAR_PLANE)).nonzero()[:, 0]
    ax, ay, az = scene.axes[kept].unbind(1)
    axes = torch.stack([own[0] * ax + own[1] * ay + own[2] * az for own in pose], dim=1)
    return Seen(kept, x[kept], y[kept], z[kept], axes, scene.cutoff[kept])


def _project_ellipses(
    block: Block, view: View, seen: Seen, unit: float, antialiased: bool
) -> tuple[Footprints, Tensor]:
    scene = block.scene
    fx, fy, cx, cy = view.intrinsics.tolist()
    left, right, top, bottom = view.limits.tolist()
    _, x, y, z, axes, reach = seen
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
    none = mx[:0]
    outlines = Outlines(
        mx, my, slope, torch.sqrt(kx), ky, reach, extent_x, extent_y, xy / xx * extent_x, none, none, none
    )  # fmt: skip
    places = mx.new_zeros(mx.shape[0], PLACE)
    places[:, MX], places[:, MY], places[:, SLOPE], places[:, KY] = mx, my, slope, ky
    inks = mx.new_zeros(mx.shape[0], INK, dtype=torch.float32)
    faded = faded.clamp(max=1.0)
    inks[:, OPACITY], inks[:, PLAIN], inks[:, KX] = faded * scene.opacity[rows], faded * scene.plain[rows], kx
    if scene.beta.numel():
        inks[:, BETA] = scene.beta[rows]
    return Footprints(block.ids[rows].to(torch.int32), outlines, places, inks), z
