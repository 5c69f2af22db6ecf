"""Whether a peer computes the same X: a peer that does not is none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from tests.benchmarks.peers.work import Answer

SAME = 0.999  # cosine from which X counts as the same: others cap alphas or end rays a little differently
SEEN = 1.0  # a splat's total from which a single difference counts: below, one ray at a cut-off decides all


@dataclass(frozen=True)
class Agreement:
    """A peer's X beside ours."""

    cosine: float  # of a splat's two features, the mean by evidence
    error: float  # the largest difference of a channel, over splats with a total of SEEN

    @property
    def same(self) -> bool:
        """Whether both are one X, up to rounding and cut-offs."""
        return self.cosine >= SAME


def agreement(ours: Answer, theirs: Answer) -> Agreement:
    """How near ``theirs`` is; evidence is our total."""
    evidence = ours.totals
    cosines = torch.nn.functional.cosine_similarity(ours.features, theirs.features, dim=1)
    seen = evidence >= SEEN
    differences = (ours.features[seen] - theirs.features[seen]).abs()
    error = float(differences.max()) if differences.numel() else 0.0
    return Agreement(float((cosines.double() * evidence).sum() / evidence.sum()), error)
