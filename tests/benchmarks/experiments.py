"""What the paper measured, measured on a scene of one's own: one table an experiment.

    python -m tests.benchmarks.experiments NAME SCENE [--every N] [--json]

SCENE is a folder with ``point_cloud.ply``, cameras and feature packs. ``--every`` takes every n-th view only. Where
accuracy is measured the scene needs truth in the layout of ``tabletop`` (`tests.benchmarks.tabletop`).
"""

import json
import math
import sys
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_array, vstack
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import cosine_similarity, normalize

from liftcore.errors import SplatliftError
from liftcore.features.pack import Views, pair, read_features, write_pack
from liftcore.features.views import NO_LABEL, Regions, ViewFeatures
from liftcore.io.cameras import read_cameras
from liftcore.io.ply import write_splats
from liftcore.io.splats import read_splats
from liftcore.io.transforms import transforms_of
from liftcore.query.directions import MINIMUM_ROW_SUM
from liftcore.query.threshold import find_threshold
from liftcore.raster.base import CompositingParams
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.result import LiftResult
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Kernel, Splats
from liftcore.settings import TIKHONOV_GAIN
from liftcore.solve.geometry import sample_pixels
from liftcore.solve.least_squares import AllRays, Channels, solve_block
from tests.benchmarks.base import PRESETS, command_line, lift_files, mask_iou, scene_files, splat_accuracy, tell
from tests.benchmarks.tabletop import Tabletop

Rows = Iterator[dict[str, Any]]


@dataclass(frozen=True)
class Subject:
    """The scene of an experiment, of which every n-th view counts."""

    folder: Path
    every: int = 1

    def packs(self, *names: str) -> list[str]:
        """Those of the packs that the scene has."""
        return [name for name in names if (self.folder / f"{name}.safetensors").is_file()]

    def open(self, name: str, cameras: Cameras) -> Views:
        """A pack, its views paired with the cameras."""
        return pair(read_features(self.folder / f"{name}.safetensors"), cameras)[0]

    def lift(
        self,
        pack: str,
        splats: Splats | None = None,
        views: Mapping[str, ViewFeatures] | None = None,
        cameras: Mapping[str, Camera] | None = None,
        **settings: Any,
    ) -> LiftResult:
        """A lift of a pack; onto other splats, of other views or by other cameras where they are given."""
        with tempfile.TemporaryDirectory(prefix="splatlift-experiment-") as place:
            files, own = list(scene_files(self.folder, pack)), Path(place)
            if splats is not None:
                files[0] = own / "splats.ply"
                write_splats(splats, files[0])
            if cameras is not None:
                files[1] = own / "cameras.json"
                files[1].write_text(json.dumps(transforms_of(cameras)), encoding="utf-8")
            if views is not None:
                files[2] = own / "features.safetensors"
                write_pack(files[2], views, {"normalised": "true"})
            return lift_files(files, **{"view_stride": self.every, **settings})


def judged(truth: Tabletop, made: LiftResult, raster: CpuRaster | None = None) -> dict[str, float]:
    """Accuracy and held-out mIoU of a lift."""
    found = truth.judge(made.features, made.metadata.settings, raster=raster)
    return {"accuracy": found.accuracy, "miou": found.miou}


# --- the paper's tables ---


def ablation(subject: Subject) -> Rows:
    """Table 1c: guidance (T), robust step (R) and aggregation (P) on and off.

    mIoU by argmax knows all classes; phrase IoU asks for each class of a view alone and cuts its map by an automatic
    threshold.
    """
    truth = Tabletop(subject.folder)
    parts = product((False, True), repeat=3)
    for pack, (guided, robust, aggregated) in product(subject.packs("features", "features_hard"), parts):
        preset = "tikhonov" if guided else "row-sum"
        made = subject.lift(pack, preset=preset, robust_steps=int(robust), aggregation=aggregated)
        marks = {name: "on" if on else "-" for name, on in (("T", guided), ("R", robust), ("P", aggregated))}
        yield {"pack": pack, **marks, **judged(truth, made), "phrase_iou": phrase_iou(truth, made)}


POSED = {
    "row-sum": {"preset": "row-sum"},
    "the paper's": {"preset": "tikhonov", "aggregation": True},
    "default": {},
    "default, aggregated": {"aggregation": True},
}


def pose_noise(subject: Subject) -> Rows:
    """Table on noisy poses: N of 100 feature views turned by a degree and moved by a hundredth of the scene.

    Splats and held-out cameras stay right.
    """
    truth = Tabletop(subject.folder)
    for pack, share in product(subject.packs("features"), (0, 1, 2, 3, 10, 20, 50, 100)):
        names = subject.open(pack, truth.cameras).views[:: subject.every]
        order = np.random.default_rng(1).permutation(len(names))
        wrong = [names[k] for k in order[: math.ceil(len(names) * share / 100)]]
        moved = noisy_poses(truth.cameras, wrong, seed=0)
        for name, settings in POSED.items():
            found = judged(truth, subject.lift(pack, cameras=moved, **settings))
            yield {"pack": pack, "noisy_of_100": share, "method": name, **found}


def phrase_iou(truth: Tabletop, made: LiftResult) -> float:
    """Mean IoU over the classes of each held-out view, each asked for alone."""
    ious, settings = [], made.metadata.settings
    maps = truth.maps(made.features, settings, truth.raster)
    for (view, mask), scores in zip(truth.held_out.items(), maps, strict=True):
        met = truth.raster.row_sums(truth.cameras[view], settings.render_params) >= MINIMUM_ROW_SUM
        for k in mask[mask >= 0].unique().tolist():
            cut = find_threshold(scores[:, :, k][met], "auto").value
            ious.append(mask_iou(met & (scores[:, :, k] >= cut), mask == k))
    return float(np.mean(ious))


def kernels(subject: Subject) -> Rows:
    """Table 2a: one trained 3DGS scene, and the same read as discs and as beta kernels (conversions, not trained)."""
    truth, trained = Tabletop(subject.folder), read_splats(subject.folder / "point_cloud.ply")
    forms = {
        "3dgs": (trained, {}),
        "3dgs antialiased": (trained, {"antialiased": True}),
        "2dgs": (to_discs(trained), {}),
        "dbs": (to_betas(trained), {}),
    }
    for kernel, (splats, more) in forms.items():
        raster = CpuRaster(splats)
        for pack, preset in product(subject.packs("features", "features_hard"), PRESETS):
            made = subject.lift(pack, splats=splats, preset=preset, **more)
            walk = made.metadata.settings.render_params
            sums = [raster.row_sums(truth.cameras[view], walk).mean() for view in truth.held_out]
            head = {"pack": pack, "kernel": kernel, "preset": preset, "row_sum_mean": float(np.mean(sums))}
            yield head | judged(truth, made, raster)


def lambda_sweep(subject: Subject) -> Rows:
    """Table on Tikhonov Guidance: the scale lambda of the opacity logits, lifting and rendering apart."""
    truth = Tabletop(subject.folder)
    same = (1.0, 1.1, 1.2, 1.35, 1.5, 2.0, 4.0, 8.0)
    pairs = [(0.5, 1.0), (0.8, 1.0), (1.2, 1.0), *((gain, gain) for gain in same)]
    for pack, power, (lift_gain, render_gain) in product(subject.packs("features_hard"), (1, 2), pairs):
        values = {"power": power, "lift_gain": lift_gain, "render_gain": render_gain}
        yield {"pack": pack, **values, **judged(truth, subject.lift(pack, preset="tikhonov", **values))}


def mask_noise(subject: Subject) -> Rows:
    """Wrong masks: a growing share of exact regions merged, mislabelled or dropped; the same for all methods."""
    truth = Tabletop(subject.folder)
    packs = subject.open("features_clean", truth.cameras)
    seen = {name: packs[name] for name in packs.views}
    maps = {name: observed for name, observed in seen.items() if isinstance(observed, Regions)}
    methods: dict[str, dict[str, Any]] = {
        "row-sum": {"preset": "row-sum"},
        "tikhonov": {"preset": "tikhonov"},
        "tikhonov + robust step": {"preset": "tikhonov", "robust_steps": 1},
        "tikhonov + aggregation": {"preset": "tikhonov", "aggregation": True},
        "default": {},
        "default + aggregation": {"aggregation": True},
    }
    for rate in (0.0, 0.1, 0.2, 0.4, 0.6):
        wrong = noisy_masks(maps, rate, seed=0)
        for method, settings in methods.items():
            yield {
                "method": method, "rate": rate,
                **judged(truth, subject.lift("features_clean", views=wrong, **settings)),
            }  # fmt: skip


def row_sums(subject: Subject) -> Rows:
    """Property 2: how close the rows of A come to one, over all pixels, without and with the opacity scale."""
    splats, cameras, _ = scene_files(subject.folder)
    raster, views = CpuRaster(read_splats(splats)), list(read_cameras(cameras).values())[:: subject.every]
    for gain in (1.0, TIKHONOV_GAIN):
        sums = [raster.row_sums(camera, CompositingParams(gain)).numpy().ravel() for camera in views]
        every = np.concatenate(sums).astype(np.float64)
        lowest = min(float(part.mean(dtype=np.float64)) for part in sums)
        head = {"gain": gain, "views": len(views), "mean": float(every.mean()), "std": float(every.std())}
        yield head | {"lowest_view_mean": lowest, "below_0.9": float((every < 0.9).mean()), "min": float(every.min())}


# --- conditioning ---

RAYS = 150_000  # of the scene
NEIGHBOURS = 1_200  # splats whose dense spectrum is taken


def conditioning(subject: Subject) -> Rows:
    """What lambda does to G = A^T A, on rays of the scene.

    own_share: how much of what the closed form gives a splat is the splat's own, ``(C^T A)_jj / (C^T A 1)_j`` with
    C = A^p; dominant: the share of splats where it is over a half. cond: of the unit-diagonal form of C^T C over
    splats that lie together, by interlacing a lower bound of the whole. noise: a splat's deviation under white noise
    in B. beta: the paper's.
    """
    splats, cameras, _ = scene_files(subject.folder)
    raster, views = CpuRaster(read_splats(splats)), list(read_cameras(cameras).values())[:: subject.every]
    evidence = np.asarray(rays_of(raster, views, 1.0).sum(axis=0)).ravel()
    chosen, packs = neighbourhood(raster.splats.means, evidence), subject.packs("features", "regions")
    for gain in (0.5, 0.8, 1.0, 1.2, 1.5, 2.0, 4.0, 8.0):
        sampled = {"preset": "row-sum", "lift_gain": gain, "stride": 2, "certificate_rays": 5_000}
        beta = subject.lift(packs[0], **sampled).metadata.certificate["beta"]["median"] if packs else None
        yield {"gain": gain, **conditions(rays_of(raster, views, gain), evidence, chosen), "beta_median": beta}


def conditions(A: csr_array, evidence: np.ndarray, chosen: np.ndarray) -> dict[str, float]:
    """The figures of `conditioning` for A [R, P], evidence [P] and the splats ``chosen`` whose spectrum is taken."""
    met, found = evidence > 0, {}
    for power, key in ((1, "w"), (2, "w2")):
        C = A if power == 1 else A.multiply(A).tocsr()
        own, total = np.asarray(A.multiply(C).sum(axis=0)).ravel(), C.T @ (A @ np.ones(len(evidence)))
        shares = np.divide(own, total, out=np.zeros_like(own), where=total > 0)
        sums, squares = np.asarray(C.sum(axis=0)).ravel(), np.asarray(C.multiply(C).sum(axis=0)).ravel()
        some = chosen[sums[chosen] > 0]
        G = (C[:, chosen].T @ C[:, chosen]).toarray()
        visible = np.diag(G) > 1e-24
        scale = 1 / np.sqrt(np.diag(G)[visible])
        values = np.linalg.eigvalsh(G[np.ix_(visible, visible)] * scale[:, None] * scale)
        found[f"own_share_{key}"] = float(np.average(shares, weights=evidence))
        found[f"cond_{key}"] = float(values[-1] / max(values[0], 1e-16 * values[-1]))
        found[f"noise_{key}"] = float(np.median(np.sqrt(squares[some]) / sums[some]))
        if power == 1:
            found["dominant"] = float((shares[met] > 0.5).mean())
    return found


def rays_of(raster: CpuRaster, views: Sequence[Camera], gain: float) -> csr_array:
    """A [R, P] f64 of about RAYS rays, evenly over the views and their pixels."""
    parts = []
    for number, camera in enumerate(views):
        stride = max(round((camera.width * camera.height * len(views) / RAYS) ** 0.5), 1)
        walk = CompositingParams(gain, stride=stride)
        pixels = sample_pixels(camera, camera.width * camera.height, (0, number), walk)
        rows = raster.ray_rows(camera, pixels, walk)
        entries = rows.weights.double().numpy(), rows.splats.numpy(), rows.indptr.numpy()
        parts.append(csr_array(entries, shape=(len(pixels), raster.splats.count)))
    return csr_array(vstack(parts))


def neighbourhood(means: Tensor, evidence: np.ndarray) -> np.ndarray:
    """[n] i64 ascending: the splats nearest to the heaviest one, among those with evidence over a half."""
    heavy, places = np.flatnonzero(evidence > 0.5), means.double().numpy()
    far = np.linalg.norm(places[heavy] - places[np.argmax(evidence)], axis=1)
    return np.sort(heavy[np.argsort(far, kind="stable")[:NEIGHBOURS]])


# --- least squares under wrong masks ---


def overfitting(subject: Subject) -> Rows:
    """Section 3.2: conjugate gradients towards the smallest ``|A X - B|^2`` under wrong masks, with several dampings.

    All runs in the channels ``X C^T``, C the class vectors: closed form and least squares are linear in B, so these
    are exactly the class scores of the full solutions, at the cost of 14 channels.
    """
    scene = Tabletop(subject.folder)
    packs = read_features(subject.folder / "features_hard.safetensors")
    names = packs.views[:: subject.every]
    rays = AllRays(
        scene.raster,
        scene.raster.splats.count,
        [scene.cameras[name] for name in names],
        lambda view: scored(packs[names[view]], scene.classes),
        CompositingParams(),
    )
    truth = Truth(scene.classes, scene.objects, scene.counted & torch.from_numpy(rays.row_sums > 0))
    first = closed_form(rays, len(scene.classes))

    def row(damping: float | None, path: Mapping[str, Any], step: int, scores: Tensor) -> dict[str, Any]:
        maps = (scene.raster.render(scene.cameras[view], scores, CompositingParams()) for view in scene.held_out)
        ends = {name: path[name][step] for name in ("residual", "accuracy", "cosine")}
        steps = len(path["residual"]) - 1 if step else 0
        return {"damping": damping, "steps": steps, **ends, "miou": scene.miou(maps)}

    for number, damping in enumerate((0.0, 0.1, 0.3, 1.0)):
        path, last = follow(rays, first, truth, damping, 20)
        if number == 0:
            yield row(None, path, 0, first)
        yield row(damping, path, -1, last)


@dataclass(frozen=True)
class Truth:
    """What the splats really are."""

    classes: Tensor  # [K, F] f32, unit vectors
    objects: Tensor  # [P] int, the class of every splat
    counted: Tensor  # [P] bool, the splats that count

    def judge(self, scores: Tensor) -> dict[str, float]:
        """Accuracy of the scores [P, K], and their mean cosine to the true ones, centred on the classes' mean."""
        true = (self.classes @ self.classes.T)[self.objects.long()]
        left, right = (part - part.mean(dim=1, keepdim=True) for part in (scores, true))
        cosines = cosine_similarity(left, right, dim=1, eps=1e-12)
        accuracy = splat_accuracy(scores, self.objects, self.counted)
        return {"accuracy": accuracy, "cosine": float(cosines[self.counted].mean())}


def scored(observation: ViewFeatures, classes: Tensor) -> Regions:
    """A region map whose codebook [M, K] holds the scores of the classes [K, F]."""
    assert isinstance(observation, Regions)
    return Regions(observation.labels, observation.codebook.float() @ classes.T)


def closed_form(rays: AllRays, channels: int) -> Tensor:
    """``D^-1 A^T B`` [P, C] f32 in all channels of the observations."""
    part = Channels(0, channels, None)
    sums, _ = rays.gradient(np.zeros((rays.count, channels), np.float32), part.project)
    scale = np.divide(1.0, rays.row_sums, out=np.zeros(rays.count), where=rays.row_sums > 0)
    return torch.from_numpy(sums * scale.astype(np.float32)[:, None])


def follow(rays: AllRays, first: Tensor, truth: Truth, damping: float, steps: int) -> tuple[dict[str, Any], Tensor]:
    """Residual, accuracy and cosine after every step from ``first`` [P, K] on, and the last scores [P, K]."""
    found = [truth.judge(first)]

    def watch(step: int, solution: np.ndarray, rest: np.ndarray) -> None:
        found.append(truth.judge(first + torch.from_numpy(solution)))

    part = Channels(0, first.shape[1], None)
    block = solve_block(rays, part, first, rays.row_sums > 0, damping, steps, watch)
    path: dict[str, Any] = {"residual": [loss / max(rays.rows, 1) for loss in block.losses]}
    path |= {key: [point[key] for point in found] for key in ("accuracy", "cosine")}
    return path, first + torch.from_numpy(block.step)


# --- ways to be wrong, by an explicit seed ---


def noisy_poses(cameras: Cameras, wrong: Collection[str], seed: int) -> Cameras:
    """The cameras, those named in ``wrong`` with the paper's noise.

    Deviations are a degree of roll, pitch and yaw each, and a hundredth of the scene's scale (the farthest camera
    from the mean of all) of each coordinate.
    """
    centres = np.stack([camera.centre for camera in cameras.values()])
    scale = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    random, moved = np.random.default_rng(seed), []
    for camera in cameras.values():
        turn, shift = random.normal(0, 1.0, 3), random.normal(0, 0.01 * scale, 3)
        if camera.name not in wrong:
            moved.append(camera)
            continue
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("ZXY", turn, degrees=True).as_matrix() @ camera.viewmat[:3, :3]
        pose[:3, 3] = -pose[:3, :3] @ (camera.centre + shift)
        moved.append(camera.replace(viewmat=pose))
    return Cameras(moved)


def noisy_masks(maps: Mapping[str, Regions], rate: float, seed: int) -> dict[str, Regions]:
    """Region maps in which each region of each level goes wrong with probability ``rate``.

    Equally often it is merged with the neighbour that it touches most (both get the mean of the two vectors), takes
    the vector of another region of the scene, or stays unlabelled.
    """
    random = np.random.default_rng(seed)
    vectors = torch.cat([regions.codebook for regions in maps.values()])
    return {view: _spoilt(regions, rate, vectors, random) for view, regions in maps.items()}


def _spoilt(regions: Regions, rate: float, vectors: Tensor, random: np.random.Generator) -> Regions:
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
                both = torch.cat(codebook)[[int(region), neighbour]].float()
                vector = normalize(both.mean(dim=0), dim=0)
                area |= level == neighbour
            elif kind == 1:
                vector = vectors[other].float()
            else:
                level[area] = NO_LABEL
                continue
            level[area] = rows
            rows += 1
            codebook.append(vector[None].to(regions.codebook.dtype))
    return Regions(torch.from_numpy(labels), torch.cat(codebook))


def _neighbour(level: np.ndarray, region: int) -> int:
    """The label that shares the longest border with a region; NO_LABEL where it touches none."""
    touching = []
    for one, other in ((level[1:], level[:-1]), (level[:, 1:], level[:, :-1])):
        touching += [other[one == region], one[other == region]]
    around = np.concatenate([part.ravel() for part in touching])
    around = around[(around != region) & (around != NO_LABEL)]
    return int(np.bincount(around).argmax()) if around.size else NO_LABEL


# --- a trained 3DGS scene read as other kernels ---

# Turns by a third about (1, 1, 1), w x y z: R q has the columns (1, 2, 0) of R, or (2, 0, 1).
_TURNS = ((0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5), (1.0, 0.0, 0.0, 0.0))
_ORDERS = ((1, 2, 0), (2, 0, 1), (0, 1, 2))  # the axes that stay, then the one that goes: 0, 1 or 2
_BARE: dict[str, Any] = {"layout": (), "header": (), "extras": {}}


def to_discs(splats: Splats) -> Splats:
    """2DGS: every splat loses its shortest axis, which becomes the disc's normal; opacities and colours stay."""
    shortest = splats.log_scales.argmin(dim=1)
    log_scales = splats.log_scales.gather(1, torch.tensor(_ORDERS)[shortest][:, :2]).contiguous()
    pw, px, py, pz = normalize(splats.quats, dim=1).unbind(dim=1)
    qw, qx, qy, qz = torch.tensor(_TURNS)[shortest].unbind(dim=1)
    turned = [  # Hamilton's product: the rotation of q, then that of p
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    ]
    return replace(splats, kernel=Kernel.GAUSSIAN_2D, quats=torch.stack(turned, 1), log_scales=log_scales, **_BARE)


def to_betas(splats: Splats) -> Splats:
    """DBS: beta = 4 (b = 0) and axes that give every footprint the area of its Gaussian; opacities and colours stay.

    In the image plane ``(1 - r^2 / R^2)^beta`` sums to ``pi R^2 / (beta + 1)`` and ``exp(-r^2 / 2)`` to ``2 pi``: the
    axes grow by ``R = sqrt(2 (beta + 1))``. The low-pass of 0.3 px^2 is not converted, for a scene cannot say it.
    """
    log_scales, beta = splats.log_scales + 0.5 * math.log(10.0), torch.zeros(splats.count)
    return replace(splats, kernel=Kernel.BETA, log_scales=log_scales, beta=beta, **_BARE)


EXPERIMENTS: dict[str, Callable[[Subject], Rows]] = {
    made.__name__: made
    for made in (
        ablation, conditioning, kernels, lambda_sweep, mask_noise, overfitting, pose_noise, row_sums,
    )
}  # fmt: skip


def main() -> int:
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
    try:
        rows = list(experiment(Subject(options.scene, options.every)))
    except SplatliftError as error:
        print(error, file=sys.stderr)
        return 2
    tell(rows, as_json=options.json, note=f"{options.name} on {options.scene.resolve().name}: {experiment.__doc__}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
