"""Experiments of the paper on a scene of one's own: one table an experiment.

    python -m tests.benchmarks.experiments NAME SCENE [--every N] [--json]

SCENE is a folder with ``point_cloud.ply``, cameras and feature packs. ``--every`` takes every n-th view only. All but
``conditioning`` and ``row_sums`` need truth in the layout of ``tabletop`` (`tests.benchmarks.tabletop`).
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_array, vstack
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import cosine_similarity, normalize

import liftcore as lc
from liftcore.query.areas import MINIMUM_ROW_SUM
from liftcore.query.threshold import find_threshold
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.splats import Kernel
from liftcore.solve.least_squares import AllRays, Channels, solve_block
from liftcore.solve.rays import sample_pixels
from liftcore.values.settings import TIKHONOV_GAIN
from liftcore.values.views import NO_LABEL, ViewFeatures
from tests.benchmarks.base import PRESETS, command_line, mask_iou, print_rows, read_pack, read_scene
from tests.benchmarks.tabletop import Truth, tabletop

Rows = Iterator[dict[str, Any]]


def packs_of(folder: Path, *names: str) -> list[str]:
    """Those of the packs that the scene has."""
    return [name for name in names if (folder / f"{name}.safetensors").is_file()]


def figures_of(truth: Truth, lifted: lc.LiftResult, raster: CpuRaster | None = None) -> dict[str, float]:
    """Accuracy and held-out mIoU of a lift."""
    figures = truth.evaluate(lifted, raster)
    return {"accuracy": figures.accuracy, "miou": figures.miou}


# --- the paper's tables ---


def ablation(folder: Path, stride: int) -> Rows:
    """Table 1c: guidance (T), robust step (R) and aggregation (P) on and off.

    mIoU by argmax knows all classes; phrase IoU asks for each class of a view alone and cuts its map by an automatic
    threshold.
    """
    truth, parts = tabletop(folder), product((False, True), repeat=3)
    for pack, (guided, robust, aggregated) in product(packs_of(folder, "features", "features_hard"), parts):
        settings = {"preset": "tikhonov" if guided else "row-sum", "robust_steps": int(robust)}
        lifted = truth.lift(read_pack(folder, pack, stride), **settings, aggregation=aggregated)
        marks = {name: "on" if on else "-" for name, on in (("T", guided), ("R", robust), ("P", aggregated))}
        yield {"pack": pack, **marks, **figures_of(truth, lifted), "phrase_iou": phrase_iou(truth, lifted)}


def phrase_iou(truth: Truth, lifted: lc.LiftResult) -> float:
    """Mean IoU over the classes of each held-out view, each asked for alone."""
    ious, params = [], lifted.settings.render_params
    maps = truth.rendered(truth.scores(lifted), params)
    for (view, mask), scores in zip(truth.held_out.items(), maps, strict=True):
        hit = truth.raster.row_sums(truth.cameras[view], params) >= MINIMUM_ROW_SUM
        for k in mask.unique().tolist():
            cut = find_threshold(scores[:, :, k][hit], "auto").value
            ious.append(mask_iou(hit & (scores[:, :, k] >= cut), mask == k))
    return float(np.mean(ious))


POSE_SETTINGS = {
    "row-sum": {"preset": "row-sum"},
    "the paper's": {"preset": "tikhonov", "aggregation": True},
    "default": {},
    "default, aggregated": {"aggregation": True},
}


def pose_noise(folder: Path, stride: int) -> Rows:
    """Table on noisy poses: N of 100 feature views turned by a degree and moved by a hundredth of the scene.

    Splats and held-out cameras stay right.
    """
    truth, views = tabletop(folder), read_pack(folder, "features", stride)
    order = np.random.default_rng(1).permutation(len(views))
    for share in (0, 1, 2, 3, 10, 20, 50, 100):
        wrong = [list(views)[k] for k in order[: math.ceil(len(views) * share / 100)]]
        noisy = replace(truth, cameras=noisy_poses(truth.cameras, wrong, seed=0))
        for name, settings in POSE_SETTINGS.items():
            figures = figures_of(truth, noisy.lift(views, **settings))
            yield {"pack": "features", "noisy_of_100": share, "method": name, **figures}


def kernels(folder: Path, stride: int) -> Rows:
    """Table 2a: one trained 3DGS scene, and the same read as discs and as beta kernels (conversions, not trained)."""
    truth = tabletop(folder)
    trained = truth.raster.splats
    forms = {
        "3dgs": (trained, {}),
        "3dgs antialiased": (trained, {"antialiased": True}),
        "2dgs": (to_discs(trained), {}),
        "dbs": (to_betas(trained), {}),
    }
    for kernel, (splats, options) in forms.items():
        raster = CpuRaster(splats)
        for pack, preset in product(packs_of(folder, "features", "features_hard"), PRESETS):
            lifted = replace(truth, raster=raster).lift(read_pack(folder, pack, stride), preset=preset, **options)
            params = lifted.settings.render_params
            sums = [raster.row_sums(truth.cameras[view], params).mean() for view in truth.held_out]
            head = {"pack": pack, "kernel": kernel, "preset": preset, "row_sum_mean": float(np.mean(sums))}
            yield head | figures_of(truth, lifted, raster)


def lambda_sweep(folder: Path, stride: int) -> Rows:
    """Table on Tikhonov Guidance: the scale lambda of the opacity logits, lifting and rendering apart."""
    truth, pack = tabletop(folder), "features_hard"
    strengths = (1.0, 1.1, 1.2, 1.35, 1.5, 2.0, 4.0, 8.0)
    pairs = [(0.5, 1.0), (0.8, 1.0), (1.2, 1.0), *((gain, gain) for gain in strengths)]
    for power, (lift_gain, render_gain) in product((1, 2), pairs):
        values = {"power": power, "lift_gain": lift_gain, "render_gain": render_gain}
        lifted = truth.lift(read_pack(folder, pack, stride), preset="tikhonov", **values)
        yield {"pack": pack, **values, **figures_of(truth, lifted)}


NOISE_METHODS: dict[str, dict[str, Any]] = {
    "row-sum": {"preset": "row-sum"},
    "tikhonov": {"preset": "tikhonov"},
    "tikhonov + aggregation": {"preset": "tikhonov", "aggregation": True},
    "default": {},
    "default + aggregation": {"aggregation": True},
}


def mask_noise(folder: Path, stride: int) -> Rows:
    """Wrong masks: a growing share of exact regions merged, mislabelled or dropped; the same for all methods."""
    truth, exact = tabletop(folder), read_pack(folder, "features_clean")
    maps = {name: view for name, view in exact.items() if isinstance(view, lc.Regions)}
    for rate in (0.0, 0.1, 0.2, 0.4, 0.6):
        wrong = noisy_masks(maps, rate, seed=0)
        for method, settings in NOISE_METHODS.items():
            figures = figures_of(truth, truth.lift(wrong, view_stride=stride, **settings))
            yield {"method": method, "rate": rate, **figures}


def row_sums(folder: Path, stride: int) -> Rows:
    """Property 2: how close the rows of A come to one, over all pixels, without and with the opacity scale."""
    splats, cameras = read_scene(folder)
    raster, views = CpuRaster(splats), list(cameras.values())[::stride]
    for gain in (1.0, TIKHONOV_GAIN):
        sums = [raster.row_sums(camera, lc.CompositingParams(gain)).numpy().ravel() for camera in views]
        rays = np.concatenate(sums).astype(np.float64)
        lowest = min(float(part.mean(dtype=np.float64)) for part in sums)
        head = {"gain": gain, "views": len(views), "mean": float(rays.mean()), "std": float(rays.std())}
        yield head | {"lowest_view_mean": lowest, "below_0.9": float((rays < 0.9).mean()), "min": float(rays.min())}


# --- conditioning ---

RAYS = 150_000  # of the scene
NEIGHBOURS = 1_200  # splats whose dense spectrum is taken


def conditioning(folder: Path, stride: int) -> Rows:
    """Measure the effect of lambda on G = A^T A, on rays of the scene.

    own_share: how much of what the closed form gives a splat is the splat's own, ``(C^T A)_jj / (C^T A 1)_j`` with
    C = A^p; dominant: the share of splats where it is over a half. cond: of the unit-diagonal form of C^T C over
    splats that lie together, by interlacing a lower bound of the whole.
    """
    splats, cameras = read_scene(folder)
    raster, views = CpuRaster(splats), list(cameras.values())[::stride]
    total_weight = np.asarray(rays_of(raster, views, 1.0).sum(axis=0)).ravel()
    subset = neighbourhood(splats.means, total_weight)
    for gain in (0.5, 0.8, 1.0, 1.2, 1.5, 2.0, 4.0, 8.0):
        yield {"gain": gain, **conditions(rays_of(raster, views, gain), total_weight, subset)}


def conditions(A: csr_array, total_weight: np.ndarray, subset: np.ndarray) -> dict[str, float]:
    """The figures of `conditioning` for A [R, P], total weight [P] and the splats ``subset`` of the spectrum."""
    hit, figures = total_weight > 0, {}
    for power, key in ((1, "w"), (2, "w2")):
        C = A if power == 1 else A.multiply(A).tocsr()
        diagonal, total = np.asarray(A.multiply(C).sum(axis=0)).ravel(), C.T @ (A @ np.ones(len(total_weight)))
        shares = np.divide(diagonal, total, out=np.zeros_like(diagonal), where=total > 0)
        G = (C[:, subset].T @ C[:, subset]).toarray()
        visible = np.diag(G) > 1e-24
        scale = 1 / np.sqrt(np.diag(G)[visible])
        values = np.linalg.eigvalsh(G[np.ix_(visible, visible)] * scale[:, None] * scale)
        figures[f"own_share_{key}"] = float(np.average(shares, weights=total_weight))
        figures[f"cond_{key}"] = float(values[-1] / max(values[0], 1e-16 * values[-1]))
        if power == 1:
            figures["dominant"] = float((shares[hit] > 0.5).mean())
    return figures


def rays_of(raster: CpuRaster, views: Sequence[lc.Camera], gain: float) -> csr_array:
    """A [R, P] f64 of about RAYS rays, evenly over the views and their pixels."""
    parts = []
    for number, camera in enumerate(views):
        stride = max(round((camera.width * camera.height * len(views) / RAYS) ** 0.5), 1)
        params = lc.CompositingParams(gain, stride=stride)
        pixels = sample_pixels(camera, camera.width * camera.height, (0, number), params)
        rows = raster.ray_rows(camera, pixels, params)
        entries = rows.weights.double().numpy(), rows.splats.numpy(), rows.indptr.numpy()
        parts.append(csr_array(entries, shape=(len(pixels), raster.splats.count)))
    return csr_array(vstack(parts))


def neighbourhood(means: Tensor, total_weight: np.ndarray) -> np.ndarray:
    """[n] i64 ascending: the splats nearest to the heaviest one, among those with total weight over a half."""
    heavy, places = np.flatnonzero(total_weight > 0.5), means.double().numpy()
    far = np.linalg.norm(places[heavy] - places[np.argmax(total_weight)], axis=1)
    return np.sort(heavy[np.argsort(far, kind="stable")[:NEIGHBOURS]])


# --- least squares under wrong masks ---


def overfitting(folder: Path, stride: int) -> Rows:
    """Section 3.2: conjugate gradients towards the smallest ``|A X - B|^2`` under wrong masks, with several dampings.

    All runs in the channels ``X C^T``, C the class vectors: closed form and least squares are linear in B, so these
    are exactly the class scores of the full solutions, at the cost of 14 channels.
    """
    scene, views = tabletop(folder), read_pack(folder, "features_hard", stride)
    observed = [scored(view, scene.classes) for view in views.values()]
    cameras, params = [scene.cameras[name] for name in views], lc.CompositingParams()
    rays = AllRays(scene.raster, scene.raster.splats.count, cameras, observed.__getitem__, params)
    hit = rays.row_sums > 0
    part = Channels(0, len(scene.classes), None)
    sums, _ = rays.gradient(np.zeros((rays.count, part.end), np.float32), part.project)
    scale = np.divide(1.0, rays.row_sums, out=np.zeros(rays.count), where=hit)
    first = torch.from_numpy(sums * scale.astype(np.float32)[:, None])  # D^-1 A^T B
    truth = replace(scene, evaluated=scene.evaluated & torch.from_numpy(hit))

    def row(damping: float | None, steps: int, loss: float, scores: Tensor) -> dict[str, Any]:
        figures, cosine = truth.evaluate_scores(scores, params), centred_cosine(truth, scores)
        head = {"damping": damping, "steps": steps, "residual": loss / max(rays.rows, 1)}
        return head | {"accuracy": figures.accuracy, "cosine": cosine, "miou": figures.miou}

    for damping in (0.0, 0.1, 0.3, 1.0):
        block = solve_block(rays, part, first, hit, damping, 20)
        if damping == 0:
            yield row(None, 0, block.losses[0], first)
        yield row(damping, len(block.losses) - 1, block.losses[-1], first + torch.from_numpy(block.step))


def scored(observation: ViewFeatures, classes: Tensor) -> lc.Regions:
    """A region map whose codebook [M, K] holds the scores of the classes [K, F]."""
    assert isinstance(observation, lc.Regions)
    return lc.Regions(observation.labels, observation.codebook.float() @ classes.T)


def centred_cosine(truth: Truth, scores: Tensor) -> float:
    """Mean cosine of the splats' scores [P, K] to the true ones, both centred on their means over the classes."""
    true = (truth.classes @ truth.classes.T)[truth.objects.long()]
    left, right = (part - part.mean(dim=1, keepdim=True) for part in (scores, true))
    return float(cosine_similarity(left, right, dim=1, eps=1e-12)[truth.evaluated].mean())


# --- ways to be wrong, by an explicit seed ---


def noisy_poses(cameras: lc.Cameras, wrong: Collection[str], seed: int) -> lc.Cameras:
    """The cameras, those named in ``wrong`` with the paper's noise.

    Deviations are a degree of roll, pitch and yaw each, and a hundredth of the scene's scale (the farthest camera
    from the mean of all) of each coordinate.
    """
    centres = np.stack([camera.centre for camera in cameras.values()])
    scale = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    random, cameras_out = np.random.default_rng(seed), []
    for camera in cameras.values():
        turn, shift = random.normal(0, 1.0, 3), random.normal(0, 0.01 * scale, 3)
        if camera.name not in wrong:
            cameras_out.append(camera)
            continue
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("ZXY", turn, degrees=True).as_matrix() @ camera.viewmat[:3, :3]
        pose[:3, 3] = -pose[:3, :3] @ (camera.centre + shift)
        cameras_out.append(camera.replace(viewmat=pose))
    return lc.Cameras(cameras_out)


def noisy_masks(maps: Mapping[str, lc.Regions], rate: float, seed: int) -> dict[str, lc.Regions]:
    """Region maps in which each region of each level goes wrong with probability ``rate``.

    Equally often it is merged with the neighbour that it touches most (both get the mean of the two vectors), takes
    the vector of another region of the scene, or stays unlabelled.
    """
    random = np.random.default_rng(seed)
    vectors = torch.cat([regions.codebook for regions in maps.values()])
    return {view: _spoilt(regions, rate, vectors, random) for view, regions in maps.items()}


def _spoilt(regions: lc.Regions, rate: float, vectors: Tensor, random: np.random.Generator) -> lc.Regions:
    labels, codebook = regions.labels.numpy().copy(), [regions.codebook]
    rows = regions.codebook.shape[0]
    for level in labels:
        for region in np.unique(level[level != NO_LABEL]):
            if random.random() >= rate:
                continue
            kind, other = random.integers(3), int(random.integers(vectors.shape[0]))
            area = level == region
            if kind == 0:
                neighbour = _neighbour(level, int(region))
                if neighbour == NO_LABEL:
                    continue
                pair = torch.cat(codebook)[[int(region), neighbour]].float()
                vector = normalize(pair.mean(dim=0), dim=0)
                area |= level == neighbour
            elif kind == 1:
                vector = vectors[other].float()
            else:
                level[area] = NO_LABEL
                continue
            level[area] = rows
            rows += 1
            codebook.append(vector[None].to(regions.codebook.dtype))
    return lc.Regions(torch.from_numpy(labels), torch.cat(codebook))


def _neighbour(level: np.ndarray, region: int) -> int:
    """The label that shares the longest border with a region; NO_LABEL where it touches none."""
    touching = []
    for a, b in ((level[1:], level[:-1]), (level[:, 1:], level[:, :-1])):
        touching += [b[a == region], a[b == region]]
    around = np.concatenate([part.ravel() for part in touching])
    around = around[(around != region) & (around != NO_LABEL)]
    return int(np.bincount(around).argmax()) if around.size else NO_LABEL


# --- a trained 3DGS scene read as other kernels ---

_ORDERS = ((1, 2, 0), (2, 0, 1), (0, 1, 2))  # the axes that stay, then the one that goes: 0, 1 or 2
_BARE: dict[str, Any] = {"layout": (), "header": (), "extras": {}}


def to_discs(splats: lc.Splats) -> lc.Splats:
    """2DGS: every splat loses its shortest axis, which becomes the disc's normal; opacities and colours stay."""
    order = torch.tensor(_ORDERS)[splats.log_scales.argmin(dim=1)]
    log_scales = splats.log_scales.gather(1, order[:, :2]).contiguous()
    axes = Rotation.from_quat(splats.quats.numpy(), scalar_first=True).as_matrix()
    rotation = Rotation.from_matrix(np.take_along_axis(axes, order.numpy()[:, None], axis=2))
    quats = torch.from_numpy(rotation.as_quat(scalar_first=True)).float()
    return replace(splats, kernel=Kernel.GAUSSIAN_2D, quats=quats, log_scales=log_scales, **_BARE)


def to_betas(splats: lc.Splats) -> lc.Splats:
    """DBS: beta = 4 (b = 0) and axes that give every footprint the area of its Gaussian; opacities and colours stay.

    In the image plane ``(1 - r^2 / R^2)^beta`` sums to ``pi R^2 / (beta + 1)`` and ``exp(-r^2 / 2)`` to ``2 pi``: the
    axes grow by ``R = sqrt(2 (beta + 1))``. The low-pass of 0.3 px^2 is not converted, for a scene cannot say it.
    """
    log_scales, beta = splats.log_scales + 0.5 * math.log(10.0), torch.zeros(splats.count)
    return replace(splats, kernel=Kernel.BETA, log_scales=log_scales, beta=beta, **_BARE)


EXPERIMENTS: dict[str, Callable[[Path, int], Rows]] = {
    table.__name__: table
    for table in (
        ablation, conditioning, kernels, lambda_sweep, mask_noise, overfitting, pose_noise, row_sums,
    )
}  # fmt: skip


def main() -> None:
    """Print the table of one experiment."""
    parser = command_line(
        "tests.benchmarks.experiments",
        __doc__,
        ("name", {"choices": list(EXPERIMENTS)}),
        ("scene", {"type": Path}),
        ("--every", {"type": int, "default": 1, "metavar": "N", "help": "take every n-th view"}),
    )
    options = parser.parse_args()
    experiment = EXPERIMENTS[options.name]
    note = f"{options.name} on {options.scene.resolve().name}: {experiment.__doc__}"
    print_rows(experiment(options.scene, options.every), as_json=options.json, note=note)


if __name__ == "__main__":
    main()
