"""Predictions against the truth: one row an object of a frame, and the means that papers print."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

from liftcore.evaluate.protocols import EvaluationProtocol

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from liftcore.evaluate.protocols import LabelledObject, Prediction


@dataclass(frozen=True)
class Judged:
    """One text in one frame."""

    view: str
    category: str
    intersection: int  # pixels that are predicted and true
    union: int  # pixels that are either
    truth: int  # pixels that are true; 0 = the category is not in the frame
    localised: bool | None  # None where the protocol has no peak, or nothing is to be found
    lifted: bool  # whether the frame's own features went into the lift

    @property
    def iou(self) -> float | None:
        """Intersection over union, None where nothing is to be found."""
        return self.intersection / self.union if self.truth else None


@dataclass(frozen=True)
class Means:
    """Means over judged objects, each 0..1; None where there was nothing to average."""

    frames: int
    objects: int  # that are in their frames
    object_micro: float | None  # mean IoU over all objects of all frames (LangSplat, LaGa)
    frame_macro: float | None  # mean over frames of the mean over their objects (Splat Feature Solver's code)
    class_pooled: float | None  # mean over classes of IoU over the pixels of all frames (3D-OVS)
    localised: float | None  # share of objects whose peak is where the protocol wants it (mAcc of P1 and P3)
    accuracy_25: float | None  # share of objects with an IoU of at least 0.25 (mAcc of P2)
    accuracy_50: float | None


def judge(
    protocol: EvaluationProtocol,
    view: str,
    objects: Sequence[LabelledObject],
    predictions: Mapping[str, Prediction],
    *,
    lifted: bool,
) -> list[Judged]:
    """Compare a frame's objects with what a protocol found for their categories."""
    rows = []
    for thing in objects:
        found = predictions[thing.category]
        truth = int(thing.mask.sum())
        rows.append(
            Judged(
                view=view,
                category=thing.category,
                intersection=int((found.mask & thing.mask).sum()),
                union=int((found.mask | thing.mask).sum()),
                truth=truth,
                localised=_localised(protocol, thing, found.peak) if truth else None,
                lifted=lifted,
            )
        )
    return rows


def _localised(protocol: EvaluationProtocol, thing: LabelledObject, peak: tuple[int, int] | None) -> bool | None:
    if peak is None:
        return None
    x, y = peak
    if protocol is EvaluationProtocol.P1:
        return any(x1 <= x <= x2 and y1 <= y <= y2 for x1, y1, x2, y2 in thing.boxes)
    return bool(thing.mask[y, x])


def means(rows: Sequence[Judged]) -> Means:
    """The means over some rows; objects that are not in their frames count in the pooled IoU alone."""
    present = [(row, iou) for row in rows if (iou := row.iou) is not None]
    by_frame: dict[str, list[float]] = defaultdict(list)
    for row, iou in present:
        by_frame[row.view].append(iou)
    ious = [iou for _, iou in present]
    return Means(
        frames=len({row.view for row in rows}),
        objects=len(present),
        object_micro=_mean(ious),
        frame_macro=_mean(_mean(frame) for frame in by_frame.values()),
        class_pooled=_mean(pooled_ious(rows).values()),
        localised=_mean(float(row.localised) for row, _ in present if row.localised is not None),
        accuracy_25=_mean(float(iou >= 0.25) for iou in ious),
        accuracy_50=_mean(float(iou >= 0.5) for iou in ious),
    )


def pooled_ious(rows: Sequence[Judged]) -> dict[str, float]:
    """Class -> IoU over the pixels of all its frames, for the classes that are in one at least."""
    shared: dict[str, int] = defaultdict(int)
    either: dict[str, int] = defaultdict(int)
    for row in rows:
        shared[row.category] += row.intersection
        either[row.category] += row.union
    present = dict.fromkeys(row.category for row in rows if row.truth)
    return {name: shared[name] / either[name] for name in present}


def mean_of_scenes(scenes: Sequence[Means]) -> Means:
    """The mean of the scenes' means, each scene once however many objects it has, as the papers' last column."""
    columns = ("object_micro", "frame_macro", "class_pooled", "localised", "accuracy_25", "accuracy_50")
    return Means(
        frames=sum(scene.frames for scene in scenes),
        objects=sum(scene.objects for scene in scenes),
        **{name: _mean(getattr(scene, name) for scene in scenes) for name in columns},
    )


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None
