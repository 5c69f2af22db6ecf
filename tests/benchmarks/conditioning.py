"""How well A is conditioned: its diagonal dominance over all splats, its spectrum on a neighbourhood, its noise.

With G = A^T A, ``G 1 = A^T (A 1)`` gives the row sums of G without G. The spectrum is dense, of the principal
submatrix of a few splats that lie together: by interlacing its condition is a lower bound of the condition of G.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.sparse import csr_array, vstack
from scipy.sparse.linalg import LinearOperator, eigsh

from liftcore.raster.base import CompositingParams
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.solve.readout import sample_pixels

if TYPE_CHECKING:
    from collections.abc import Sequence

    from liftcore.scene.cameras import Camera

LOST = 1e-6  # of the largest eigenvalue: directions that float32 products do not resolve


@dataclass(frozen=True)
class Spectrum:
    """The unit-diagonal form ``d^-1/2 G d^-1/2``, d the diagonal of G, of some splats."""

    largest: float
    smallest: float
    lost: float  # share of the eigenvalues below LOST times the largest
    hidden: int  # splats whose diagonal is too small to divide by, left out

    @property
    def condition(self) -> float:
        """Largest over smallest; what rounding leaves of the smallest counts as 1e-16 of the largest."""
        return self.largest / max(self.smallest, 1e-16 * self.largest)


def rays_of(raster: CpuRaster, views: Sequence[Camera], gain: float, rays: int) -> csr_array:
    """A [R, P] f64 of about so many rays, evenly over the views and their pixels."""
    share = -(-rays // len(views))
    parts = []
    for number, camera in enumerate(views):
        stride = max(round((camera.width * camera.height / share) ** 0.5), 1)
        walk = CompositingParams(gain, stride=stride)
        pixels = sample_pixels(camera, camera.width * camera.height, (0, number), walk)
        rows = raster.ray_rows(camera, pixels, walk)
        entries = rows.weights.double().numpy(), rows.splats.numpy(), rows.indptr.numpy()
        parts.append(csr_array(entries, shape=(len(pixels), raster.splats.count)))
    return csr_array(vstack(parts))


def self_share(A: csr_array, power: int, evidence: np.ndarray) -> tuple[float, float]:
    """How much of what a closed form gives a splat is the splat's own: ``(C^T A)_jj / (C^T A 1)_j`` with C = A^power.

    Gives the mean over splats, weighted by their evidence [P], and the share of the splats (with evidence) where the
    diagonal is larger than the rest of its row.
    """
    C = _power(A, power)
    own = np.asarray(A.multiply(C).sum(axis=0)).ravel()
    total = C.T @ (A @ np.ones_like(own))
    shares = np.divide(own, total, out=np.zeros_like(own), where=total > 0)
    met = evidence > 0
    return float(np.average(shares, weights=evidence)), float((shares[met] > 0.5).mean())


def noise_gain(A: csr_array, power: int, chosen: np.ndarray) -> float:
    """A splat's deviation under white noise of deviation one in B, ``|w^p| / sum w^p``; the median of ``chosen``."""
    C = _power(A, power)
    sums, squares = np.asarray(C.sum(axis=0)).ravel(), np.asarray(C.multiply(C).sum(axis=0)).ravel()
    met = chosen[sums[chosen] > 0]
    return float(np.median(np.sqrt(squares[met]) / sums[met]))


def coupling(A: csr_array) -> float:
    """The largest eigenvalue of the unit-diagonal form over all splats, by Lanczos; 1 where splats share no ray."""
    squares = np.asarray(A.multiply(A).sum(axis=0)).ravel()
    scale = np.divide(1.0, np.sqrt(squares), out=np.zeros_like(squares), where=squares > 0)
    size = squares.size
    make: Any = LinearOperator  # scipy's stubs know neither its arguments nor those of eigsh
    eigenvalues: Any = eigsh
    operator = make((size, size), matvec=lambda x: scale * (A.T @ (A @ (scale * x.ravel()))), dtype=np.float64)
    start = np.where(squares > 0, 1.0, 0.0)
    return float(eigenvalues(operator, k=1, which="LA", v0=start, tol=1e-3, return_eigenvectors=False)[0])


def spectrum(A: csr_array, power: int, chosen: np.ndarray) -> Spectrum:
    """Of ``C^T C`` with C = A^power, on the splats ``chosen``."""
    C = _power(A, power)[:, chosen]
    G = (C.T @ C).toarray()
    diagonal = np.diag(G).copy()
    visible = diagonal > 1e-24
    scale = 1 / np.sqrt(diagonal[visible])
    values = np.linalg.eigvalsh(G[np.ix_(visible, visible)] * scale[:, None] * scale)
    lost = float((values < LOST * values[-1]).mean())
    return Spectrum(float(values[-1]), float(values[0]), lost, int((~visible).sum()))


def neighbourhood(means: torch.Tensor, evidence: np.ndarray, count: int) -> np.ndarray:
    """[n] i64 ascending: the splats nearest to the heaviest one, among those with evidence over a half."""
    heavy = np.flatnonzero(evidence > 0.5)
    places = means.double().numpy()
    far = np.linalg.norm(places[heavy] - places[np.argmax(evidence)], axis=1)
    return np.sort(heavy[np.argsort(far, kind="stable")[:count]])


def _power(A: csr_array, power: int) -> csr_array:
    return A if power == 1 else A.multiply(A).tocsr()
