"""Labelled data sets over lifts: every protocol on every scene, and the means that papers print."""

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
) -> list[Judgement]:
    """Compare a frame's objects with what a protocol found for their categories."""
    rows = []
    for thing in objects:
        found = predictions[thing.category]
        truth = int(thing.mask.sum())
        rows.append(
            Judgement(
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


def means(rows: Sequence[Judgement]) -> Means:
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


def pooled_ious(rows: Sequence[Judgement]) -> dict[str, float]:
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


ALL, HELD_OUT = "all labelled", "held out"


@dataclass(frozen=True)
class EvaluationSettings:
    """What is measured, and how."""

    protocols: tuple[EvaluationProtocol, ...] = tuple(EvaluationProtocol)
    threshold: str | float = "auto"  # of P3's maps, and of the splats of P2 and our own; P1 has its own
    negatives: tuple[str, ...] = ()  # P1: instead of LangSplat's four; else of each question
    held_out: frozenset[str] | None = None  # the only frames to judge; None = all that are labelled


@dataclass(frozen=True)
class SceneResult:
    """One protocol on one scene."""

    scene: str
    protocol: EvaluationProtocol
    rows: tuple[Judgement, ...]

    @property
    def frames(self) -> tuple[str, ...]:
        """The frames that were judged."""
        return tuple(dict.fromkeys(row.view for row in self.rows))

    @property
    def lifted(self) -> tuple[str, ...]:
        """Those whose own features went into the lift."""
        return tuple(dict.fromkeys(row.view for row in self.rows if row.lifted))

    def means(self) -> dict[str, Means]:
        """Over all frames, and over the held-out ones where there are some of either kind."""
        groups = {ALL: means(self.rows)}
        if self.lifted and len(self.lifted) < len(self.frames):
            groups[HELD_OUT] = means([row for row in self.rows if not row.lifted])
        return groups

    def classes(self) -> dict[str, float]:
        """Class -> IoU over the pixels of all frames."""
        return pooled_ious(self.rows)


def evaluate_scene(
    labels: LabelledScene,
    scene: Scene,
    encoder: TextEncoder,
    settings: EvaluationSettings,
    progress: Progress = silent,
) -> tuple[list[SceneResult], list[str]]:
    """All protocols on one scene, and what is to be said about it.

    Args:
        labels: the ground truth. scene: the opened lift of this scene. encoder: of its text space.
        settings: what is measured.
        progress: told about a stage a protocol, in frames.

    Raises:
        InvalidInput: the labels are malformed, no labelled frame has a camera, or none is among the held-out ones.
        InvalidQuery: the encoder can read none of the categories, or not a negative, or is not of the lift's space.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    if encoder.channels != scene.channels:
        space = scene.metadata.text_space or "not named"
        expected = f"{scene.channels} channels as the lift of {labels.name} has (its text space: {space})"
        raise InvalidQuery("encoder", expected=expected, got=f"{encoder.name} with {encoder.channels}")
    truth, warnings = _truth(labels, scene, settings.held_out)
    lifted = frozenset(scene.metadata.views) & truth.keys()
    if lifted and settings.held_out is not None:
        warnings.append(f"{labels.name}: {_named(lifted)} were lifted, though the list holds them out")
    elif lifted:
        warnings.append(f"{labels.name}: {len(lifted)} of {len(truth)} judged frames were lifted: {_named(lifted)}")
    if not isinstance(encoder, CachingEncoder):  # each protocol asks for the same words
        encoder = CachingEncoder(encoder)
    protocols, unmeasured = _measurable(settings, encoder)
    warnings += [f"{labels.name}: {text}" for text in unmeasured]
    texts, unknown = _readable(truth, encoder)
    if unknown:
        warnings.append(f"{labels.name}: {encoder.name} lacks {_named(unknown)}: left out")
        truth = {view: [thing for thing in things if thing.category in texts] for view, things in truth.items()}
    results = []
    for protocol in protocols:
        segmenter = SEGMENTERS[protocol](scene, texts, encoder, settings.threshold, settings.negatives)
        rows: list[Judgement] = []
        for done, (view, things) in enumerate(truth.items(), start=1):
            rows += judge(protocol, view, things, segmenter.predict_view(view), lifted=view in lifted)
            progress(f"{labels.name} {protocol}", done, len(truth), "frames")
        results.append(SceneResult(labels.name, protocol, tuple(rows)))
    return results, warnings


def _measurable(settings: EvaluationSettings, encoder: TextEncoder) -> tuple[list[EvaluationProtocol], list[str]]:
    """The protocols whose own negatives the encoder reads, and a warning of one that is left out.

    Raises:
        InvalidQuery: none is left.
    """
    lacking: list[str] = []
    for text in () if settings.negatives else DEFAULT_NEGATIVES:
        try:
            encoder.encode([text])
        except InvalidQuery:
            lacking.append(text)
    protocols = [one for one in settings.protocols if not (lacking and one is EvaluationProtocol.P1)]
    if len(protocols) == len(settings.protocols):
        return protocols, []
    expected = f"an encoder that reads its negatives ({', '.join(DEFAULT_NEGATIVES)})"
    got, hint = f"{encoder.name} without {_named(lacking)}", "give negatives= that it has, or another encoder"
    if not protocols:
        raise InvalidQuery("encoder of P1", expected=expected, got=got, hint=hint)
    return protocols, [f"P1 is left out: it needs {expected}, got {got}; {hint}"]


def _readable(
    truth: Mapping[str, Sequence[LabelledObject]], encoder: TextEncoder
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The categories that the encoder can read, and those that it cannot.

    Raises:
        InvalidQuery: it can read none.
    """
    known, unknown, last = [], [], None
    for text in dict.fromkeys(thing.category for things in truth.values() for thing in things):
        try:
            encoder.encode([text])
            known.append(text)
        except InvalidQuery as error:
            unknown.append(text)
            last = error
    if last is not None and not known:
        raise last
    return tuple(known), tuple(unknown)


def mean_over_scenes(results: Sequence[SceneResult]) -> dict[EvaluationProtocol, dict[str, Means]]:
    """Protocol -> the mean of its scenes' means; over held-out frames where every scene has such a mean."""
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
    """Frame -> its objects, of the frames that are asked for and have a camera; the others are warned of."""
    wanted = [view for view in labels.views if held_out is None or view in held_out]
    if not wanted:
        got = f"{_named(labels.views)}" if labels.views else "none"
        raise InvalidInput(f"labelled frames of {labels.name}", expected="some of the held-out ones", got=got)
    cameras = scene.cameras
    paired = [view for view in wanted if view in cameras]
    if not paired:
        raise InvalidInput(
            f"labelled frames of {labels.name}",
            expected=f"frames named like the lift's cameras ({_named(cameras)})",
            got=_named(wanted),
        )
    warnings = []
    if len(paired) < len(wanted):
        lost = [view for view in wanted if view not in cameras]
        warnings.append(f"{labels.name}: {_named(lost)} have labels but no camera and were skipped")
    truth = {view: labels.objects(view, *cameras[view].photo_size) for view in paired}
    empty = [view for view, things in truth.items() if not any(thing.mask.any() for thing in things)]
    if empty:
        warnings.append(f"{labels.name}: {_named(empty)} have no labelled object")
    absent = _absent(truth)
    if absent:
        warnings.append(f"{labels.name}: {_named(absent)} cover no pixel of some frames and have no IoU there")
    return truth, warnings


def _absent(truth: Mapping[str, list[LabelledObject]]) -> list[str]:
    return list(dict.fromkeys(t.category for things in truth.values() for t in things if not t.mask.any()))


def _named(names: Collection[str]) -> str:
    shown = sorted(names)[:4]
    return ", ".join(shown) + (f" and {len(names) - len(shown)} more" if len(names) > len(shown) else "")
