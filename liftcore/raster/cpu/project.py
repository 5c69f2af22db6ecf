"""Projection of splats: 3DGS and DBS by EWA, 2DGS by the intersection of ray and disc plane.

A projected splat is a row of [P, COLUMNS] f64. Its outline is an ellipse in a form that subtracts no large numbers::

    e(x, y) = (SQRT_A (x - MX - SLOPE dy))^2 + C dy^2 <= CUTOFF,   dy = y - MY

For 3DGS (e, with ``alpha = opacity 2^-e``) and DBS (sigma) it is the footprint itself; for 2DGS it contains all
pixels whose ray can cross the disc.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from liftcore.runtime.jit import inlined, kernel, without_zero_checks
from liftcore.scene.compositing import (
    ALPHA_FLOOR,
    EDGE_ON,
    FIELD_MARGIN,
    LARGEST_EXPONENT,
    LOW_PASS,
    MAX_LOG_SCALE,
    NEAR_PLANE,
    CompositingParams,
)
from liftcore.scene.kernel import Kernel
from liftcore.scene.quaternions import rotation_rows

if TYPE_CHECKING:
    from liftcore.scene.cameras import Camera
    from liftcore.scene.origin import Origin
    from liftcore.scene.splats import Splats

# Columns of a projected splat. UNSCALED_OPACITY is the opacity without the scale of logits; RIGHTMOST_DY is dy at the
# rightmost point of the outline.
MX, MY, SLOPE, SQRT_A, C, CUTOFF, NEG_LOG2_OPACITY, EXTENT_X, EXTENT_Y, RIGHTMOST_DY, OPACITY, UNSCALED_OPACITY = (
    range(12)
)
BETA = 12  # DBS: the exponent beta = 4 exp(b)
# 2DGS: the projected centre; the radius around it that the low-pass reaches, px; and three linear forms of the
# distance (dx, dy) from it: s = S_X dx + S_Y dy, t likewise, d = D_ZERO + D_X dx + D_Y dy. The ray crosses the disc's
# plane at (s, t) / d, in units of the axes times sqrt(log2(e) / 2), so that e is the squared norm; d is the depth of
# the centre / depth of the crossing.
CENTRE_X, CENTRE_Y, NEARBY, S_X, S_Y, T_X, T_Y, D_ZERO, D_X, D_Y = range(12, 22)
COLUMNS = {Kernel.GAUSSIAN_3D: 12, Kernel.BETA: 13, Kernel.GAUSSIAN_2D: 22}

HALF_LOG2_E = 0.5 / math.log(2.0)  # 2^-(HALF_LOG2_E q) = exp(-q / 2)
LARGEST_BETA = 1e30  # such a kernel is a point; larger values overflow float32


class Scene(NamedTuple):
    """The activated splats as a structure of arrays, for the compiled code."""

    means: np.ndarray  # [3, P] f32, world frame minus the splats' origin
    axes: np.ndarray  # [3, 3, P] f64 ([3, 2, P] for 2DGS), scaled axes in columns, world
    opacity: np.ndarray  # [P] f64, sigmoid(opacity_logit_scale theta)
    neg_log2_opacity: np.ndarray  # [P] f64, -log2(opacity)
    unscaled_opacity: np.ndarray  # [P] f64, sigmoid(theta)
    cutoff: np.ndarray  # [P] f64, the largest e (or sigma) with a weight; negative for none
    beta: np.ndarray  # [P] f64, DBS only ([0] otherwise): the exponent


class View(NamedTuple):
    """A camera for the compiled code, for the pixels of a stride."""

    pose: np.ndarray  # [3, 4] f64, world frame minus the splats' origin -> camera
    intrinsics: np.ndarray  # [4] f64, fx fy cx cy, pixels
    limits: np.ndarray  # [4] f64, x/z and y/z bounds for the Jacobian: -x +x -y +y
    width: int
    height: int
    low_pass: float  # px^2, in pixels of the strided view


class Targets(NamedTuple):
    """The output buffers of a projection, one row per splat."""

    projected: np.ndarray  # [P, COLUMNS] f64
    depths: np.ndarray  # [P] f32
    ids: np.ndarray  # [P] i32


def view_of(camera: Camera, params: CompositingParams, origin: Origin) -> View:
    """Return the camera for the rays of the stride, with its Jacobian limits: 1.3 times the half field of view.

    ``u' = (u - offset - 1/2) / n + 1/2`` maps pixel centres to pixel centres, so the rays of the strided view are
    rays of the full view, and its A are rows of the full A: a projected covariance, low-pass included, shrinks by
    ``n^2`` as squared distances do. The limits are those of the full view, measured from each edge.

    Args:
        camera: in the world frame. params: the stride and its offset. origin: of the splats; the pose is made
            relative to it in float64, before anything is rounded to float32.
    """
    margin_x = FIELD_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = FIELD_MARGIN * 0.5 * camera.height / camera.fy
    limits = np.array(
        [
            camera.cx / camera.fx + margin_x,
            (camera.width - camera.cx) / camera.fx + margin_x,
            camera.cy / camera.fy + margin_y,
            (camera.height - camera.cy) / camera.fy + margin_y,
        ]
    )
    n, (left, top) = params.stride, params.offset
    cx, cy = (camera.cx - left - 0.5) / n + 0.5, (camera.cy - top - 0.5) / n + 0.5
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    if n > 1:
        intrinsics = np.array([camera.fx / n, camera.fy / n, cx, cy])
    width, height = -(-(camera.width - left) // n), -(-(camera.height - top) // n)
    pose = np.ascontiguousarray(camera.about(origin).viewmat[:3])
    return View(pose, intrinsics, limits, width, height, LOW_PASS / n**2)


def activate_splats(splats: Splats, scale: float) -> Scene:
    """Return the splats with their opacities, ``sigmoid(scale theta)``, and the cut-offs of their footprints."""
    means, empty = np.ascontiguousarray(splats.means.numpy().T), np.empty(0)
    scene = Scene(means, _axes_of(splats), empty, empty, _opacities(splats, 1.0), empty, _betas(splats))
    return with_opacities(scene, splats, scale)


def with_opacities(scene: Scene, splats: Splats, scale: float) -> Scene:
    """Return the same splats with another scale of their opacity logits."""
    opacity = scene.unscaled_opacity if scale == 1.0 else _opacities(splats, scale)
    strongest = np.maximum(opacity, scene.unscaled_opacity)
    with np.errstate(divide="ignore"):
        neg_log2_opacity = -np.log2(opacity)
        if splats.kernel is Kernel.BETA:
            furthest = -np.expm1(-math.log(2.0) * LARGEST_EXPONENT / scene.beta)  # smaller falloffs are zero
            cutoff = np.where(strongest > 0, furthest, -1.0)
        else:
            cutoff = np.log2(np.maximum(strongest, ALPHA_FLOOR / 2) / ALPHA_FLOOR)
    return scene._replace(opacity=opacity, neg_log2_opacity=neg_log2_opacity, cutoff=cutoff)


def _opacities(splats: Splats, scale: float) -> np.ndarray:
    """Return ``sigmoid(scale theta)`` [P] f64, without overflow at any logit."""
    theta = scale * splats.opacity_logits.numpy().astype(np.float64)
    small = np.exp(-np.abs(theta))
    return np.where(theta >= 0, 1.0, small) / (1.0 + small)


def _betas(splats: Splats) -> np.ndarray:
    """Return ``4 exp(b)`` [P] f64; [0] for kernels without a beta."""
    if splats.beta is None:
        return np.empty(0)
    return 4.0 * np.exp(np.minimum(splats.beta.numpy().astype(np.float64), math.log(LARGEST_BETA / 4.0)))


def _axes_of(splats: Splats) -> np.ndarray:
    """Return ``R diag(exp(log_scales))`` [3, 3, P] f64: column k is axis k, world frame; [3, 2, P] for 2DGS."""
    quats = splats.quats.numpy().astype(np.float64)
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    unit = np.where(norms > 0, quats / np.where(norms > 0, norms, 1.0), np.array([1.0, 0.0, 0.0, 0.0]))
    rotation = np.array(rotation_rows(*unit.T))
    log_scales = splats.log_scales.numpy().astype(np.float64).clip(-MAX_LOG_SCALE, MAX_LOG_SCALE)
    return np.ascontiguousarray(rotation[:, : log_scales.shape[1]] * np.exp(log_scales.T))


def low_pass_curvature(view: View) -> float:
    """Return the curvature of 2DGS's low-pass: ``exp(-g / 2)``, ``g = 2 |p - mu|^2`` in pixels of the full view."""
    return 2.0 * HALF_LOG2_E * LOW_PASS / view.low_pass


def project(
    bounds: tuple[int, int], scene: Scene, view: View, kernel: Kernel, antialiased: bool, targets: Targets
) -> int:
    """Project the splats in ``bounds`` and pack those that touch the image from its first row on; return their
    number.
    """
    if kernel is Kernel.GAUSSIAN_2D:
        return _project_discs(*bounds, scene, view, low_pass_curvature(view), targets)
    unit = 1.0 if kernel is Kernel.BETA else HALF_LOG2_E
    return _project_ellipses(*bounds, scene, view, unit, antialiased, targets)


# ------------------------------------------------------------------------------------------------------ 3DGS and DBS
#
# a = SQRT_A^2 = unit cov_yy / det, c = unit / cov_yy, slope = cov_xy / cov_yy. For 3DGS the unit is log2(e) / 2, for
# DBS it is one, and e is sigma. The determinant is a sum of squares (Cauchy-Binet over the three axes), so needles a
# thousand pixels long keep their precision.
#
# A block of splats goes through three loops without branches, which become vector instructions: splats behind the
# camera are projected like the others, to meaningless numbers. Only then are those that touch the image kept.

SIDE_BY_SIDE = 64  # splats of a block: their numbers stay in the L1 cache

# Rows of numbers of a block: the columns of a projected splat, then intermediate values.
_FIRST_EXTRA = COLUMNS[Kernel.GAUSSIAN_3D]
DEPTH, COMPENSATION, TOUCHES, XX, YY, XY, MINORS, DET = range(_FIRST_EXTRA, _FIRST_EXTRA + 8)
_NUMBERS = _FIRST_EXTRA + 8


@without_zero_checks
def _project_ellipses(first, last, scene, view, unit, antialiased, targets):
    """Project the splats ``first..last`` and pack those that touch the image from row ``first`` on.

    Args:
        scene: Scene. view: View. unit: of e, see above. targets: Targets, written.
        antialiased: multiply opacities by ``sqrt(det(cov) / det(cov + low-pass))`` (the mip filter's compensation).

    Returns:
        The number of rows written.
    """
    numbers = np.empty((_NUMBERS, SIDE_BY_SIDE))
    row = first
    for begin in range(first, last, SIDE_BY_SIDE):
        end = min(begin + SIDE_BY_SIDE, last)
        _project_covariances(begin, end, scene, view, numbers)
        if antialiased:
            _compensate_low_pass(end - begin, numbers)
        _measure_outlines(end - begin, view, unit, numbers)
        row = _keep_touching(begin, end, scene, antialiased, numbers, targets, row)
    return row - first


@inlined
def _project_covariances(begin, end, scene, view, numbers):
    """Compute image centre and covariance of the splats ``begin..end``, as if all lay in front of the camera."""
    pose, intrinsics, limits, low_pass = view.pose, view.intrinsics, view.limits, view.low_pass
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    left, right, top, bottom = -limits[0], limits[1], -limits[2], limits[3]
    x_0, x_1, x_2, x_3 = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    y_0, y_1, y_2, y_3 = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    z_0, z_1, z_2, z_3 = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    # Slices, because an index that might be negative would turn each read into a gather.
    at_x, at_y, at_z = scene.means[0, begin:end], scene.means[1, begin:end], scene.means[2, begin:end]
    axes, cutoffs = scene.axes, scene.cutoff[begin:end]
    x_of_0, y_of_0, z_of_0 = axes[0, 0, begin:end], axes[1, 0, begin:end], axes[2, 0, begin:end]
    x_of_1, y_of_1, z_of_1 = axes[0, 1, begin:end], axes[1, 1, begin:end], axes[2, 1, begin:end]
    x_of_2, y_of_2, z_of_2 = axes[0, 2, begin:end], axes[1, 2, begin:end], axes[2, 2, begin:end]
    mx, my, depth, cutoff = numbers[MX], numbers[MY], numbers[DEPTH], numbers[CUTOFF]
    cov_xx, cov_yy, cov_xy, squares, det = numbers[XX], numbers[YY], numbers[XY], numbers[MINORS], numbers[DET]
    for i in range(end - begin):
        px, py, pz = np.float64(at_x[i]), np.float64(at_y[i]), np.float64(at_z[i])
        x = x_0 * px + x_1 * py + x_2 * pz + x_3
        y = y_0 * px + y_1 * py + y_2 * pz + y_3
        z = z_0 * px + z_1 * py + z_2 * pz + z_3
        tan_x, tan_y = x / z, y / z
        tan_x = tan_x if tan_x > left else left
        tan_y = tan_y if tan_y > top else top
        slope_x = fx * (tan_x if tan_x < right else right) / z
        slope_y = fy * (tan_y if tan_y < bottom else bottom) / z
        # L = J W R S, the projected axes: cov = L L^T + low-pass.
        a, b, c = x_of_0[i], y_of_0[i], z_of_0[i]
        towards = z_0 * a + z_1 * b + z_2 * c
        u_0 = fx / z * (x_0 * a + x_1 * b + x_2 * c) - slope_x * towards
        v_0 = fy / z * (y_0 * a + y_1 * b + y_2 * c) - slope_y * towards
        a, b, c = x_of_1[i], y_of_1[i], z_of_1[i]
        towards = z_0 * a + z_1 * b + z_2 * c
        u_1 = fx / z * (x_0 * a + x_1 * b + x_2 * c) - slope_x * towards
        v_1 = fy / z * (y_0 * a + y_1 * b + y_2 * c) - slope_y * towards
        a, b, c = x_of_2[i], y_of_2[i], z_of_2[i]
        towards = z_0 * a + z_1 * b + z_2 * c
        u_2 = fx / z * (x_0 * a + x_1 * b + x_2 * c) - slope_x * towards
        v_2 = fy / z * (y_0 * a + y_1 * b + y_2 * c) - slope_y * towards
        xx = low_pass + u_0 * u_0 + u_1 * u_1 + u_2 * u_2
        yy = low_pass + v_0 * v_0 + v_1 * v_1 + v_2 * v_2
        minor_01, minor_12, minor_02 = u_0 * v_1 - v_0 * u_1, u_1 * v_2 - v_1 * u_2, u_0 * v_2 - v_0 * u_2
        minors = minor_01 * minor_01 + minor_12 * minor_12 + minor_02 * minor_02
        mx[i] = fx * x / z + cx
        my[i] = fy * y / z + cy
        cov_xx[i] = xx
        cov_yy[i] = yy
        cov_xy[i] = u_0 * v_0 + u_1 * v_1 + u_2 * v_2
        squares[i] = minors
        det[i] = minors + low_pass * (xx + yy - low_pass)
        depth[i] = z
        cutoff[i] = cutoffs[i]


@inlined
def _compensate_low_pass(count, numbers):
    """Compute the opacity compensation of the low-pass, and subtract it from the cut-offs."""
    for i in range(count):
        compensation = math.sqrt(numbers[MINORS, i] / numbers[DET, i]) if numbers[DET, i] > 0 else 0.0
        numbers[COMPENSATION, i] = compensation
        if compensation < 1.0:
            numbers[CUTOFF, i] += math.log2(compensation) if compensation > 0 else -math.inf


@inlined
def _measure_outlines(count, view, unit, numbers):
    """Compute the outlines of projected splats, and flag those that touch the image."""
    # The nearest pixel centres lie half a pixel inside the image.
    right, bottom = view.width - 0.5, view.height - 0.5
    mx, my, depth, cutoff = numbers[MX], numbers[MY], numbers[DEPTH], numbers[CUTOFF]
    cov_xx, cov_yy, cov_xy, det = numbers[XX], numbers[YY], numbers[XY], numbers[DET]
    slope, sqrt_a, c, rightmost_dy = numbers[SLOPE], numbers[SQRT_A], numbers[C], numbers[RIGHTMOST_DY]
    extent_x, extent_y, touches = numbers[EXTENT_X], numbers[EXTENT_Y], numbers[TOUCHES]
    for i in range(count):
        xx, yy, xy = cov_xx[i], cov_yy[i], cov_xy[i]
        spread = math.sqrt((cutoff[i] if cutoff[i] > 0 else 0.0) / unit)
        wide, high = spread * math.sqrt(xx), spread * math.sqrt(yy)
        slope[i] = xy / yy
        sqrt_a[i] = math.sqrt(unit * yy / det[i])
        c[i] = unit / yy
        rightmost_dy[i] = xy / xx * wide
        extent_x[i], extent_y[i] = wide, high
        # NaN touches nothing.
        inside = (mx[i] + wide >= 0.5) & (mx[i] - wide <= right) & (my[i] + high >= 0.5) & (my[i] - high <= bottom)
        touches[i] = 1.0 if inside & (cutoff[i] >= 0) & (depth[i] >= NEAR_PLANE) else 0.0


@inlined
def _keep_touching(begin, end, scene, antialiased, numbers, targets, row):
    """Write the splats that touch the image from ``row`` on; return the row after the last."""
    projected, has_beta = targets.projected, scene.beta.shape[0] > 0
    for j in range(begin, end):
        i = j - begin
        if numbers[TOUCHES, i] == 0:
            continue
        splat = projected[row]
        for number in (MX, MY, SLOPE, SQRT_A, C, CUTOFF, EXTENT_X, EXTENT_Y, RIGHTMOST_DY):
            splat[number] = numbers[number, i]
        splat[OPACITY], splat[NEG_LOG2_OPACITY], splat[UNSCALED_OPACITY] = (
            scene.opacity[j],
            scene.neg_log2_opacity[j],
            scene.unscaled_opacity[j],
        )
        if antialiased:
            splat[OPACITY] *= numbers[COMPENSATION, i]
            splat[UNSCALED_OPACITY] *= numbers[COMPENSATION, i]
            splat[NEG_LOG2_OPACITY] = -math.log2(splat[OPACITY]) if splat[OPACITY] > 0 else math.inf
        if has_beta:
            splat[BETA] = scene.beta[j]
        targets.depths[row] = numbers[DEPTH, i]
        targets.ids[row] = j
        row += 1
    return row


# --------------------------------------------------------------------------------------------------------------- 2DGS
#
# With the centre c and the scaled axes a, b in the camera's frame, n = a x b and the ray r of a pixel, the ray
# crosses the plane at c + s a + t b with
#
#     s = (b x c) r / (n r),   t = (c x a) r / (n r),   depth = (n c) / (n r)
#
# (the paper's homogeneous h_u x h_v up to a factor). All three are affine in the pixel. Relative to the projected
# centre and divided by n r there, the first two lose their constants and the third becomes d = depth of the centre
# / depth of the crossing, so no large numbers are subtracted. Crossings behind the camera (d <= 0) are not on the ray
# and are ignored; without a crossing, only the low-pass 2 |p - mu|^2 applies.

MARGIN = 1e-3  # px by which an outline is wider than the crossings, for rounding to float32 at its edge
RELATIVE = 1e-4  # the same as a share of its size
HORIZON = 1e-9  # a disc this near to the camera's plane, in its depth squared, has a box for an outline


@inlined
def _to_camera(pose, vectors, j):
    """Return point j of [3, P] in the camera's frame."""
    px, py, pz = vectors[0, j], vectors[1, j], vectors[2, j]
    x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
    y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
    z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
    return x, y, z


@inlined
def _rotate_to_camera(pose, axes, j, k):
    """Return axis k of splat j in the camera's frame."""
    px, py, pz = axes[0, k, j], axes[1, k, j], axes[2, k, j]
    x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz
    y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz
    z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz
    return x, y, z


@kernel
def _project_discs(first, last, scene, view, curvature, targets):
    """Project the discs ``first..last`` and pack those that touch the image from row ``first`` on.

    Args:
        scene: Scene. view: View. curvature: of the low-pass, as in Discs. targets: Targets, written.

    Returns:
        The number of rows written.
    """
    pose, intrinsics = view.pose, view.intrinsics
    means, axes, projected = scene.means, scene.axes, targets.projected
    fx, fy = intrinsics[0], intrinsics[1]
    row = first
    for j in range(first, last):
        cutoff = scene.cutoff[j]
        if cutoff < 0:
            continue
        centre = _to_camera(pose, means, j)
        if not centre[2] >= NEAR_PLANE:
            continue
        a, b = _rotate_to_camera(pose, axes, j, 0), _rotate_to_camera(pose, axes, j, 1)
        splat = projected[row]
        mx = fx * centre[0] / centre[2] + intrinsics[2]
        my = fy * centre[1] / centre[2] + intrinsics[3]
        splat[CENTRE_X], splat[CENTRE_Y], splat[NEARBY] = mx, my, math.sqrt(cutoff / curvature)
        if _write_crossing(splat, centre, a, b, fx, fy):
            _write_outline(splat, centre, a, b, cutoff / HALF_LOG2_E, view)
        else:
            _write_circle(splat)
        near = splat[NEARBY]
        left = min(mx - near, splat[MX] - splat[EXTENT_X])
        right = max(mx + near, splat[MX] + splat[EXTENT_X])
        top = min(my - near, splat[MY] - splat[EXTENT_Y])
        bottom = max(my + near, splat[MY] + splat[EXTENT_Y])
        # The nearest pixel centres lie half a pixel inside the image.
        if not (right >= 0.5 and left <= view.width - 0.5 and bottom >= 0.5 and top <= view.height - 0.5):
            continue
        splat[OPACITY] = scene.opacity[j]
        splat[NEG_LOG2_OPACITY] = scene.neg_log2_opacity[j]
        splat[UNSCALED_OPACITY] = scene.unscaled_opacity[j]
        targets.depths[row] = centre[2]
        targets.ids[row] = j
        row += 1
    return row - first


@inlined
def _cross(p, q):
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


@inlined
def _dot(p, q):
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@inlined
def _write_crossing(splat, centre, a, b, fx, fy):
    """Write the linear forms s, t and d; return False for a disc seen edge-on, which has none."""
    normal = _cross(a, b)
    facing = _dot(normal, centre)
    splat[S_X] = splat[S_Y] = splat[T_X] = splat[T_Y] = splat[D_X] = splat[D_Y] = 0.0
    splat[D_ZERO] = -1.0
    if not abs(facing) > EDGE_ON * math.sqrt(_dot(normal, normal) * _dot(centre, centre)):
        return False
    scale = centre[2] / facing
    unit = scale * math.sqrt(HALF_LOG2_E)
    along_a, along_b = _cross(b, centre), _cross(centre, a)
    splat[S_X], splat[S_Y] = unit * along_a[0] / fx, unit * along_a[1] / fy
    splat[T_X], splat[T_Y] = unit * along_b[0] / fx, unit * along_b[1] / fy
    splat[D_X], splat[D_Y] = scale * normal[0] / fx, scale * normal[1] / fy
    splat[D_ZERO] = 1.0
    return True


@inlined
def _write_ellipse(splat, middle, covariance, det):
    """Write the outline ``(p - middle)^T covariance^-1 (p - middle) <= 1``; det comes apart, at full precision."""
    xx, xy, yy = covariance
    splat[MX], splat[MY] = middle
    splat[SLOPE] = xy / yy
    splat[SQRT_A] = math.sqrt(yy / det)
    splat[C] = 1.0 / yy
    splat[CUTOFF] = 1.0
    splat[EXTENT_X] = math.sqrt(xx)
    splat[EXTENT_Y] = math.sqrt(yy)
    splat[RIGHTMOST_DY] = xy / math.sqrt(xx)


@inlined
def _write_circle(splat):
    """Write the outline of the low-pass alone."""
    square = splat[NEARBY] ** 2 + MARGIN**2
    _write_ellipse(splat, (splat[CENTRE_X], splat[CENTRE_Y]), (square, 0.0, square), square * square)


@inlined
def _write_outline(splat, centre, a, b, largest, view):
    """Write an outline around all pixels whose ray can cross the disc ``s^2 + t^2 <= largest``.

    Relative to the projected centre, the disc's points ``q = (s, t)`` project to ``(U q, V q) / (z + W q)``. If all
    of them lie in front of the camera, that is an ellipse with the covariance ``m m^T + g [U V]^T [U V]`` about
    ``m = -g [U V]^T W``, with ``g = largest / (z^2 - largest |W|^2)``. If the disc crosses the camera's plane, the
    outline contains a box.
    """
    fx, fy = view.intrinsics[0], view.intrinsics[1]
    x, y, z = centre
    u = fx * (a[0] - x / z * a[2]), fx * (b[0] - x / z * b[2])
    v = fy * (a[1] - y / z * a[2]), fy * (b[1] - y / z * b[2])
    w = a[2], b[2]
    clearance = z * z - largest * (w[0] * w[0] + w[1] * w[1])
    uu, vv, uv = u[0] * u[0] + u[1] * u[1], v[0] * v[0] + v[1] * v[1], u[0] * v[0] + u[1] * v[1]
    uw, vw = u[0] * w[0] + u[1] * w[1], v[0] * w[0] + v[1] * w[1]
    if clearance > HORIZON * z * z:
        g = largest / clearance
        x0, y0 = -g * uw, -g * vw
        xx, yy = x0 * x0 + g * uu, y0 * y0 + g * vv
        minor = g * (u[0] * v[1] - u[1] * v[0])
        margin = MARGIN**2 + RELATIVE**2 * (xx + yy)
        det = minor * minor * (z * z / clearance) + margin * (xx + yy) + margin * margin
        covariance = xx + margin, x0 * y0 + g * uv, yy + margin
        _write_ellipse(splat, (splat[CENTRE_X] + x0, splat[CENTRE_Y] + y0), covariance, det)
        return
    left, right = _clip_to_side(splat[CENTRE_X], largest * uw, largest * uu, clearance, view.width)
    top, bottom = _clip_to_side(splat[CENTRE_Y], largest * vw, largest * vv, clearance, view.height)
    half_x, half_y = 0.5 * (right - left), 0.5 * (bottom - top)
    splat[MX], splat[MY] = left + half_x, top + half_y
    splat[EXTENT_X], splat[EXTENT_Y] = half_x, half_y
    splat[SLOPE] = splat[RIGHTMOST_DY] = 0.0
    # Half of the cut-off per side: an ellipse through the corners of the box; the extents are those of the box.
    splat[SQRT_A] = 1.0 / max(MARGIN, half_x)
    splat[C] = 1.0 / max(MARGIN, half_y) ** 2
    splat[CUTOFF] = 2.0


@inlined
def _clip_to_side(origin, p, q, clearance, size):
    """Return the range along one side of the image that a disc crossing the camera's plane can hit.

    A point at distance o from the projected centre is hit where ``clearance o^2 + 2 p o - q <= 0``, on the branch of
    o = 0. The range is clipped one pixel outside the image.
    """
    square = p * p + clearance * q
    low, high = -math.inf, math.inf
    if square >= 0:
        root = math.sqrt(square)
        if p + root > 0:
            high = q / (p + root)
        if p - root < 0:
            low = q / (p - root)
    low = origin + low * (1.0 + RELATIVE) - MARGIN
    high = origin + high * (1.0 + RELATIVE) + MARGIN
    return max(-1.0, low), min(size + 1.0, high)
