"""The constants of the field, named once. They move results at the 1e-3 level: state them with every number."""

LOW_PASS = 0.3  # px^2, added to both axes of every projected covariance (3DGS; gsplat's eps2d)
NEAR_PLANE = 0.01  # scene units; a splat whose centre is nearer to the camera plane is not drawn
ALPHA_FLOOR = 1.0 / 255.0  # a smaller alpha counts as none (3DGS and 2DGS; DBS has compact support instead)
FIELD_MARGIN = 0.3  # the projection's Jacobian is clamped this share of tan(half field) outside the image
MAX_LOG_SCALE = 60.0  # log scales are clamped to +-this, so that squares stay finite in float64
TILE = 16  # px, side of a tile
LARGEST_EXPONENT = 120.0  # a falloff below 2^-120 counts as none: float32 holds no smaller alphas
EDGE_ON = 1e-6  # sine of a disc's plane with the ray of its centre; up to this only the low-pass counts (2DGS)
