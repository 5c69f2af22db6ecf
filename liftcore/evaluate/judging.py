"""Evaluation of lifts by labelled data sets: every protocol on every scene, and the means that papers print."""

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from liftcore.errors import InvalidInput, InvalidQuery
from liftcore.evaluate.labels import LabelledObject, LabelledScene
from liftcore.evaluate.protocols import SEGMENTERS, EvaluationProtocol, Prediction
from liftcore.query.scene import Scene
from liftcore.query.scores import DEFAULT_NEGATIVES
from liftcore.runtime.progress import Progress, silent
from liftcore.text import CachingEncoder, TextEncoder


@dataclass(frozen=True)
class Judgement:
    """The result of one text in one frame."""

    view: str
    category: str
    intersection: int  # pixels that are predicted and true
    union: int  # pixels that are either
    truth: int  # pixels that are true; 0 = the category is not in the frame
    localised: bool | None  # None if the protocol has no peak, or the category is not in the frame
    lifted: bool  # True if the frame's own features are in the lift

    @property
    def iou(self) -> float | None:
        """Intersection over union; None if the category is not in the frame."""
        return self.intersection / self.union if self.truth else None


@dataclass(frozen=True)
class Means:
    """Means over evaluated objects, each 0..1; None without an object."""

    frames: int
    objects: int  # that are in their frames
    object_micro: float | None  # mean IoU over all objects of all frames (LangSplat, LaGa)
    frame_macro: float | None  # mean over frames of the mean over their objects (Splat Feature Solver's code)
    class_pooled: float | None  # mean over classes of IoU over the pixels of all frames (3D-OVS)
    localised: float | None  # share of objects whose peak is where the protocol requires it (mAcc of P1 and P3)
    accuracy_25: float | None  # share of objects with an IoU of at least 0.25 (mAcc of P2)
    accuracy_50: float | None


def compare_frame(
    protocol: EvaluationProtocol,
    view: str,
    objects: Sequence[LabelledObject],
    predictions: Mapping[str, Prediction],
    *,
    lifted: bool,
) -> list[Judgement]:
    """Compare a frame's objects with a protocol's predictions for their categories."""
    rows = []
    for truth_object in objects:
        prediction = predictions[truth_object.category]
        truth = int(truth_object.mask.sum())
        rows.append(
            Judgement(
                view=view,
                category=truth_object.category,
                intersection=int((prediction.mask & truth_object.mask).sum()),
                union=int((prediction.mask | truth_object.mask).sum()),
                truth=truth,
                localised=_localised(protocol, truth_object, prediction.peak) if truth else None,
                lifted=lifted,
            )
        )
    return rows


def _localised(
    protocol: EvaluationProtocol, truth_object: LabelledObject, peak: tuple[int, int] | None
) -> bool | None:
    if peak is None:
        return None
    x, y = peak
    if protocol is EvaluationProtocol.P1:
        return any(x1 <= x <= x2 and y1 <= y <= y2 for x1, y1, x2, y2 in truth_object.boxes)
    return bool(truth_object.mask[y, x])


def means(rows: Sequence[Judgement]) -> Means:
    """Average rows; objects that are not in their frames count in the pooled IoU alone."""
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


def pooled_ious(rows: Sequence[Judgement]) -> dict[str, float]:
    """Compute the IoU over the pixels of all frames, class -> IoU, of classes that are in at least one frame."""
    shared: dict[str, int] = defaultdict(int)
    union: dict[str, int] = defaultdict(int)
    for row in rows:
        shared[row.category] += row.intersection
        union[row.category] += row.union
    present = dict.fromkeys(row.category for row in rows if row.truth)
    return {name: shared[name] / union[name] for name in present}


def mean_of_scenes(scenes: Sequence[Means]) -> Means:
    """Average the scenes' means, each scene with the same weight, as in the last column of papers."""
    columns = ("object_micro", "frame_macro", "class_pooled", "localised", "accuracy_25", "accuracy_50")
    return Means(
        frames=sum(scene.frames for scene in scenes),
        objects=sum(scene.objects for scene in scenes),
        **{name: _mean(getattr(scene, name) for scene in scenes) for name in columns},
    )


def _mean(values: Iterable[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return sum(present) / len(present) if present else None


ALL, HELD_OUT = "all labelled", "held out"


@dataclass(frozen=True)
class EvaluationSettings:
    """The settings of an evaluation."""

    protocols: tuple[EvaluationProtocol, ...] = tuple(EvaluationProtocol)
    threshold: str | float = "auto"  # of P3's maps, and of the splats of P2 and our own; P1 has its own
    negatives: tuple[str, ...] = ()  # P1: instead of LangSplat's four; else of each query
    held_out: frozenset[str] | None = None  # the only frames to evaluate; None: all labelled ones


@dataclass(frozen=True)
class SceneResult:
    """The result of one protocol on one scene."""

    scene: str
    protocol: EvaluationProtocol
    rows: tuple[Judgement, ...]

    @property
    def frames(self) -> tuple[str, ...]:
        """The evaluated frames."""
        return tuple(dict.fromkeys(row.view for row in self.rows))

    @property
    def lifted(self) -> tuple[str, ...]:
        """The frames whose own features are in the lift."""
        return tuple(dict.fromkeys(row.view for row in self.rows if row.lifted))

    def means(self) -> dict[str, Means]:
        """Average over all frames, and over the held-out ones if there are both kinds."""
        groups = {ALL: means(self.rows)}
        if self.lifted and len(self.lifted) < len(self.frames):
            groups[HELD_OUT] = means([row for row in self.rows if not row.lifted])
        return groups

    def classes(self) -> dict[str, float]:
        """Compute the IoU over the pixels of all frames, class -> IoU."""
        return pooled_ious(self.rows)


def evaluate_scene(
    labels: LabelledScene,
    scene: Scene,
    encoder: TextEncoder,
    settings: EvaluationSettings,
    progress: Progress = silent,
) -> tuple[list[SceneResult], list[str]]:
    """Evaluate one scene by all protocols; return warnings too.

    Args:
        labels: the ground truth. scene: the lift of this scene. encoder: of its text space.
        settings: of the evaluation.
        progress: reports a stage a protocol, in frames.

    Raises:
        InvalidInput: the labels are malformed, no labelled frame has a camera, or none is among the held-out ones.
        InvalidQuery: the encoder can encode none of the categories, or not a negative, or is of another space.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    if encoder.channels != scene.channels:
        space = scene.metadata.text_space or "not named"
        expected = f"{scene.channels} channels as the lift of {labels.name} has (its text space: {space})"
        raise InvalidQuery("encoder", expected=expected, got=f"{encoder.name} with {encoder.channels}")
    truth, warnings = _truth(labels, scene, settings.held_out)
    lifted = frozenset(scene.metadata.views) & truth.keys()
    if lifted and settings.held_out is not None:
        warnings.append(f"{labels.name}: {_first_names(lifted)} were lifted, though the list holds them out")
    elif lifted:
        warnings.append(
            f"{labels.name}: {len(lifted)} of {len(truth)} judged frames were lifted: {_first_names(lifted)}"
        )
    if not isinstance(encoder, CachingEncoder):  # each protocol encodes the same words
        encoder = CachingEncoder(encoder)
    protocols, unmeasured = _measurable(settings, encoder)
    warnings += [f"{labels.name}: {text}" for text in unmeasured]
    texts, unknown = _readable(truth, encoder)
    if unknown:
        warnings.append(f"{labels.name}: {encoder.name} lacks {_first_names(unknown)}: left out")
        truth = {
            view: [labelled for labelled in objects if labelled.category in texts] for view, objects in truth.items()
        }
    results = []
    for protocol in protocols:
        segmenter = SEGMENTERS[protocol](scene, texts, encoder, settings.threshold, settings.negatives)
        rows: list[Judgement] = []
        for completed, (view, objects) in enumerate(truth.items(), start=1):
            rows += compare_frame(protocol, view, objects, segmenter.predict_view(view), lifted=view in lifted)
            progress(f"{labels.name} {protocol}", completed, len(truth), "frames")
        results.append(SceneResult(labels.name, protocol, tuple(rows)))
    return results, warnings


def _measurable(settings: EvaluationSettings, encoder: TextEncoder) -> tuple[list[EvaluationProtocol], list[str]]:
    """Select the protocols whose negatives the encoder can encode, with a warning of one that is left out.

    Raises:
        InvalidQuery: none is left.
    """
    lacking: list[str] = []
    for text in () if settings.negatives else DEFAULT_NEGATIVES:
        try:
            encoder.encode([text])
        except InvalidQuery:
            lacking.append(text)
    protocols = [protocol for protocol in settings.protocols if not (lacking and protocol is EvaluationProtocol.P1)]
    if len(protocols) == len(settings.protocols):
        return protocols, []
    expected = f"an encoder that reads its negatives ({', '.join(DEFAULT_NEGATIVES)})"
    got, hint = f"{encoder.name} without {_first_names(lacking)}", "give negatives= that it has, or another encoder"
    if not protocols:
        raise InvalidQuery("encoder of P1", expected=expected, got=got, hint=hint)
    return protocols, [f"P1 is left out: it needs {expected}, got {got}; {hint}"]


def _readable(
    truth: Mapping[str, Sequence[LabelledObject]], encoder: TextEncoder
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Split the categories into those that the encoder can encode, and the others.

    Raises:
        InvalidQuery: it can encode none.
    """
    readable, unreadable, last = [], [], None
    for text in dict.fromkeys(labelled.category for objects in truth.values() for labelled in objects):
        try:
            encoder.encode([text])
            readable.append(text)
        except InvalidQuery as error:
            unreadable.append(text)
            last = error
    if last is not None and not readable:
        raise last
    return tuple(readable), tuple(unreadable)


def mean_over_scenes(results: Sequence[SceneResult]) -> dict[EvaluationProtocol, dict[str, Means]]:
    """Average the scenes' means by protocol; over held-out frames too if every scene has such a mean."""
    by_protocol: dict[EvaluationProtocol, list[dict[str, Means]]] = {}
    for result in results:
        by_protocol.setdefault(result.protocol, []).append(result.means())
    return {
        protocol: {
            group: mean_of_scenes([scene[group] for scene in scenes])
            for group in (ALL, HELD_OUT)
            if all(group in scene for scene in scenes)
        }
        for protocol, scenes in by_protocol.items()
    }


def _truth(
    labels: LabelledScene, scene: Scene, held_out: Collection[str] | None
) -> tuple[dict[str, list[LabelledObject]], list[str]]:
    """Read the objects of the requested frames that have a camera; return warnings of the others too."""
    requested = [view for view in labels.views if held_out is None or view in held_out]
    if not requested:
        got = f"{_first_names(labels.views)}" if labels.views else "none"
        raise InvalidInput(f"labelled frames of {labels.name}", expected="some of the held-out ones", got=got)
    cameras = scene.cameras
    paired = [view for view in requested if view in cameras]
    if not paired:
        raise InvalidInput(
            f"labelled frames of {labels.name}",
            expected=f"frames named like the lift's cameras ({_first_names(cameras)})",
            got=_first_names(requested),
        )
    warnings = []
    if len(paired) < len(requested):
        unpaired = [view for view in requested if view not in cameras]
        warnings.append(f"{labels.name}: {_first_names(unpaired)} have labels but no camera and were skipped")
    truth = {view: labels.objects(view, *cameras[view].photo_size) for view in paired}
    empty = [view for view, objects in truth.items() if not any(labelled.mask.any() for labelled in objects)]
    if empty:
        warnings.append(f"{labels.name}: {_first_names(empty)} have no labelled object")
    absent = _absent(truth)
    if absent:
        warnings.append(f"{labels.name}: {_first_names(absent)} cover no pixel of some frames and have no IoU there")
    return truth, warnings


def _absent(truth: Mapping[str, list[LabelledObject]]) -> list[str]:
    return list(dict.fromkeys(t.category for objects in truth.values() for t in objects if not t.mask.any()))


def _first_names(names: Collection[str]) -> str:
    first = sorted(names)[:4]
    return ", ".join(first) + (f" and {len(names) - len(first)} more" if len(names) > len(first) else "")
