"""See an answer from a camera: where its objects are in the view, and the attention of every pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from liftcore.query.directions import MINIMUM_ROW_SUM
from liftcore.query.objects import Objects, objects

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import Tensor

    from liftcore.query.ask import Answer
    from liftcore.query.scene import QueryScene

LEAST_SHARE = 0.5  # of a ray's weight, that what was found must have in a mask
MOST_GROUPED = 1 << 17  # selected splats whose strays a mask leaves out: they take .4 s of two cores


@dataclass(frozen=True)
class ViewMask:
    """An answer seen from one camera."""

    view: str
    attention: Tensor  # [H, W] f32, A s: the scores rendered with the lift's rendering gain
    row_sums: Tensor  # [H, W] f32, A 1
    mask: Tensor  # [H, W] bool, where at least half of a ray that meets the scene is of what was found
    explanation: str  # one sentence on what the mask shows


def view_mask(
    scene: QueryScene, answer: Answer, view: str, group: Callable[[QueryScene, Answer], Objects] = objects
) -> ViewMask:
    """See an answer from a camera: attention, and a mask of the objects that were found.

    The mask is ``A m >= A 1 / 2``, with m = 1 for the splats of the answer's objects: what was found in the scene,
    where nothing hides it. It has no threshold of its own, so a view that does not see it has an empty mask. Of more
    than 131,072 selected splats strays are not told apart, unless the query keeps the largest object.

    Args:
        scene: the opened lift.
        answer: of that lift.
        view: the name of a camera, lifted or not.
        group: makes the objects of an answer; who has them already gives them so.

    Raises:
        NotFound: no camera has this name.
        InvalidQuery: the view's image is larger than pictures may be; or the largest of more splats than are grouped.
        InvalidLift: the splats or the cameras moved or changed since the lift.
    """
    scene.cameras[view]  # a name that is not there is told before anything is grouped
    if answer.count > MOST_GROUPED and answer.query.keep == "all":
        members, shown = answer.selected, f"all {answer.count} selected splats, too many to tell strays apart"
    else:
        found = group(scene, answer)
        members, count = torch.from_numpy(found.numbers >= 0), len(found.found)
        shown = f"the {count} object{'s' * (count != 1)} that {'were' if count != 1 else 'was'} found"
    # A splat without a feature adds nothing to a ray; its score of -1 would count against its neighbours.
    scores = torch.where(answer.seen, answer.scores, 0.0)
    values = torch.stack([scores, members.float(), torch.ones_like(scores)], dim=1)
    image = scene.image(view, lambda camera: scene.raster.render(camera, values, scene.walk))
    attention, weights, row_sums = (image[..., column].contiguous() for column in range(3))
    mask = (row_sums >= MINIMUM_ROW_SUM) & (weights >= LEAST_SHARE * row_sums)
    return ViewMask(view, attention, row_sums, mask, f"at least half of the ray is of {shown}")
