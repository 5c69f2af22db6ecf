"""Scores of splats for a query: the cosine to its positives, reduced where a negative is as near.

Lifted rows are sums of unit vectors and not unit themselves, so their norms divide every score; they are computed
once a lift. The products are explicit loops: float16 rows are converted one at a time into a buffer that stays in the
first-level cache, so a million rows are read once and never copied. A blocked matrix product converts them by NumPy,
which takes ten times as long. Rows are divided into fixed shares over threads, and the bits of a score depend on no
other row and no other direction.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.runtime.cores import cores
from liftcore.runtime.jit import vectorised

LOWEST_COSINE = -1.0  # score of a splat without a feature
# An example's score is 1 for an equal feature and 0 for the scene's mean; words have no such scale.
LEAST_LIKENESS = 0.4  # to an example, the least value of the automatic threshold
LEAST_OFFSET = 1e-3  # from the mean, of unit features: float16 cannot represent the direction of a smaller one
FAINTEST = 1e-30  # least sum of squares that float32 adds without loss
RELEVANCY_SHARPNESS = 10.0  # the softmax's inverse temperature in LERF and LangSplat

# A float16 shifted to float32's place is the number times 2^-112, as the exponents' biases are 127 and 15.
HALF_SCALE = 2.0**112
SIGN_AND_MAGNITUDE = np.int32(-0x70002000)  # bits 31 and 27..13, where a shifted float16 lies
SHARE_ROWS = 8_192  # rows a thread takes at once
_BLOCK, _BLOCK_FLOATS = 16_384, 1 << 25  # rows widened at once for means and colours, and numbers in them


@vectorised
def _widen(bits, half, words):
    """Write the bits of a row as float32: float16 shifted into place, float32 unchanged."""
    if half:
        for c in range(bits.shape[0]):
            words[c] = (np.int32(bits[c]) << np.int32(13)) & SIGN_AND_MAGNITUDE
    else:
        for c in range(bits.shape[0]):
            words[c] = bits[c]


@vectorised
def _dot(row, direction):
    total = np.float32(0.0)
    for c in range(row.shape[0]):
        total += row[c] * direction[c]
    return total


@vectorised
def _compare(first, last, bits, half, norms, directions, cosines):
    words = np.empty(bits.shape[1], np.int32)
    row = words.view(np.float32)
    for j in range(first, last):
        _widen(bits[j], half, words)
        for n in range(directions.shape[0]):
            if norms[j] == 0:
                cosines[j, n] = LOWEST_COSINE
            else:
                cosines[j, n] = min(max(_dot(row, directions[n]) / norms[j], np.float32(-1.0)), np.float32(1.0))


@vectorised
def _measure(first, last, bits, half, scale, norms):
    words = np.empty(bits.shape[1], np.int32)
    row = words.view(np.float32)
    for j in range(first, last):
        _widen(bits[j], half, words)
        for c in range(row.shape[0]):
            row[c] *= scale
        square = _dot(row, row)
        if not FAINTEST < square < np.inf:  # where float32 has no squares
            wide = 0.0
            for c in range(row.shape[0]):
                wide += np.float64(row[c]) * np.float64(row[c])
            norms[j] = np.sqrt(wide)
        else:
            norms[j] = np.sqrt(square)


def norms_of(features: np.ndarray) -> np.ndarray:
    """Compute Euclidean norms of the rows of features [P, F] f16 or f32, [P] f32."""
    norms = np.empty(len(features), np.float32)
    bits, half, scale = _bits(features)
    _over_rows(len(norms), lambda first, last: _measure(first, last, bits, half, scale, norms))
    return norms


def cosines(features: np.ndarray, norms: np.ndarray, texts: np.ndarray) -> np.ndarray:
    """Compute cosines to several texts in one pass over the features.

    Args:
        features: [P, F] f16 or f32, finite. norms: [P] f32, from `norms_of`.
        texts: [n, F] f32, rows of any length above zero.

    Returns:
        [P, n] f32 in [-1, 1]; a zero row scores -1.

    Raises:
        InvalidQuery: a text's vector has another length than the features, is zero or is not finite.
    """
    if texts.ndim != 2 or texts.shape[1] != features.shape[1]:
        expected = f"{features.shape[1]} channels, as the lift has"
        raise InvalidQuery("text vector", expected=expected, got=f"{texts.shape[-1]} channels")
    lengths = np.linalg.norm(texts.astype(np.float64), axis=1, keepdims=True)
    if not np.isfinite(lengths).all() or (lengths == 0).any():
        raise InvalidQuery("text vector", expected="a finite vector with a direction", got="zero, NaN or infinity")
    return _cosines(features, norms, (texts / lengths).astype(np.float32))


def _cosines(features: np.ndarray, norms: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Compute cosines as `cosines` to unit rows [n, F] f32."""
    bits, half, scale = _bits(features)
    columns = np.ascontiguousarray(directions * scale)
    output = np.empty((len(bits), len(columns)), np.float32)
    _over_rows(len(bits), lambda first, last: _compare(first, last, bits, half, norms, columns, output))
    return output


def warm_up() -> None:
    """Load or compile the kernels, before the first query."""
    for dtype in (np.float16, np.float32):
        row = np.ones((1, 1), dtype)
        cosines(row, norms_of(row), row.astype(np.float32))


def rows_at_a_time(channels: int) -> int:
    """Return the number of rows of features that are converted to float32 at once."""
    return max(1, min(_BLOCK, _BLOCK_FLOATS // channels))


def spaced(rows: np.ndarray, limit: int) -> np.ndarray:
    """Return at most ``limit`` evenly spaced ones of rows [n]."""
    return rows[:: -(-len(rows) // limit) or 1]


def rank_rows(scores: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Sort rows [n] by their scores [P] f32, the highest first and equal ones in order.

    A score and its row are sorted as one integer, which takes a quarter of the time of an index sort.
    """
    bits = (-scores[rows] + np.float32(0.0)).view(np.int32)  # + 0 makes -0 and 0 equal
    keys = (bits ^ ((bits >> 31) & np.int32(0x7FFFFFFF))).astype(np.int64)  # in the order of the floats
    keys = (keys << 32) | rows
    keys.sort()
    return keys & 0xFFFFFFFF


def mean_direction(features: np.ndarray, norms: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Compute the weighted mean of the unit rows, [F] f32; zeros if all rows or weights are zero.

    Args:
        features: [P, F] f16 or f32. norms: [P] f32, from `norms_of`. weights: [P] f32, at least zero.
    """
    shares = np.where(
        norms > 0, weights / np.maximum(norms, np.finfo(np.float32).tiny).astype(np.float64), 0.0
    ).astype(np.float32)
    total = np.zeros(features.shape[1])
    step = rows_at_a_time(features.shape[1])
    for first in range(0, len(features), step):
        block = slice(first, first + step)
        # A loop, as sums of the linear algebra library vary with its number of threads.
        total += np.einsum("pf,p->f", features[block].astype(np.float32), shares[block], optimize=False)
    weight = float(weights[norms > 0].sum(dtype=np.float64))
    return (total / weight if weight > 0 else total).astype(np.float32)


def cosines_about(features: np.ndarray, norms: np.ndarray, mean: np.ndarray, examples: np.ndarray) -> np.ndarray:
    """Compute cosines to examples about the scene's mean feature, ``cos(x_j / |x_j| - mean, e - mean)``.

    Image features lie in a narrow cone: their common part hides the differences between objects. Words lie in another
    cone, so they are compared by uncentred cosines.

    Args:
        features: [P, F] f16 or f32. norms: [P] f32, from `norms_of`.
        mean: [F] f32, the mean of the unit features, of length below one.
        examples: [n, F] f32, unit rows.

    Returns:
        [P, n] f32 in [-1, 1]; 0 for a splat or an example that is the mean.
    """
    length = float(np.linalg.norm(mean))
    offsets = examples - mean
    reaches = np.linalg.norm(offsets, axis=1)
    # One pass gives <x, e - mean> and <x, mean>, and these give all: |x - mean|^2 = 1 - 2 <x, mean> + |mean|^2.
    lengths = np.maximum(np.append(reaches, np.float32(length)), np.float32(1e-12))
    along = _cosines(features, norms, np.concatenate([offsets, mean[None]]) / lengths[:, None])
    products = along[:, :-1] * reaches - np.array([offset @ mean for offset in offsets])
    distances = np.sqrt(np.maximum(1 - 2 * length * along[:, -1:] + length**2, 0.0))
    valid = (distances > LEAST_OFFSET) & (reaches > LEAST_OFFSET)
    scale = np.maximum(distances * reaches, LEAST_OFFSET**2)
    return np.where(valid, np.clip(products / scale, -1.0, 1.0), np.float32(0.0))


@dataclass(frozen=True)
class Features:
    """Features [P, F] of splats: the rows that differ, and the row of each splat.

    Of a lift as codes these are some thousands, whatever its number of splats. So what queries compute of features
    they compute of rows, with the total weight of a row's splats (`liftcore.query.scene.Scene.distinct`), and
    take the answer to the splats at the end. Exact features have a row a splat.
    """

    rows: np.ndarray  # [K, F] f16 or f32, finite; zeros for no feature
    code: np.ndarray | None = None  # [P] u16, the row of each splat; None: K = P, a row a splat

    def __len__(self) -> int:
        """P."""
        return len(self.rows if self.code is None else self.code)

    def __getitem__(self, splats: Any) -> np.ndarray:
        """Return the features of some splats, [n, F] f16 or f32."""
        return self.rows[splats if self.code is None else self.code[splats]]

    @cached_property
    def norms(self) -> np.ndarray:
        """[K] f32, of the rows."""
        return norms_of(self.rows)

    def of_splats(self, values: np.ndarray) -> np.ndarray:
        """Return the value of each splat, [P], of those of the rows [K]."""
        return values if self.code is None else values.take(self.code)

    def of_rows(self, values: np.ndarray) -> np.ndarray:
        """Return the sum [K] f64 of the values [P] of each row's splats; of a row a splat the values themselves."""
        return values if self.code is None else np.bincount(self.code, values, len(self.rows))

    def with_splats(self, mask: np.ndarray) -> np.ndarray:
        """Return the rows of which a splat is in a mask [P] bool, [K] bool."""
        if self.code is None:
            return mask
        rows = np.zeros(len(self.rows), np.bool_)
        rows[self.code[mask]] = True
        return rows

    def mean(self, weights: np.ndarray, splats: Any = slice(None)) -> np.ndarray:
        """Compute the mean [F] f32 of the unit features of some splats [n] by their weights [n]."""
        rows = splats if self.code is None else self.code[splats]
        if self.code is None or len(rows) < len(self.rows):
            return mean_direction(self.rows[rows], self.norms[rows], weights)
        return mean_direction(self.rows, self.norms, np.bincount(rows, weights, len(self.rows)))

    def distinct(self, splats: np.ndarray) -> tuple[np.ndarray, Any]:
        """Return the rows [m] of some splats [n], and the index among them of each splat."""
        return (splats, slice(None)) if self.code is None else np.unique(self.code[splats], return_inverse=True)


def combine(similarities: np.ndarray, positives: int) -> np.ndarray:
    """Combine a splat's cosines to all terms of a query to one score.

    Without negatives it is the cosine to the nearest positive, and with negatives that cosine times the relevancy:

        s_j = max_p cos(x_j, p)
        s_j = max_p cos(x_j, p) sigmoid(10 (max_p cos(x_j, p) - max_n cos(x_j, n)))

    Relevancy alone compares the two sides, and a wall may be nearer to an apple than to a table without similarity to
    either: negatives must reduce the selection and not extend it. The largest and not the mean cosine counts, so that
    positives may be different objects. Cosines to words and to examples differ in scale (CLIP's words lie apart from
    its images), so with both, the examples decide.

    Args:
        similarities: [P, n] f32, cosines to the positives, then to the negatives; about the scene's mean for examples
            (`cosines_about`).
        positives: number of positives among the n, at least one.

    Returns:
        [P] f32 in -1..1.
    """
    nearest = similarities[:, 0] if positives == 1 else similarities[:, :positives].max(axis=1)
    if similarities.shape[1] == positives:
        return nearest
    against = similarities[:, positives:].max(axis=1)
    # LERF's and LangSplat's min_n softmax(10 [cos p, cos n])_0: above .5 a splat is nearer to a positive.
    return nearest * (1 / (1 + np.exp(RELEVANCY_SHARPNESS * (against - nearest))))


def _bits(features: np.ndarray) -> tuple[np.ndarray, bool, np.float32]:
    """Return rows for kernels: bits [P, F] i16 or i32, True if they are float16, and the scale of their values."""
    half = features.dtype == np.float16
    rows = features.view(np.int16) if half else features.astype(np.float32, copy=False).view(np.int32)
    return np.ascontiguousarray(rows), half, np.float32(HALF_SCALE if half else 1.0)


def _over_rows(count: int, work: Callable[[int, int], None]) -> None:
    starts = range(0, count, SHARE_ROWS)
    threads = min(len(starts), cores())
    if threads <= 1:
        work(0, count)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda first: work(first, min(first + SHARE_ROWS, count)), starts))
