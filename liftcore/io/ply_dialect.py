"""Which column of a splat PLY is which number of the model.

One table serves reading and writing, for every dialect: Inria, gsplat (no normals), SAGA and LaGa (``mask``),
2DGS (two scales) and DBS (``sh0_*``, ``shN_*``, ``sb_params_*``, ``beta``). Colour coefficients and lobes are
stored channel-major: all of red, then green, then blue.
"""

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from liftcore.errors import InvalidSplats
from liftcore.scene.kernel import Kernel

MAX_SH_DEGREE = 4
LOBE_CHANNELS = 6  # of a spherical beta lobe: r g b theta phi beta
NORMALS = ("nx", "ny", "nz")
SCAFFOLD = ("f_anchor_feat_0", "f_offset_0")  # of Scaffold-GS, whose networks turn anchors into splats

_GSPLAT = {"x", "y", "z", "f_dc_0", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_3"}
_SIGNATURES = {
    "Inria 3DGS": {*_GSPLAT, "nx"},
    "gsplat": _GSPLAT,
    "2DGS": {*_GSPLAT, "nx"} - {"scale_2"},
    "DBS": {*_GSPLAT, "sh0_0", "beta"} - {"f_dc_0"},
    "a point cloud, which has no splats": {"x", "y", "z", "red", "green", "blue", "nx"},
}


@dataclass(frozen=True)
class Slot:
    """Where a column lives: a field of ``Splats`` and the index behind the splat's."""

    field: str
    index: tuple[int, ...]


def recognise_kernel(names: Collection[str]) -> Kernel:
    """The kernel that the columns speak of."""
    if "beta" in names or "sb_params_0" in names or "sh0_0" in names:
        return Kernel.BETA
    if "scale_1" in names and "scale_2" not in names:
        return Kernel.GAUSSIAN_2D
    return Kernel.GAUSSIAN_3D


def model_slots(names: Sequence[str], kernel: Kernel, source: str) -> dict[str, Slot]:
    """The columns that the model knows; the others are extras.

    Raises:
        InvalidSplats: a column of the kernel is missing, there is an odd number of them, or the model is another.
    """
    for name in SCAFFOLD:
        if name in names:
            got = f"anchors of Scaffold-GS, which its networks turn into splats (property {name!r})"
            raise InvalidSplats(source, expected="splats", got=got, hint="export the splats themselves")
    slots = _required(kernel)
    for name in slots:
        if name not in names:
            some = ", ".join([*names[:8], "..."] if len(names) > 8 else names)
            raise InvalidSplats(
                source,
                expected=f"the property {name!r} of a {kernel} splat",
                got=f"{len(names)} properties without it ({some})",
                hint=f"the nearest dialect is {nearest_dialect(names)}",
            )
    slots |= _colour(names, source)
    if kernel is Kernel.BETA:
        slots |= _lobes(names, source)
    return slots


def usual_layout(kernel: Kernel, sh_rows: int, lobes: int) -> tuple[str, ...]:
    """The column order of the kernel's own trainer, for ``sh_rows`` coefficients a channel and S lobes."""
    is_beta = kernel is Kernel.BETA
    first, rest = ("sh0", "shN") if is_beta else ("f_dc", "f_rest")
    names = ["x", "y", "z", *NORMALS]
    if sh_rows:
        names += [f"{first}_{i}" for i in range(3)]
        names += [f"{rest}_{i}" for i in range(3 * (sh_rows - 1))]
    names += [f"sb_params_{i}" for i in range(LOBE_CHANNELS * lobes)]
    names += ["opacity", *(["beta"] if is_beta else [])]
    names += [f"scale_{i}" for i in range(scale_count(kernel))]
    return (*names, *(f"rot_{i}" for i in range(4)))


def scale_count(kernel: Kernel) -> int:
    """Two for the flat splats of 2DGS, three for the others."""
    return 2 if kernel is Kernel.GAUSSIAN_2D else 3


def nearest_dialect(names: Collection[str]) -> str:
    """The dialect that shares most of these columns."""
    found = set(names)
    return max(_SIGNATURES, key=lambda dialect: len(_SIGNATURES[dialect] & found) / len(_SIGNATURES[dialect]))


def _required(kernel: Kernel) -> dict[str, Slot]:
    slots = {axis: Slot("means", (i,)) for i, axis in enumerate("xyz")}
    slots["opacity"] = Slot("opacity_logits", ())
    slots |= {f"scale_{i}": Slot("log_scales", (i,)) for i in range(scale_count(kernel))}
    slots |= {f"rot_{i}": Slot("quats", (i,)) for i in range(4)}
    if kernel is Kernel.BETA:
        slots["beta"] = Slot("beta", ())
    return slots


def _colour(names: Sequence[str], source: str) -> dict[str, Slot]:
    first, rest = ("sh0", "shN") if "sh0_0" in names else ("f_dc", "f_rest")
    base = _numbered(names, first, source)
    higher = _numbered(names, rest, source)
    if not base and not higher:
        return {}
    rows = higher // 3
    complete = [(degree + 1) ** 2 - 1 for degree in range(MAX_SH_DEGREE + 1)]
    if base != 3 or higher % 3 or rows not in complete:
        counts = ", ".join(str(3 * count) for count in complete)
        raise InvalidSplats(
            source,
            expected=f"3 properties {first}_* and {counts} properties {rest}_* (degree 0..{MAX_SH_DEGREE})",
            got=f"{base} and {higher}",
            hint=f"the nearest dialect is {nearest_dialect(names)}",
        )
    slots = {f"{first}_{c}": Slot("sh", (0, c)) for c in range(3)}
    return slots | {f"{rest}_{i}": Slot("sh", (1 + i % rows, i // rows)) for i in range(higher)}


def _lobes(names: Sequence[str], source: str) -> dict[str, Slot]:
    count = _numbered(names, "sb_params", source)
    if count % LOBE_CHANNELS:
        raise InvalidSplats(source, expected=f"a multiple of {LOBE_CHANNELS} properties sb_params_*", got=str(count))
    lobes = count // LOBE_CHANNELS
    return {f"sb_params_{i}": Slot("sb_params", (i % lobes, i // lobes)) for i in range(count)}


def _numbered(names: Sequence[str], stem: str, source: str) -> int:
    """How many columns ``stem_0, stem_1, ...`` there are; they must have no gap."""
    pattern = re.compile(re.escape(stem) + r"_(0|[1-9][0-9]{0,5})")
    indices = sorted(int(match[1]) for match in map(pattern.fullmatch, names) if match)
    for wanted, found in enumerate(indices):
        if found != wanted:
            raise InvalidSplats(
                source,
                expected=f"the property '{stem}_{wanted}'",
                got=f"'{stem}_{found}' without it",
                hint=f"the nearest dialect is {nearest_dialect(names)}",
            )
    return len(indices)
