"""The steps of `liftcore.solve.smooth` on a GPU, in float64.

``embedding_bag`` sums each row in a fixed order: a lift is bitwise reproducible on the same GPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

TABLE_BYTES = 1 << 29  # of each of the five tables [P, C] f64 of a block of channels


@dataclass(frozen=True)
class SmoothingSystem:
    """The matrix ``diag(w) + lambda L`` on a device, with rows in the graph's order."""

    starts: Tensor  # [P + 1] i64, of the rows' entries
    neighbours: Tensor  # [E] i64, rows
    couplings: Tensor  # [E] f64, lambda a_jk sqrt(w_j w_k)
    weights: Tensor  # [P] f64, w
    inverse: Tensor  # [P] f64, of the diagonal; zero without weight

    @property
    def channels(self) -> int:
        """The number of channels per block, a multiple of four, so that rows of float16 are whole 64-bit words."""
        return 4 * max(TABLE_BYTES // (32 * max(len(self.weights), 1)), 1)

    def descend(self, start: Tensor, steps: Sequence[tuple[float, float]]) -> Tensor:
        """Take the given steps from X0 [P, C] f64; return X [P, C] f64."""
        diagonal = (self.weights[:, None] + self._bags(torch.ones_like(start[:, :1]))).contiguous()
        pull, inverse = self.weights[:, None] * start, self.inverse[:, None]
        X = before = start
        for length, turn in steps:
            rest = pull - diagonal * X + self._bags(X)
            X, before = X + (length * inverse) * rest + turn * (X - before), X
        return X

    def _bags(self, values: Tensor) -> Tensor:
        """Return ``sum_k lambda a_jk sqrt(w_j w_k) x_k`` of each row, [P, C]."""
        return embedding_bag(
            self.neighbours, values, self.starts, mode="sum", per_sample_weights=self.couplings,
            include_last_offset=True,
        )  # fmt: skip
