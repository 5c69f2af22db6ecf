"""The robust step on W against its definition in plain float64, and its promises."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from liftcore.lifting.pieces import stacked
from liftcore.solve.directions import RegionDirections
from liftcore.solve.reweight import NO_CONSENSUS, scale_weights
from liftcore.solve.shared_rows import LONG, MOST_COMPARED
from liftcore.values.region_weights import RegionWeights
from tests.unit.solve.one_piece import reweighting_of
from tests.unit.solve.sparse_views import codebook_of, dense, of_dense


@dataclass
class Scene:
    """W [P, M] f32 and E [M, F] of every view, dense."""

    weights: list[np.ndarray]
    books: list[torch.Tensor]

    @property
    def denominators(self) -> np.ndarray:
        return np.sum([view.sum(axis=1, dtype=np.float64) for view in self.weights], axis=0)

    def stacked(self) -> RegionWeights:
        return stacked([of_dense(view) for view in self.weights], len(self.weights[0]))

    def after(self, **options) -> list[np.ndarray]:
        """The weights of every view after the step, dense."""
        W = self.stacked()
        consistency = scale_weights(W, reweighting_of(W, codebook_of(self.books), **options).factors)
        matrix = dense(consistency, len(self.weights[0])).astype(np.float32)
        return np.split(matrix, W.offsets.numpy()[1:-1], axis=1)


def over(values: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    return np.divide(values, lengths, out=np.zeros_like(values), where=lengths > 0)


def defined_directions(scene: Scene) -> tuple[np.ndarray, list[np.ndarray]]:
    """The scene's mean, and e of every view."""
    first = [view.astype(np.float64) for view in scene.weights]
    books = [book.double().numpy() for book in scene.books]
    units = [over(book, np.linalg.norm(book, axis=1, keepdims=True)) for book in books]
    columns = [view.sum(axis=0) * (np.linalg.norm(book, axis=1) > 0) for view, book in zip(first, books, strict=True)]
    parts = [c @ u for c, u in zip(columns, units, strict=True)]
    mean = np.sum(parts, axis=0) / (sum(c.sum() for c in columns) or 1.0)
    e = []
    for unit in units:
        away = np.where(unit.any(axis=1, keepdims=True), unit - mean, 0.0)
        lengths = np.linalg.norm(away, axis=1, keepdims=True)
        e.append(over(away, np.where(lengths > 1e-6, lengths, 0.0)))
    return mean, e


def defined(scene: Scene, e: list[np.ndarray] | None = None) -> list[np.ndarray]:
    """The module's equation, line by line."""
    first, e = [view.astype(np.float64) for view in scene.weights], e or defined_directions(scene)[1]
    D = scene.denominators[:, None]
    total = sum(w @ v for w, v in zip(first, e, strict=True))
    cosines = []
    for w, v in zip(first, e, strict=True):
        r = over(total - w @ v, D)
        lengths = np.linalg.norm(r, axis=1, keepdims=True)
        cosines.append(np.maximum(over(r, np.where(lengths > NO_CONSENSUS, lengths, 0.0)) @ v.T, 0.0))
    mean = sum((w * c).sum() for w, c in zip(first, cosines, strict=True)) / (sum(w.sum() for w in first) or 1.0)
    shares = [over(w.sum(axis=1, keepdims=True), D) for w in first]
    new = [w * ((1 - p) * c + p * mean) for w, c, p in zip(first, cosines, shares, strict=True)]
    gain = over(D, np.sum([w.sum(axis=1, keepdims=True) for w in new], axis=0))
    return [np.where(gain > 0, w * gain, old) for w, old in zip(new, first, strict=True)]


def levels_apart(scene: Scene, levels: np.ndarray) -> list[np.ndarray]:
    """The definition for each level by itself: regions [M] of others weigh nothing, and directions stay."""
    e, ends = defined_directions(scene)[1], np.cumsum([len(book) for book in scene.books])[:-1]
    parts = []
    for level in np.unique(levels):
        level_weights = [
            view * (part == level) for view, part in zip(scene.weights, np.split(levels, ends), strict=True)
        ]
        parts.append(defined(Scene(level_weights, scene.books), e))
    return [np.sum(views, axis=0) for views in zip(*parts, strict=True)]


def test_levels_are_compared_separately():
    scene = random_scene(3, count=400, channels=20)
    levels = np.random.default_rng(4).integers(-1, 3, sum(len(book) for book in scene.books)).astype(np.int8)
    got = scene.after(levels=levels)
    for actual, real in zip(got, levels_apart(scene, levels), strict=True):
        assert np.abs(over(actual - real, scene.denominators[:, None])).max() < 2e-3


def random_scene(seed: int, count: int = 9_000, views: int = 4, rows: int = 7, channels: int = 150) -> Scene:
    """More than a share and a block of splats, more than a strip of channels."""
    rng = np.random.default_rng(seed)
    mask = [rng.random((count, rows)) * (rng.random((count, rows)) < 0.3) for _ in range(views)]
    books = [torch.tensor(rng.normal(0, 1, (rows, channels)), dtype=torch.float32) for _ in range(views)]
    return Scene([view.astype(np.float32) for view in mask], books)


@pytest.mark.parametrize("channels", [600, 1_200])
def test_principal_directions_have_the_cosines_of_all_channels(channels: int) -> None:
    rng = np.random.default_rng(1)
    vectors = rng.standard_normal((40, 6)) @ rng.standard_normal((6, channels))
    codebook, totals = codebook_of([torch.from_numpy(vectors).float()]), torch.from_numpy(rng.uniform(0.5, 2, 40))
    principal = RegionDirections.of(codebook, totals, 10_000, 12).table(slice(0, 12))
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    offsets = unit - totals.numpy() @ unit / totals.sum().item()
    e = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    np.testing.assert_allclose((principal @ principal.T).numpy(), e @ e.T, atol=2e-6)


@pytest.mark.parametrize("views", [2, 7])
def test_a_step_that_changes_much_equals_its_definition_to_the_last_digits(views):
    scene = random_scene(views, count=20, views=views, channels=33)
    scene.books[0][0] = 0
    scene.books[1] = scene.books[1].half()
    scene.weights[1][3] = 0
    D, largest_change = scene.denominators[:, None], 0.0
    for actual, real, first in zip(scene.after(), defined(scene), scene.weights, strict=True):
        np.testing.assert_allclose(over(actual, D), over(real, D), atol=1e-5)
        largest_change = max(largest_change, np.abs(over(real - first, D)).max())
    assert largest_change > 0.05


def test_splats_of_few_and_of_many_views_in_one_group_equal_the_definition():
    scene = random_scene(6, count=9, views=MOST_COMPARED // 2, rows=3)
    for number, view in enumerate(scene.weights):
        view[::2] *= number % 8 == 0  # every other splat has an eighth of the views
    entry_counts = np.sum([(view > 0).sum(axis=1) for view in scene.weights], axis=0)
    assert entry_counts.min() < LONG < entry_counts.max() <= MOST_COMPARED
    D = np.maximum(scene.denominators[:, None], 1e-30)
    for actual, real in zip(scene.after(), defined(scene), strict=True):
        np.testing.assert_allclose(actual / D, real / D, atol=1e-6)


def test_splats_of_many_views_and_of_many_regions_equal_the_definition():
    scene = random_scene(4, count=3, views=2 * MOST_COMPARED, rows=3)
    view_counts = np.sum([view.any(axis=1) for view in scene.weights], axis=0)
    assert (view_counts > MOST_COMPARED).all()
    rng = np.random.default_rng(5)
    scene.weights.append(rng.random((3, 2 * MOST_COMPARED + 30)).astype(np.float32))
    scene.books.append(torch.tensor(rng.normal(0, 1, (2 * MOST_COMPARED + 30, 150)), dtype=torch.float32))
    D = scene.denominators[:, None]
    for actual, real in zip(scene.after(), defined(scene), strict=True):
        np.testing.assert_allclose(actual / D, real / D, atol=1e-6)


@pytest.mark.parametrize(("rows", "channels"), [(20_000, 8), (8, 10_000)])
def test_a_step_over_very_many_terms_keeps_its_digits(rows, channels):
    rng = np.random.default_rng(2)
    direction = rng.normal(0, 1, channels)
    books = rng.uniform(-1, 2, (2, rows, 1)) * direction + rng.normal(0, 1, (2, rows, channels))
    weights = rng.uniform(0.001, 1, (2, 1, rows)).astype(np.float32)
    scene = Scene([*weights], [torch.tensor(book, dtype=torch.float32) for book in books])
    got, exact = np.concatenate(scene.after()), np.concatenate(defined(scene))
    assert np.abs(got - exact).max() < 1e-6 * exact.max()


def test_slices_of_channels_are_compared_as_one_vector(monkeypatch):
    scene = random_scene(3, count=500)
    matrix = scene.after()
    for module in ("codebook", "directions"):
        monkeypatch.setattr(f"liftcore.solve.{module}.TABLE_BYTES", 1)
    for sliced, expected in zip(scene.after(), matrix, strict=True):
        np.testing.assert_allclose(sliced, expected, rtol=1e-4, atol=1e-5)
