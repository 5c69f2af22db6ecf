"""Registration: the similarity between two sets of a scene's splats, without an initial guess.

Editors turn, scale and shift a scene, and reorder or drop its rows. Colour, opacity and shape of a splat stay through
all of it, so splats are matched by these, and the similarity that most matches agree on is kept (RANSAC), then fitted
to them in closed form (Umeyama 1991).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidSplats
from liftcore.scene.neighbours import base_colours, set_apart
from liftcore.scene.origin import extent_of_most
from liftcore.scene.similarity import Similarity

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

SAMPLES = 20_000  # splats of the moved scene that are matched
TRIALS = 4_000  # triples of matches
NEAR = 0.01  # of the scene's extent: matches that lie so near after the move agree with it
LEAST_AGREEING = 30  # matches, fewer of which are an accident
CLEAR = 0.7  # of the second nearest's distance, that a match's is at most
MIN_SEPARATION = 1e-9  # distance of splats that look alike
ROUNDS = 5  # of fitting to the matches that agree
_WIDTHS = (0.02, 0.02, 0.02, 0.05, 0.1, 0.1)  # of colours, opacity, and ratios of scales as logs


def find_similarity(old: Splats, new: Splats) -> Similarity:
    """Return the similarity that takes the splats of a scene to where those of an edited copy lie.

    Args:
        old, new: of one scene, in any order and number.

    Raises:
        InvalidSplats: no similarity is clear.
    """
    from scipy.spatial import KDTree

    generator = np.random.default_rng(0)
    rows = np.sort(generator.permutation(new.count)[:SAMPLES])
    distances, nearest = KDTree(set_apart(_descriptors(old))).query(_descriptors(new)[rows], 2)
    clear = (distances[:, 0] < CLEAR * distances[:, 1]) | (distances[:, 0] < MIN_SEPARATION)
    targets = new.positions(rows[clear]).astype(np.float64)
    sources = old.positions(np.asarray(nearest)[clear, 0]).astype(np.float64)
    best, agreeing = None, np.zeros(len(sources), bool)
    reach = NEAR * extent_of_most(new.positions())
    for _ in range(TRIALS if len(sources) >= 3 else 0):
        three = generator.integers(0, len(sources), 3)
        move = fit_similarity(sources[three], targets[three])
        if move is None:
            continue
        agrees = np.linalg.norm(move.points(sources) - targets, axis=1) < reach
        if agrees.sum() > agreeing.sum():
            best, agreeing = move, agrees
            if agrees.mean() > 0.5:
                break
    for _ in range(ROUNDS if agreeing.sum() >= LEAST_AGREEING else 0):
        best = fit_similarity(sources[agreeing], targets[agreeing]) or best
        assert best is not None
        agreeing = np.linalg.norm(best.points(sources) - targets, axis=1) < reach
    if best is None or agreeing.sum() < LEAST_AGREEING:
        got = f"{int(agreeing.sum())} of {len(rows)} splats that agree on one"
        hint = "give the similarity, if the scene was moved, or lift the new splats"
        raise InvalidSplats("splats", expected="splats of the scene, perhaps moved", got=got, hint=hint)
    return best


def fit_similarity(sources: np.ndarray, targets: np.ndarray) -> Similarity | None:
    """Return the similarity from points [n, 3] f64 to others by least squares; None where points coincide."""
    middle, aim = sources.mean(axis=0), targets.mean(axis=0)
    spread = ((sources - middle) ** 2).sum()
    if not spread > 0:
        return None
    left, values, right = np.linalg.svd((targets - aim).T @ (sources - middle))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right)) or 1.0])
    rotation, scale = (left * signs) @ right, float((values * signs).sum() / spread)
    if not 1e-6 < scale < 1e6:
        return None
    return Similarity(scale, rotation, aim - scale * rotation @ middle)


def _descriptors(splats: Splats) -> np.ndarray:
    """Return [P, 6] f64, what no similarity changes of a splat: colour, opacity, ratios of its scales."""
    colours = base_colours(splats)
    colours = np.zeros((splats.count, 3)) if colours is None else colours
    scales = np.sort(splats.log_scales.cpu().numpy().astype(np.float64).clip(-30, 30), axis=1)
    ratios = np.stack([scales[:, -1] - scales[:, 0], scales[:, -1] - scales[:, 1]], axis=1)
    opacity = 1 / (1 + np.exp(-splats.opacity_logits.cpu().numpy().astype(np.float64)))
    return np.column_stack([colours, opacity, ratios.clip(0, 8)]) / _WIDTHS
