"""The columns of a footprint record [RECORD] f64: one row a splat that a view may see."""

from __future__ import annotations

# The outline: e(x, y) = (ROOT_X (x - MX - SLOPE dy))^2 + KY dy^2 <= REACH with dy = y - MY. For 3DGS (e) and DBS
# (sigma) it is the footprint itself, for 2DGS it holds all pixels whose ray can cross the disc. PLAIN is the opacity
# without the gain, FADE is -log2(OPACITY).
MX, MY, SLOPE, ROOT_X, KY, REACH, FADE, EXTENT_X, EXTENT_Y, LEAN, OPACITY, PLAIN = range(12)
GAUSSIAN_RECORD = 12

BETA = 12  # the exponent beta = 4 exp(b)
BETA_RECORD = 13

# 2DGS: the projected centre; the circle around it that the low-pass reaches, px; and three forms in the distance
# (dx, dy) from it, with s = S_X dx + S_Y dy, t alike, d = D_ZERO + D_X dx + D_Y dy: the ray crosses the disc's plane
# at (s, t) / d, in units of the axes, times sqrt(log2(e) / 2), so that e is their square; d is the depth of the
# centre over that of the crossing.
CENTRE_X, CENTRE_Y, NEARBY, S_X, S_Y, T_X, T_Y, D_ZERO, D_X, D_Y = range(12, 22)
DISC_RECORD = 22
