"""Numbers that papers print, for comparison with measured ones; the two are never averaged.

*Splat Feature Solver* uses the protocol of LaGa (P3). Rows that it marks with a dagger are copied from the methods'
own papers, whose protocols differ and are not stated in the table; a double dagger marks what its authors measured
with the methods' official code. Its ablation table swaps the columns Teatime and Ramen of its last row: the rows here
are those of the main table, which the appendix confirms.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

LERF_OVS, THREE_D_OVS = "lerf-ovs", "3d-ovs"
_LERF_SCENES: tuple[str, ...] = ("figurines", "teatime", "ramen", "waldo_kitchen")
_3D_SCENES: tuple[str, ...] = ("bed", "bench", "lawn", "room", "sofa")
_MAIN = "Splat Feature Solver, table LeRF OVS (a)"
_APPENDIX = "Splat Feature Solver, appendix table 3D-OVS"
_VALA = "VALA (3DV 2026), table 1"
_COPIED = "not stated (copied from the method's own paper)"
_DAGGER, _DOUBLE = "dagger", "double dagger"

# method, mark, figurines, teatime, ramen, waldo kitchen, mean: mIoU in %, as printed.
_LERF_ROWS: tuple[tuple[str, str, float, float, float, float, float], ...] = (
    ("LSeg", _DAGGER, 7.6, 21.7, 7.0, 29.9, 16.6),
    ("LERF", _DAGGER, 38.6, 45.0, 28.2, 37.9, 37.4),
    ("N2F2", _DAGGER, 47.0, 69.2, 56.6, 47.9, 54.4),
    ("LangSplat", _DAGGER, 25.9, 35.6, 29.3, 33.5, 31.1),
    ("LEGaussians", _DAGGER, 31.2, 34.5, 17.6, 17.3, 25.2),
    ("SuperGSeg", _DAGGER, 43.7, 55.3, 18.1, 26.7, 35.9),
    ("VLGS", _DAGGER, 58.1, 73.5, 61.4, 54.8, 62.0),
    ("SAGA", _DAGGER, 36.2, 19.3, 53.1, 14.4, 30.7),
    ("OpenGaussian", _DAGGER, 61.1, 59.1, 29.2, 31.9, 45.3),
    ("Gaussian Grouping", _DAGGER, 60.9, 40.0, 45.5, 38.7, 46.3),
    ("LaGa", _DOUBLE, 56.1, 68.9, 57.4, 64.6, 61.7),
    ("LaGa", _DAGGER, 64.1, 70.9, 55.6, 65.6, 64.0),
    ("Dr. Splat", _DOUBLE, 47.5, 66.2, 36.7, 47.5, 49.5),
    ("Dr. Splat", _DAGGER, 53.4, 57.2, 24.7, 39.1, 43.6),
    ("Occam's LGS", _DOUBLE, 60.1, 68.3, 55.3, 47.7, 57.8),
    ("Occam's LGS", _DAGGER, 58.6, 70.2, 51.0, 65.3, 61.3),
    ("Splat Feature Solver", "", 67.6, 68.5, 62.3, 62.1, 65.1),
)
# method, labels of the room, bed, bench, lawn, room, sofa, mean: mIoU in %, as printed.
_3D_ROWS: tuple[tuple[str, str, float, float, float, float, float, float], ...] = (
    ("LaGa", "original", 84.9, 83.3, 93.6, 93.1, 76.5, 86.3),
    ("LaGa", "mended", 84.9, 83.3, 93.6, 86.2, 76.5, 84.9),
    ("Splat Feature Solver", "original", 90.2, 93.2, 89.0, 85.5, 73.6, 86.3),
    ("Splat Feature Solver", "mended", 90.2, 93.2, 89.0, 92.7, 73.6, 87.7),
)
# method, protocol, mean mIoU, mean mAcc over the four scenes of LeRF-OVS, in %.
_VALA_ROWS: tuple[tuple[str, str, float, float], ...] = (
    ("LERF", "P1", 37.4, 73.6),
    ("LEGaussians", "P1", 24.6, 67.4),
    ("GOI", "P1", 42.0, 59.2),
    ("GAGS", "P1", 54.1, 81.7),
    ("LangSplat", "P1", 51.4, 84.3),
    ("LangSplatV2", "P1", 59.9, 84.1),
    ("Occam's LGS", "P1", 61.3, 82.5),
    ("VALA", "P1", 61.7, 86.4),
    ("LangSplat", "P2", 10.35, 13.64),
    ("LEGaussians", "P2", 16.21, 23.82),
    ("SuperGSeg", "P2", 35.94, 52.02),
    ("OpenGaussian", "P2", 38.36, 51.43),
    ("Dr. Splat", "P2", 43.29, 64.30),
    ("InstanceGaussian", "P2", 43.87, 61.09),
    ("Occam's LGS", "P2", 47.22, 74.84),
    ("VoteSplat", "P2", 50.10, 67.38),
    ("CAGS", "P2", 50.79, 69.62),
    ("VALA", "P2", 58.02, 82.85),
)
_VALA_SCENES = {"figurines": 60.38, "teatime": 70.61, "ramen": 45.41, "waldo_kitchen": 55.71}  # its mIoU by P2
_LIGHTSPLAT = "LightSplat (CVPR 2026)"


@dataclass(frozen=True)
class Published:
    """One row of a paper's table."""

    dataset: str
    method: str
    protocol: str  # P1, P2, P3, or the reason why it is unknown
    metric: str  # mIoU or mAcc
    scenes: Mapping[str, float]  # in %; empty where the paper gives the mean alone
    mean: float  # in %, as printed, which is not always the mean of the scenes
    source: str
    note: str  # the meaning of the paper's mark; "" = its own row


def published(dataset: str, scenes: Collection[str] | None = None) -> list[Published]:
    """Return the published rows of a dataset, or of some of its scenes; rows of means alone need all scenes."""
    rows = _lerf_ovs() if dataset == LERF_OVS else _three_d_ovs()
    if scenes is None:
        return rows
    is_complete = set(_LERF_SCENES if dataset == LERF_OVS else _3D_SCENES) <= set(scenes)
    return [row for row in rows if row.scenes.keys() & set(scenes) or (is_complete and not row.scenes)]


def _lerf_ovs() -> list[Published]:
    rows = []
    for method, mark, *scenes, mean in _LERF_ROWS:
        # LaGa's own paper measures by the protocol that is named after it.
        protocol = "P3" if mark != _DAGGER or method == "LaGa" else _COPIED
        notes = {_DAGGER: "as the method's own paper reports it", _DOUBLE: "measured with the method's official code"}
        values = dict(zip(_LERF_SCENES, scenes, strict=True))
        rows.append(Published(LERF_OVS, method, protocol, "mIoU", values, mean, _MAIN, notes.get(mark, "")))
    for method, protocol, *values in _VALA_ROWS:
        for metric, value in zip(("mIoU", "mAcc"), values, strict=True):
            is_own = method == "VALA"
            scenes = _VALA_SCENES if is_own and (protocol, metric) == ("P2", "mIoU") else {}
            note = "" if is_own else "as VALA's authors report it"
            rows.append(Published(LERF_OVS, method, protocol, metric, scenes, value, _VALA, note))
    rows.append(
        Published(LERF_OVS, "LightSplat", "P2", "mIoU", {}, 47.58, _LIGHTSPLAT, "taken from a list of results")
    )
    return rows


def _three_d_ovs() -> list[Published]:
    return [
        Published(
            THREE_D_OVS, method, "P3", "mIoU", dict(zip(_3D_SCENES, scenes, strict=True)), mean, _APPENDIX,
            f"with the {labels} labels of room",
        )
        for method, labels, *scenes, mean in _3D_ROWS
    ]  # fmt: skip
