"""3D Gaussians and beta kernels to screen footprints: EWA projection (paper's delta_pr).

Every footprint is an ellipse written row by row, which needs no subtraction of large numbers::

    e(x, y) = kx (x - mx - slope dy)^2 + ky dy^2,   dy = y - my

``kx = unit cov_yy / det``, ``ky = unit / cov_yy``, ``slope = cov_xy / cov_yy``. For 3DGS the unit is log2(e) / 2, so
that ``alpha = opacity 2^-e``; for DBS it is one, and e is sigma. A record has the root of kx. The determinant is a
sum of squares (Cauchy-Binet over the three axes), so needles a thousand pixels long keep all their digits.

Some splats at a time go through three loops without branches, which become vector instructions: splats behind the
camera are projected like the others, to whatever comes of it. Only then are those that touch the image kept.
"""

from __future__ import annotations

import math

import numpy as np

from liftcore.jit import inlined, without_zero_checks
from liftcore.raster.constants import NEAR_PLANE
from liftcore.raster.cpu.projection import fade_of
from liftcore.raster.cpu.records import (
    BETA,
    EXTENT_X,
    EXTENT_Y,
    FADE,
    GAUSSIAN_RECORD,
    KY,
    LEAN,
    MX,
    MY,
    OPACITY,
    PLAIN,
    REACH,
    ROOT_X,
    SLOPE,
)

SIDE_BY_SIDE = 64  # splats at a time: their numbers stay in the nearest cache

# Rows of numbers of these splats: those of a record in its places, and what else there is on the way.
DEPTH, FADED, TOUCHES, XX, YY, XY, MINORS, DET = range(GAUSSIAN_RECORD, GAUSSIAN_RECORD + 8)
_NUMBERS = GAUSSIAN_RECORD + 8


@without_zero_checks
def project_ellipses(first, last, scene, view, unit, antialiased, targets):
    """Footprints of the splats ``first..last`` that touch the image, packed from row ``first`` on.

    Args:
        scene: Scene. view: View. unit: of e, see above. targets: Targets, written.
        antialiased: opacities times ``sqrt(det(cov) / det(cov + low-pass))`` (the mip filter's compensation).

    Returns:
        The number of rows written.
    """
    numbers = np.empty((_NUMBERS, SIDE_BY_SIDE))
    row = first
    for begin in range(first, last, SIDE_BY_SIDE):
        end = min(begin + SIDE_BY_SIDE, last)
        _project_covariances(begin, end, scene, view, numbers)
        if antialiased:
            _fade(end - begin, numbers)
        _measure_outlines(end - begin, view, unit, numbers)
        row = _keep_touching(begin, end, scene, antialiased, numbers, targets, row)
    return row - first


@inlined
def _project_covariances(begin, end, scene, view, numbers):
    """Centre and covariance in the image of the splats ``begin..end``, as if all lay before the camera."""
    pose, intrinsics, limits, low_pass = view.pose, view.intrinsics, view.limits, view.low_pass
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    left, right, top, bottom = -limits[0], limits[1], -limits[2], limits[3]
    x_0, x_1, x_2, x_3 = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    y_0, y_1, y_2, y_3 = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    z_0, z_1, z_2, z_3 = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    # Of these splats alone: an index that might be negative would make of each read a gather.
    at_x, at_y, at_z = scene.means[0, begin:end], scene.means[1, begin:end], scene.means[2, begin:end]
    axes, reaches = scene.axes, scene.reach[begin:end]
    x_of_0, y_of_0, z_of_0 = axes[0, 0, begin:end], axes[1, 0, begin:end], axes[2, 0, begin:end]
    x_of_1, y_of_1, z_of_1 = axes[0, 1, begin:end], axes[1, 1, begin:end], axes[2, 1, begin:end]
    x_of_2, y_of_2, z_of_2 = axes[0, 2, begin:end], axes[1, 2, begin:end], axes[2, 2, begin:end]
    mx, my, depth, reach = numbers[MX], numbers[MY], numbers[DEPTH], numbers[REACH]
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
        one, two, three = u_0 * v_1 - v_0 * u_1, u_1 * v_2 - v_1 * u_2, u_0 * v_2 - v_0 * u_2
        minors = one * one + two * two + three * three
        mx[i] = fx * x / z + cx
        my[i] = fy * y / z + cy
        cov_xx[i] = xx
        cov_yy[i] = yy
        cov_xy[i] = u_0 * v_0 + u_1 * v_1 + u_2 * v_2
        squares[i] = minors
        det[i] = minors + low_pass * (xx + yy - low_pass)
        depth[i] = z
        reach[i] = reaches[i]


@inlined
def _fade(count, numbers):
    """What the low-pass takes of the opacities, and of how far they reach."""
    for i in range(count):
        faded = math.sqrt(numbers[MINORS, i] / numbers[DET, i]) if numbers[DET, i] > 0 else 0.0
        numbers[FADED, i] = faded
        if faded < 1.0:
            numbers[REACH, i] += math.log2(faded) if faded > 0 else -math.inf


@inlined
def _measure_outlines(count, view, unit, numbers):
    """The numbers of the records, and which of them touch the image."""
    # The nearest pixel centres lie half a pixel inside the image.
    right, bottom = view.width - 0.5, view.height - 0.5
    mx, my, depth, reach = numbers[MX], numbers[MY], numbers[DEPTH], numbers[REACH]
    cov_xx, cov_yy, cov_xy, det = numbers[XX], numbers[YY], numbers[XY], numbers[DET]
    slope, root_x, ky, lean = numbers[SLOPE], numbers[ROOT_X], numbers[KY], numbers[LEAN]
    extent_x, extent_y, touches = numbers[EXTENT_X], numbers[EXTENT_Y], numbers[TOUCHES]
    for i in range(count):
        xx, yy, xy = cov_xx[i], cov_yy[i], cov_xy[i]
        spread = math.sqrt((reach[i] if reach[i] > 0 else 0.0) / unit)
        wide, high = spread * math.sqrt(xx), spread * math.sqrt(yy)
        slope[i] = xy / yy
        root_x[i] = math.sqrt(unit * yy / det[i])
        ky[i] = unit / yy
        lean[i] = xy / xx * wide
        extent_x[i], extent_y[i] = wide, high
        # What is not a number touches nothing.
        inside = (mx[i] + wide >= 0.5) & (mx[i] - wide <= right) & (my[i] + high >= 0.5) & (my[i] - high <= bottom)
        touches[i] = 1.0 if inside & (reach[i] >= 0) & (depth[i] >= NEAR_PLANE) else 0.0


@inlined
def _keep_touching(begin, end, scene, antialiased, numbers, targets, row):
    """The records of those that touch the image, from ``row`` on; the row after the last."""
    records, has_beta = targets.records, scene.beta.shape[0] > 0
    for j in range(begin, end):
        i = j - begin
        if numbers[TOUCHES, i] == 0:
            continue
        record = records[row]
        for number in (MX, MY, SLOPE, ROOT_X, KY, REACH, EXTENT_X, EXTENT_Y, LEAN):
            record[number] = numbers[number, i]
        record[OPACITY], record[FADE], record[PLAIN] = scene.opacity[j], scene.fade[j], scene.plain[j]
        if antialiased:
            record[OPACITY] *= numbers[FADED, i]
            record[PLAIN] *= numbers[FADED, i]
            record[FADE] = fade_of(record[OPACITY])
        if has_beta:
            record[BETA] = scene.beta[j]
        targets.depths[row] = numbers[DEPTH, i]
        targets.ids[row] = j
        row += 1
    return row
