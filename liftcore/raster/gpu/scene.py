"""A scene and a view's footprints as they lie on the device."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.raster.cpu.project import Scene

# What the walk reads of a splat. PLACES [n, PLACE] f64 holds what is taken at a row's first pixel, where large
# numbers are subtracted; INKS [n, INK] f32 what every pixel needs. A row a splat that the view may see, near to far.
MX, MY, SLOPE, KY = range(4)  # 3DGS and DBS, as in cpu.project
CENTRE_X, CENTRE_Y, S_X, S_Y, T_X, T_Y, D_ZERO, D_X, D_Y = range(9)  # 2DGS, likewise
PLACE = 9

OPACITY, PLAIN, KX, BETA = range(4)  # KX is the low-pass's curvature for 2DGS
S_STEP, S_STEP_REST, T_STEP, T_STEP_REST, D_STEP, D_STEP_REST = range(4, 10)  # 2DGS: forms by pixel
INK = 10


class DeviceScene(NamedTuple):
    """``liftcore.raster.cpu.project.Scene`` as tensors, a row a splat; on the device, or on the host."""

    means: Tensor  # [P, 3] f32, world
    axes: Tensor  # [P, 3, 3] f64 ([P, 3, 2] for 2DGS), scaled axes in columns, world
    opacity: Tensor  # [P] f64, with the gain
    plain: Tensor  # [P] f64, without it
    cutoff: Tensor  # [P] f64, the largest e (or sigma) with a weight; negative for none
    beta: Tensor  # [P] f64, DBS only ([0] otherwise): the exponent


class Outlines(NamedTuple):
    """What the tile lists need of the footprints, a row a splat, near to far; all f64."""

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

    def at(self, rows: Tensor | slice) -> Outlines:
        """Some rows, in their order."""
        return Outlines(*(column[rows] if column.numel() else column for column in self))


class Footprints(NamedTuple):
    """The splats that touch the image, near to far; ties in the order of the file."""

    ids: Tensor  # [n] i32, the splat
    outlines: Outlines
    places: Tensor  # [n, PLACE] f64
    inks: Tensor  # [n, INK] f32


class Block(NamedTuple):
    """Some splats, on the device where they are projected."""

    ids: Tensor  # [n] i64, of the scene
    scene: DeviceScene  # their rows


def scene_on(device: torch.device, scene: Scene) -> DeviceScene:
    """The activated splats, moved: the numbers are those of the CPU backend."""
    parts = (torch.from_numpy(getattr(scene, name)) for name in DeviceScene._fields)
    return DeviceScene(*(part.movedim(-1, 0).contiguous().to(device) for part in parts))


def block_of(scene: DeviceScene, rows: slice | Tensor, device: torch.device) -> Block:
    """Some splats of a scene that lies on the device or on the host: a run of them, or ids [n] in any order."""
    if isinstance(rows, slice):
        ids = torch.arange(rows.start, min(rows.stop, scene.means.shape[0]), device=device)
    else:
        ids, rows = rows.long().to(device), rows.long().to(scene.means.device)
    parts = (part[rows].to(device) if part.numel() else part.to(device) for part in scene)
    return Block(ids, DeviceScene(*parts))


def with_opacity(scene: DeviceScene, changed: Scene) -> DeviceScene:
    """The same splats with the opacities and reaches of ``changed``."""
    device = scene.means.device
    opacity, cutoff = (torch.from_numpy(part).to(device) for part in (changed.opacity, changed.cutoff))
    return scene._replace(opacity=opacity, cutoff=cutoff)
