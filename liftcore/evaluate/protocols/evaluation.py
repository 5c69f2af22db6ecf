"""A labelled dataset over lifts: every protocol on every scene, and which frames were lifted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from liftcore.errors import InvalidInput, InvalidQuery
from liftcore.evaluate.protocols import EvaluationProtocol
from liftcore.evaluate.protocols.judging import Judged, Means, judge, mean_of_scenes, means, pooled_ious
from liftcore.progress import Progress, silent
from liftcore.query.scores import DEFAULT_NEGATIVES
from liftcore.scene.cameras import photo_size

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from liftcore.evaluate.protocols import LabelledObject, LabelledScene, Segmenter
    from liftcore.query.encoders import TextEncoder
    from liftcore.query.scene import QueryScene

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
    rows: tuple[Judged, ...]

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
    scene: QueryScene,
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
        InvalidQuery: the encoder cannot read a category or a negative, or is not of the lift's space.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    if encoder.channels != scene.channels:
        space = scene.lift.metadata.text_space or "none"
        expected = f"{scene.channels} channels as the lift of {labels.name} has (its text space: {space})"
        raise InvalidQuery("encoder", expected=expected, got=f"{encoder.name} with {encoder.channels}")
    truth, warnings = _truth(labels, scene, settings.held_out)
    lifted = frozenset(scene.lift.metadata.views) & truth.keys()
    if lifted and settings.held_out is not None:
        warnings.append(f"{labels.name}: {_named(lifted)} were lifted, though the list holds them out")
    elif lifted:
        warnings.append(f"{labels.name}: {len(lifted)} of {len(truth)} judged frames were lifted: {_named(lifted)}")
    texts = tuple(dict.fromkeys(thing.category for things in truth.values() for thing in things))
    results = []
    for protocol in settings.protocols:
        segmenter = open_segmenter(protocol, scene, texts, encoder, settings)
        rows: list[Judged] = []
        for done, (view, things) in enumerate(truth.items(), start=1):
            rows += judge(protocol, view, things, segmenter.look(view), lifted=view in lifted)
            progress(f"{labels.name} {protocol}", done, len(truth), "frames")
        results.append(SceneResult(labels.name, protocol, tuple(rows)))
    return results, warnings


def open_segmenter(
    protocol: EvaluationProtocol,
    scene: QueryScene,
    texts: Sequence[str],
    encoder: TextEncoder,
    settings: EvaluationSettings,
) -> Segmenter:
    """A protocol on a lift, for the texts."""
    if protocol is EvaluationProtocol.P1:
        from liftcore.evaluate.protocols.rendered_features import RenderedFeatures

        return RenderedFeatures(scene, texts, encoder, settings.negatives or DEFAULT_NEGATIVES)
    if protocol is EvaluationProtocol.P2:
        from liftcore.evaluate.protocols.selected_splats import SelectedSplats

        return SelectedSplats(scene, texts, encoder, settings.threshold, settings.negatives)
    if protocol is EvaluationProtocol.OWN:
        from liftcore.evaluate.protocols.own_masks import OwnMasks

        return OwnMasks(scene, texts, encoder, settings.threshold, settings.negatives)
    from liftcore.evaluate.protocols.rendered_scores import RenderedScores

    return RenderedScores(scene, texts, encoder, settings.threshold, settings.negatives)


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
    labels: LabelledScene, scene: QueryScene, held_out: Collection[str] | None
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
    truth = {view: labels.objects(view, *photo_size(cameras[view])) for view in paired}
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
