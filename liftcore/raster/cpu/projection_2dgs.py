"""Discs to screen footprints: the crossing of a pixel's ray with the disc's plane (paper's delta_pr for 2DGS).

With the centre c and the scaled axes a, b in the camera's frame, ``n = a x b`` and the ray r of a pixel, the ray
crosses the plane at ``c + s a + t b``::

    s = (b x c) r / (n r),   t = (c x a) r / (n r),   depth = (n c) / (n r)

(the paper's homogeneous ``h_u x h_v`` up to a factor). All three are affine in the pixel. Taken from the projected
centre on and divided by ``n r`` there, the first two lose their constants and the third becomes ``d = depth of the
centre / depth of the crossing``, so no large numbers are subtracted. Crossings behind the camera (d <= 0) are not on
the ray and count as none; where there is none, the low-pass ``2 |p - mu|^2`` stays.
"""

from __future__ import annotations

import math

from liftcore.jit import inlined, kernel
from liftcore.raster.constants import EDGE_ON, NEAR_PLANE
from liftcore.raster.cpu.projection import HALF_LOG2_E, to_camera, turned
from liftcore.raster.cpu.records import (
    CENTRE_X,
    CENTRE_Y,
    D_X,
    D_Y,
    D_ZERO,
    EXTENT_X,
    EXTENT_Y,
    FADE,
    KY,
    LEAN,
    MX,
    MY,
    NEARBY,
    OPACITY,
    PLAIN,
    REACH,
    ROOT_X,
    S_X,
    S_Y,
    SLOPE,
    T_X,
    T_Y,
)

_MARGIN = 1e-3  # px that an outline is wider than the crossings, for float32 at its edge
_RELATIVE = 1e-4  # and this share of its size
_HORIZON = 1e-9  # a disc that comes this near to the camera's plane, in its depth squared, has a box for an outline


@kernel
def project_discs(first, last, scene, view, curvature, targets):
    """Footprints of the discs ``first..last`` that touch the image, packed from row ``first`` on.

    Args:
        scene: Scene. view: View. curvature: of the low-pass, as in Discs. targets: Targets, written.

    Returns:
        The number of rows written.
    """
    pose, intrinsics = view.pose, view.intrinsics
    means, axes, records = scene.means, scene.axes, targets.records
    fx, fy = intrinsics[0], intrinsics[1]
    row = first
    for j in range(first, last):
        reach = scene.reach[j]
        if reach < 0:
            continue
        centre = to_camera(pose, means, j)
        if not centre[2] >= NEAR_PLANE:
            continue
        a, b = turned(pose, axes, j, 0), turned(pose, axes, j, 1)
        record = records[row]
        mx = fx * centre[0] / centre[2] + intrinsics[2]
        my = fy * centre[1] / centre[2] + intrinsics[3]
        record[CENTRE_X], record[CENTRE_Y], record[NEARBY] = mx, my, math.sqrt(reach / curvature)
        if _write_crossing(record, centre, a, b, fx, fy):
            _write_outline(record, centre, a, b, reach / HALF_LOG2_E, view)
        else:
            _write_circle(record)
        near = record[NEARBY]
        left = min(mx - near, record[MX] - record[EXTENT_X])
        right = max(mx + near, record[MX] + record[EXTENT_X])
        top = min(my - near, record[MY] - record[EXTENT_Y])
        bottom = max(my + near, record[MY] + record[EXTENT_Y])
        # The nearest pixel centres lie half a pixel inside the image.
        if not (right >= 0.5 and left <= view.width - 0.5 and bottom >= 0.5 and top <= view.height - 0.5):
            continue
        record[OPACITY] = scene.opacity[j]
        record[FADE] = scene.fade[j]
        record[PLAIN] = scene.plain[j]
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
def _write_crossing(record, centre, a, b, fx, fy):
    """The forms s, t and d by pixel; whether there are any, for a disc seen edge-on has none."""
    normal = _cross(a, b)
    facing = _dot(normal, centre)
    record[S_X] = record[S_Y] = record[T_X] = record[T_Y] = record[D_X] = record[D_Y] = 0.0
    record[D_ZERO] = -1.0
    if not abs(facing) > EDGE_ON * math.sqrt(_dot(normal, normal) * _dot(centre, centre)):
        return False
    scale = centre[2] / facing
    unit = scale * math.sqrt(HALF_LOG2_E)
    along_a, along_b = _cross(b, centre), _cross(centre, a)
    record[S_X], record[S_Y] = unit * along_a[0] / fx, unit * along_a[1] / fy
    record[T_X], record[T_Y] = unit * along_b[0] / fx, unit * along_b[1] / fy
    record[D_X], record[D_Y] = scale * normal[0] / fx, scale * normal[1] / fy
    record[D_ZERO] = 1.0
    return True


@inlined
def _write_ellipse(record, middle, covariance, det):
    """An outline ``(p - middle)^T covariance^-1 (p - middle) <= 1``; the determinant has digits of its own."""
    xx, xy, yy = covariance
    record[MX], record[MY] = middle
    record[SLOPE] = xy / yy
    record[ROOT_X] = math.sqrt(yy / det)
    record[KY] = 1.0 / yy
    record[REACH] = 1.0
    record[EXTENT_X] = math.sqrt(xx)
    record[EXTENT_Y] = math.sqrt(yy)
    record[LEAN] = xy / math.sqrt(xx)


@inlined
def _write_circle(record):
    """The low-pass alone."""
    square = record[NEARBY] ** 2 + _MARGIN**2
    _write_ellipse(record, (record[CENTRE_X], record[CENTRE_Y]), (square, 0.0, square), square * square)


@inlined
def _write_outline(record, centre, a, b, largest, view):
    """All pixels whose ray can cross the disc ``s^2 + t^2 <= largest``.

    The projected centre taken as origin, the disc's points ``q = (s, t)`` come to ``(U q, V q) / (z + W q)``. Where
    all of them lie before the camera, that is an ellipse with the covariance ``m m^T + g [U V]^T [U V]`` about
    ``m = -g [U V]^T W``, with ``g = largest / (z^2 - largest |W|^2)``. Where the disc passes the camera's plane, it
    is a box.
    """
    fx, fy = view.intrinsics[0], view.intrinsics[1]
    x, y, z = centre
    u = fx * (a[0] - x / z * a[2]), fx * (b[0] - x / z * b[2])
    v = fy * (a[1] - y / z * a[2]), fy * (b[1] - y / z * b[2])
    w = a[2], b[2]
    room = z * z - largest * (w[0] * w[0] + w[1] * w[1])
    uu, vv, uv = u[0] * u[0] + u[1] * u[1], v[0] * v[0] + v[1] * v[1], u[0] * v[0] + u[1] * v[1]
    uw, vw = u[0] * w[0] + u[1] * w[1], v[0] * w[0] + v[1] * w[1]
    if room > _HORIZON * z * z:
        g = largest / room
        x0, y0 = -g * uw, -g * vw
        xx, yy = x0 * x0 + g * uu, y0 * y0 + g * vv
        minor = g * (u[0] * v[1] - u[1] * v[0])
        margin = _MARGIN**2 + _RELATIVE**2 * (xx + yy)
        det = minor * minor * (z * z / room) + margin * (xx + yy) + margin * margin
        covariance = xx + margin, x0 * y0 + g * uv, yy + margin
        _write_ellipse(record, (record[CENTRE_X] + x0, record[CENTRE_Y] + y0), covariance, det)
        return
    left, right = _reached(record[CENTRE_X], largest * uw, largest * uu, room, view.width)
    top, bottom = _reached(record[CENTRE_Y], largest * vw, largest * vv, room, view.height)
    half_x, half_y = 0.5 * (right - left), 0.5 * (bottom - top)
    record[MX], record[MY] = left + half_x, top + half_y
    record[EXTENT_X], record[EXTENT_Y] = half_x, half_y
    record[SLOPE] = record[LEAN] = 0.0
    # Half of the reach for each side: the ellipse through the corners of the box, of which the tiles know the sides.
    record[ROOT_X] = 1.0 / max(_MARGIN, half_x)
    record[KY] = 1.0 / max(_MARGIN, half_y) ** 2
    record[REACH] = 2.0


@inlined
def _reached(origin, p, q, room, size):
    """Where an image's side can meet a disc that passes the camera's plane, clipped a pixel outside the image.

    A point at distance o of the projected centre is met where ``room o^2 + 2 p o - q <= 0``, on the branch of o = 0.
    """
    square = p * p + room * q
    low, high = -math.inf, math.inf
    if square >= 0:
        root = math.sqrt(square)
        if p + root > 0:
            high = q / (p + root)
        if p - root < 0:
            low = q / (p - root)
    low = origin + low * (1.0 + _RELATIVE) - _MARGIN
    high = origin + high * (1.0 + _RELATIVE) + _MARGIN
    return max(-1.0, low), min(size + 1.0, high)
