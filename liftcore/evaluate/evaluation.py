"""Evaluation of a lift by masks of phrases in its views, by the protocol of LaGa and *Splat Feature Solver* (P3).

Splats are scored in 3D, the scores are rendered, and each map is cut by a threshold of its own. A phrase is localised
if the peak of its map lies in its mask. Masks are those of a feature pack that `splatlift pack prompts` writes; their
pixels without a label count nowhere.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from liftcore.errors import InvalidInput, InvalidQuery
from liftcore.query.areas import MINIMUM_ROW_SUM
from liftcore.query.ask import ask
from liftcore.query.question import Query
from liftcore.query.scene import Scene
from liftcore.query.threshold import find_threshold
from liftcore.runtime.arguments import as_list, as_path
from liftcore.runtime.progress import Progress, shown_progress
from liftcore.scene.views import cameras_of_views, first_names
from liftcore.values.pack import Views, read_features
from liftcore.values.views import Regions, cells_under

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from torch import Tensor

    from liftcore.text import TextEncoder

ALL, HELD_OUT = "all labelled", "held out"
KINDS = ("objects", "frames", "classes")  # of means
LEAST_COSINE = 0.5  # cosine of a region's vector and a phrase's: regions of phrases have one or zero


@dataclass(frozen=True)
class PhraseInView:
    """The comparison of a phrase's mask in a view with its label."""

    view: str
    phrase: str
    intersection: int  # pixels that are predicted and true
    union: int  # pixels that are either
    truth: int  # pixels that are true; 0: the view does not show the phrase
    localised: bool | None  # None if the view does not show the phrase
    lifted: bool  # True if the view's own features are in the lift

    @property
    def iou(self) -> float | None:
        """Intersection over union; None if the view does not show the phrase."""
        return self.intersection / self.union if self.truth else None


@dataclass(frozen=True)
class Means:
    """Means of phrases in views, each 0..1; None without any."""

    frames: int
    objects: int  # phrases that their views show
    object_micro: float | None  # mean IoU over all phrases of all views (LangSplat, LaGa)
    frame_macro: float | None  # mean over views of the mean over their phrases (Splat Feature Solver's code)
    class_pooled: float | None  # mean over phrases of IoU over the pixels of all views (3D-OVS)
    localised: float | None  # share of phrases whose peak is in their mask (mAcc)


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation."""

    objects: tuple[PhraseInView, ...]
    warnings: tuple[str, ...]

    def means(self) -> dict[str, Means]:
        """Average over all labelled views, and over the held-out ones if some were lifted and some were not."""
        groups = {ALL: means(self.objects)}
        if held_out := [row for row in self.objects if not row.lifted]:
            groups |= {HELD_OUT: means(held_out)} if len(held_out) < len(self.objects) else {}
        return groups

    def document(self) -> dict[str, Any]:
        """Return all figures, ready for JSON."""
        return {
            "means": {group: asdict(values) for group, values in self.means().items()},
            "classes": pooled_ious(self.objects),
            "objects": [{**asdict(row), "iou": row.iou} for row in self.objects],
            "warnings": list(self.warnings),
        }

    def lines(self) -> Iterable[str]:
        """Yield the means, the IoU of each phrase and the warnings, a line each."""
        for group, figures in self.means().items():
            shares = map(_percent, (figures.object_micro, figures.frame_macro, figures.class_pooled))
            ious = ", ".join(f"{share} over {kind}" for share, kind in zip(shares, KINDS, strict=True))
            yield (
                f"{group}: {figures.objects} objects in {figures.frames} frames, mIoU {ious}; "
                f"{_percent(figures.localised)} localised"
            )
        yield from (f"  {phrase}: IoU {_percent(iou)}" for phrase, iou in pooled_ious(self.objects).items())
        yield from (f"warning: {text}" for text in self.warnings)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.1%}"


def evaluate_lift(
    lift: Scene | Path | str,
    labels: Views | Path | str | Sequence[Path | str],
    *,
    encoder: TextEncoder | str | None = None,
    threshold: str | float = "auto",
    negatives: str | Sequence[str] = (),
    progress: Progress | bool | None = None,
) -> Evaluation:
    """Compare the masks of a lift's queries with labels of its views.

    Args:
        lift: an opened scene, or the path of a lift. labels: masks of phrases, as `pack_folder` of ``prompts`` makes
            them.
        encoder: of the phrases, or its specification; None: that of the lift's text space.
        threshold: of the rendered scores, a method or a number. negatives: texts that compete with each phrase.
        progress: as in `liftcore.lift`; reports a stage "evaluate", in frames.

    Raises:
        InvalidInput: labels without phrases, or of no view of the lift's cameras.
        InvalidQuery: the encoder can encode none of the phrases, or not a negative, or is of another space.
        InvalidLift: the splats or the cameras moved or changed since the lift.
        Unavailable: as in `Scene.encoder`.
    """
    scene = lift if isinstance(lift, Scene) else Scene(as_path(lift, "lift"))
    labels = labels if isinstance(labels, Views) else read_features(*as_list(labels))
    if labels.table is None or not all(map(labels.is_regions, labels)):
        hint = "splatlift pack prompts makes one of pictures or COCO's JSON"
        raise InvalidInput("labels", expected="a pack of masks of phrases", got="a pack without phrases", hint=hint)
    words = scene.encoder(encoder, hint="give encoder=", stand_in=False)
    if words.channels != scene.channels:
        expected = (
            f"{scene.channels} channels as the lift has (its text space: {scene.metadata.text_space or 'none'})"
        )
        raise InvalidQuery("encoder", expected=expected, got=f"{words.name} with {words.channels}")
    cameras = cameras_of_views(labels, scene.cameras)
    if not cameras:
        expected = f"views named like the lift's cameras ({first_names(scene.cameras)})"
        raise InvalidInput("labels", expected=expected, got=first_names(labels))
    phrases, warnings = _readable(labels.table.words, words)
    if unpaired := [view for view in labels if view not in cameras]:
        warnings.append(f"{first_names(unpaired)} have labels but no camera and were skipped")
    if lifted := set(scene.metadata.views).intersection(cameras.values()):
        warnings.append(f"{len(lifted)} of {len(cameras)} labelled views were lifted: {first_names(sorted(lifted))}")
    query_texts = tuple(as_list(negatives))
    # In quotes, as labels are names whatever is in them: "other furniture", "salt and pepper shakers".
    queries = {phrase: Query.of(f'"{phrase}"', query_texts, threshold=threshold) for phrase in phrases}
    answers = [ask(scene, query, words) for query in queries.values()]
    # A splat without a feature adds nothing to a ray.
    columns = [np.where(answer.has_feature, answer.scores, np.float32(0.0)) for answer in answers]
    scores = torch.from_numpy(np.stack([*columns, np.ones(len(scene.features), np.float32)], axis=1))
    embeddings = dict(zip(labels.table.words, torch.as_tensor(labels.table.embeddings), strict=True))
    rows: list[PhraseInView] = []
    with shown_progress(progress) as reporter:
        for number, (view, camera) in enumerate(cameras.items(), start=1):
            image = scene.image(camera, lambda of: scene.raster.render(of, scores, scene.compositing))
            hit, regions = image[..., -1] >= MINIMUM_ROW_SUM, labels[view]
            assert isinstance(regions, Regions)
            for k, (phrase, query) in enumerate(queries.items()):
                truth, labelled = phrase_mask(regions, embeddings[phrase], image.shape[:2])
                attention = image[..., k].contiguous()
                predicted = hit & (attention >= find_threshold(attention[hit], query.threshold).value) & labelled
                peak = bool(truth.flatten()[attention.argmax()])
                shared, union, pixels = (int(mask.sum()) for mask in (predicted & truth, predicted | truth, truth))
                is_lifted = camera in scene.metadata.views
                localised = peak if pixels else None
                rows.append(PhraseInView(view, phrase, shared, union, pixels, localised, is_lifted))
            reporter("evaluate", number, len(cameras), "frames")
    if absent := [phrase for phrase in phrases if not any(row.truth for row in rows if row.phrase == phrase)]:
        warnings.append(f"{first_names(absent)} are in none of these views")
    return Evaluation(tuple(rows), tuple(warnings))


def _readable(phrases: Sequence[str], encoder: TextEncoder) -> tuple[list[str], list[str]]:
    """Return the phrases that the encoder can encode, and a warning of the others.

    Raises:
        InvalidQuery: it can encode none.
    """
    readable, unreadable, last = list[str](), list[str](), None
    for phrase in phrases:
        try:
            encoder.encode([phrase])
            readable.append(phrase)
        except InvalidQuery as error:
            unreadable.append(phrase)
            last = error
    if last is not None and not readable:
        raise last
    return readable, [f"{encoder.name} lacks {first_names(unreadable)}: left out"] if unreadable else []


def phrase_mask(regions: Regions, embedding: Tensor, size: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return the mask of a phrase and that of all labelled pixels in a picture: [H, W] bool each.

    Args:
        embedding: [F], the phrase's vector. size: H and W.
    """
    y, x = (
        cells_under(torch.arange(side), side, cells)
        for side, cells in zip(size, regions.labels.shape[1:], strict=True)
    )
    labels = regions.labels[:, y][:, :, x].long()
    shows_phrase = torch.cat([regions.codebook.float() @ embedding.float() > LEAST_COSINE, torch.tensor([False])])
    return shows_phrase[labels].any(dim=0), (labels >= 0).any(dim=0)  # NO_LABEL, -1, reads the last entry


def means(rows: Sequence[PhraseInView]) -> Means:
    """Average rows; phrases that their views do not show count in the pooled IoU alone."""
    with_iou = [(row, iou) for row in rows if (iou := row.iou) is not None]
    by_view: dict[str, list[float]] = defaultdict(list)
    for row, iou in with_iou:
        by_view[row.view].append(iou)
    return Means(
        frames=len({row.view for row in rows}),
        objects=len(with_iou),
        object_micro=_mean([iou for _, iou in with_iou]),
        frame_macro=_mean([sum(ious) / len(ious) for ious in by_view.values()]),
        class_pooled=_mean([*pooled_ious(rows).values()]),
        localised=_mean([float(row.localised or False) for row, _ in with_iou]),
    )


def pooled_ious(rows: Sequence[PhraseInView]) -> dict[str, float]:
    """Compute the IoU over the pixels of all views, phrase -> IoU, of phrases that some view shows."""
    shared: dict[str, int] = defaultdict(int)
    union: dict[str, int] = defaultdict(int)
    for row in rows:
        shared[row.phrase] += row.intersection
        union[row.phrase] += row.union
    return {
        phrase: shared[phrase] / union[phrase] for phrase in dict.fromkeys(row.phrase for row in rows if row.truth)
    }


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None
