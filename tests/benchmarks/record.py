"""The recorded run: what lifts of two real scenes answer, and what of it a checkout changes.

    python -m tests.benchmarks.record [--only TEXT ...] [--bits] [--threads N]
    python -m tests.benchmarks.record --write [--only TEXT ...]
    python -m tests.benchmarks.record --seconds OTHER_CHECKOUT [--turns N] [--room FOLDER]

``record.json`` beside this file has lifts of `tabletop` and `plush`, 60 questions over each, and all their figures
at one commit. The first command computes them anew from ../shared/data and prints what differs, in some six minutes
of one core. It speaks public names alone, so that it runs on later checkouts as it is.

What is promised where. On one machine, with the same libraries, bits are: features, total weights, confidences,
objects, selections and masks, for any number of threads. They are recorded as digests (``bits``). Another processor,
another BLAS or another order of sums may change last bits. Figures have four digits, and the tolerances of
`TOLERANCES` and `SHARES`; all others are exact, such as presence and numbers of objects. Seconds are printed, and
never compared.

A figure is ``moved`` beyond its tolerance. It is ``gone`` if the code refuses its setting or question, or lacks a
name. The status is 1 if a figure moved or is gone; with ``--bits`` also if bits moved. It is 2 if nothing could be
compared. ``--only TEXT`` chooses lifts by the beginnings of their paths, such as "tabletop / hard 13" or, of seconds,
"plush / row-sum".

``--seconds`` lifts from files by the command line, in turns with another checkout: user and system seconds of the
whole process, the ratio of medians, and the peak memory. ``--room`` adds a folder that
``python -m tests.benchmarks.scenes room FOLDER --splats 1000000 --views 60`` makes.
"""

import argparse
import hashlib
import json
import math
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file

import liftcore as lc

ROOT = Path(__file__).resolve().parents[2]
RECORD = Path(__file__).with_name("record.json")
TOLERANCES = {  # absolute
    "accuracy": 0.002, "miou": 0.002, "fidelity": 0.002, "iou": 0.005, "mean iou": 0.005, "least iou": 0.005,
    "threshold": 0.005, "presence": 0.005, "feature share": 0.002, "mean confidence": 0.002, "sample cosines": 0.005,
}  # fmt: skip
SHARES = {"selected": 0.01, "sizes": 0.01, "pixels": 0.01, "mean weight": 0.001}  # relative, of the record's
LEAST_STEP = {"selected": 2, "sizes": 2, "pixels": 2}  # splats or pixels that are no difference
COUNTED_WEIGHT = 0.5  # total weight in the first lift of splats that accuracy counts
SAMPLES = 32  # splats whose cosines to the next of them are recorded
LISTED_SIZES = 5  # of the objects of an answer
TIMED_PACKS = {"plush": "regions", "tabletop": "features_hard"}
TIMED_PRESETS = "row-sum", "default"
Figures = dict[str, Any]


@dataclass
class RealScene:
    """Splats, cameras and questions of a scene; of tabletop also words and the truth."""

    folder: Path
    recorded: Mapping[str, Any]  # its lifts and questions
    splats: lc.Splats = field(init=False)
    cameras: lc.Cameras = field(init=False)
    encoder: lc.TextEncoder | None = None
    words: tuple[str, ...] = ()  # [K], the classes
    owners: np.ndarray = field(init=False)  # [P], the class of each splat
    counted_splats: np.ndarray = field(init=False)  # [P] bool, splats over which accuracy is
    truths: Mapping[str, np.ndarray] = field(default_factory=dict)  # held-out view -> [H, W], classes, -1 for none

    def __post_init__(self) -> None:
        self.splats = lc.read_splats(self.folder / "point_cloud.ply")
        self.cameras = lc.read_cameras(self.folder / "cameras.json")
        self.counted_splats = np.zeros(self.splats.count, bool)
        if (self.folder / "truth.json").exists():
            entries = json.loads((self.folder / "truth.json").read_text())
            truth = {name: tensor.numpy() for name, tensor in load_file(self.folder / "truth.safetensors").items()}
            self.encoder = lc.open_encoder(f"table:{self.folder / 'text_table.safetensors'}")
            self.words, self.owners = tuple(entry["class"] for entry in entries["objects"]), truth["splat_object"]
            self.truths = {view: truth[f"{view}/mask"] for view in entries["held_out_views"]}

    def lift(self, entry: Mapping[str, Any], threads: int | None) -> lc.LiftResult:
        """Lift every n-th view of a pack."""
        pack = lc.read_features(self.folder / f"{entry['pack']}.safetensors")
        views = pack if entry["every"] == 1 else {view: pack[view] for view in sorted(pack)[:: entry["every"]]}
        return lc.lift(self.splats, self.cameras, views, threads=threads, progress=False, **entry["settings"])

    def render(self, camera: lc.Camera, values: torch.Tensor, lift: lc.LiftResult) -> torch.Tensor:
        """Render values [P, F] as the lift composites: [H, W, F] f32."""
        return lc.render(self.splats, camera, values, lift.settings.compositing)


def digest(*arrays: Any) -> str:
    """Digest of the bits of arrays, with their types and shapes."""
    state = hashlib.blake2b(digest_size=8)
    for array in map(np.ascontiguousarray, arrays):
        state.update(f"{array.dtype} {array.shape}".encode() + array.tobytes())
    return state.hexdigest()


def attempt(compute: Callable[[], Any]) -> Any:
    """Return figures, or the refusal in their place: a name that is no longer there must not hide the others."""
    try:
        return compute()
    except (lc.SplatliftError, AttributeError, TypeError, ImportError) as error:
        return {"refused": f"{type(error).__name__}: {error}"[:160]}


def rounded(value: Any) -> float | None:
    """Four digits after the point; None of None and of infinity."""
    return round(float(value), 4) if value is not None and math.isfinite(value) else None


def columns(real: RealScene, lift: lc.LiftResult, _: lc.Scene) -> Figures:
    """Digests of the columns of a lift, and figures that say how far they moved."""
    X, weight = lift.features, lift.total_weight
    if not real.counted_splats.any():  # the first lift, of all views by row-sum
        real.counted_splats = weight.numpy() > COUNTED_WEIGHT
    sample = X[torch.linspace(0, len(X) - 1, SAMPLES).long()].float()
    cosines = torch.cosine_similarity(sample, sample.roll(1, dims=0), dim=1)
    figures: Figures = {
        "bits of features": digest(X), "bits of total weight": digest(weight), "mean weight": rounded(weight.mean()),
        "feature share": rounded(lift.has_feature.float().mean()), "sample cosines": list(map(rounded, cosines)),
    }  # fmt: skip
    if (confidence := lift.confidence) is not None:
        figures |= {"bits of confidence": digest(confidence), "mean confidence": rounded(confidence.mean())}
    if lift.object is not None:
        sizes = torch.bincount(lift.object[lift.object >= 0].long()).tolist()
        figures |= {"bits of objects": digest(lift.object), "objects": len(sizes), "sizes": sizes}
    return figures


def classes(real: RealScene, lift: lc.LiftResult, _: lc.Scene) -> Figures:
    """Accuracy of the nearest class over splats, and mIoU of rendered classes over every other held-out view."""
    assert real.encoder is not None
    vectors = torch.from_numpy(np.asarray(real.encoder.encode(real.words), np.float32))
    scores = lift.features.float() @ vectors.T
    shared, union = np.zeros(len(real.words)), np.zeros(len(real.words))
    for view, truth in list(real.truths.items())[::2]:
        best = real.render(real.cameras[view], scores, lift).argmax(dim=2).numpy()
        best[truth < 0] = -1  # rays that meet nothing show no class
        for k in range(len(real.words)):
            shared[k] += ((best == k) & (truth == k)).sum()
            union[k] += ((best == k) | (truth == k)).sum()
    accuracy = (scores.argmax(dim=1).numpy() == real.owners)[real.counted_splats].mean()
    return {"accuracy": rounded(accuracy), "miou": rounded((shared / union).mean())}


def fidelity(real: RealScene, lift: lc.LiftResult, _: lc.Scene) -> Figures:
    """Mean cosine of rendered features with the maps of held-out views, at the middles of their cells."""
    maps, cosines = lc.read_features(real.folder / "grids_test.safetensors"), []
    for view in real.recorded["held-out views"]:
        camera, features = real.cameras[view], maps[view]
        assert isinstance(features, lc.FeatureGrid)
        lengths = {name: getattr(camera, name) / 4 for name in ("fx", "fy", "cx", "cy")}  # a cell is 8 x 8 pixels
        quarter = camera.replace(width=camera.width // 4, height=camera.height // 4, **lengths)
        image, grid = real.render(quarter, lift.features, lift), features.grid.float()
        y, x = (((torch.arange(grid.shape[k]) + 0.5) * image.shape[k] / grid.shape[k]).long() for k in (0, 1))
        cosines.append(rounded(torch.cosine_similarity(image[y][:, x], grid, dim=2).mean()))
    return {"fidelity": cosines}


def phrases(real: RealScene, _: lc.LiftResult, scene: lc.Scene) -> Figures:
    """IoU of the mask of each word in every other held-out view, and digests of its masks in two of them."""
    figures: Figures = {}
    for number, word in enumerate(real.words):
        answer, ious = scene.ask(lc.Query(text=[word]), encoder=real.encoder), []
        masks = {view: scene.view_mask(answer, view).mask for view in list(real.truths)[::2]}
        for view, mask in masks.items():
            truth = real.truths[view] == number
            if truth.any():
                ious.append((mask & truth).sum() / (mask | truth).sum())
        figures[word] = {"iou": rounded(np.mean(ious)), "bits of masks": digest(*list(masks.values())[:2])}
    ious = [word["iou"] for word in figures.values()]
    return figures | {"mean iou": rounded(np.mean(ious)), "least iou": min(ious)}


def masks(real: RealScene, _: lc.LiftResult, scene: lc.Scene) -> Figures:
    """Pixels and digests of the masks of points in two held-out views."""
    figures, views = Figures(), real.recorded["held-out views"][::2]
    for example in real.recorded["masks"]:
        answer = scene.ask(lc.Query(like=[example]))
        images = [scene.view_mask(answer, view).mask for view in views]
        figures[example] = {"pixels": [int(image.sum()) for image in images], "bits of masks": digest(*images)}
    return figures


def tree(_: RealScene, __: lc.LiftResult, scene: lc.Scene) -> Figures:
    """Numbers of nodes of each kind, and their sizes."""
    nodes = scene.tree().nodes
    return {"kinds": dict(sorted(Counter(node.kind for node in nodes).items())), "sizes": [n.splats for n in nodes]}


def segmentation(real: RealScene, _: lc.LiftResult, scene: lc.Scene) -> Figures:
    """Words that are there, of the classes and of absent words, and the accuracy of the labels."""
    result = scene.segment([*real.words, *real.recorded["absent words"]], encoder=real.encoder)
    accuracy = (result.rows == real.owners)[real.counted_splats].mean()
    words = sorted(label.word for label in result.named_words)
    return {"words": words, "accuracy": rounded(accuracy), "bits of labels": digest(result.rows)}


def questions(real: RealScene, _: lc.LiftResult, scene: lc.Scene) -> Figures:
    """Threshold, selection, presence and objects of each question."""

    def answer_figures(query: Mapping[str, Any]) -> Figures:
        answer = scene.ask(lc.Query(**query), encoder=real.encoder)
        sizes = [group.splats for group in scene.objects(answer).objects]
        return {
            "threshold": rounded(answer.threshold.value), "selected": int(answer.selected.sum()),
            "present": answer.present, "presence": rounded(answer.presence), "clear": answer.clear,
            "objects": len(sizes), "sizes": sizes[:LISTED_SIZES], "bits": digest(answer.selected),
        }  # fmt: skip

    queries = real.recorded["questions"]
    return {json.dumps(query): attempt(partial(answer_figures, query)) for query in queries}


PARTS = {
    part.__name__: part for part in (columns, classes, fidelity, phrases, masks, tree, segmentation, questions)
}  # what is recorded of a lift


def run_scene(real: RealScene, threads: int | None) -> Iterator[tuple[str, Figures]]:
    """Iterate over the lifts of a scene: their paths and figures; prints the seconds of the lifts."""
    for path, entry in real.recorded["lifts"].items():
        start = time.process_time()
        lift = attempt(partial(real.lift, entry, threads))
        seconds = time.process_time() - start
        print(f"{path}: {seconds:.1f} s of processors", flush=True)
        yield path, lift if isinstance(lift, dict) else lift_figures(real, lift, entry["parts"])


def lift_figures(real: RealScene, lift: lc.LiftResult, parts: Iterable[str]) -> Figures:
    """Figures of a lift by their parts."""
    scene = lc.Scene(lift, real.splats, real.cameras)
    return {part: attempt(partial(PARTS[part], real, lift, scene)) for part in parts}


def differences(old: Any, new: Any, path: str, name: str = "") -> Iterator[tuple[str, str, str]]:
    """Iterate over the kind, path and text of what is not as recorded."""
    if isinstance(old, dict) and isinstance(new, dict):
        if "refused" in old and "refused" in new:
            return
        if "refused" in new:
            yield "gone", path, new["refused"]
        elif "refused" in old:
            yield "moved", path, f"answers now, but: {old['refused']}"
        else:
            for key in old:
                yield from differences(old[key], new.get(key, {"refused": "no such figure"}), f"{path} / {key}", key)
            yield from (("moved", f"{path} / {key}", "not in the record") for key in new.keys() - old.keys())
    elif isinstance(new, dict):
        yield "gone", path, new["refused"]
    elif name.startswith("bits"):
        if old != new:
            yield "bits moved", path, f"{old} -> {new}"
    elif not _is_close(old, new, name):
        yield "moved", path, f"{old} -> {new}"


def _is_close(old: Any, new: Any, name: str) -> bool:
    if isinstance(old, list) and isinstance(new, list):
        return len(old) == len(new) and all(_is_close(a, b, name) for a, b in zip(old, new, strict=True))
    if not isinstance(old, float | int) or not isinstance(new, float | int) or name not in TOLERANCES | SHARES:
        return old == new
    tolerance = TOLERANCES.get(name) or max(LEAST_STEP.get(name, 0), SHARES[name] * abs(old))
    return abs(old - new) <= tolerance + 1e-9


def machine() -> dict[str, str]:
    """Processor and library versions that bits depend on."""
    cpu = ""
    with suppress(OSError):
        cpu = next((line for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line), "")
    libraries = {name: version(name) for name in ("torch", "numpy", "numba", "scipy")}
    return {"processor": cpu.partition(": ")[2] or platform.processor(), **libraries}


def json_lines(value: Any, depth: int = 6) -> str:
    """JSON with a line for each short entry of a dict, so that a change of the record is read by lines."""
    if not isinstance(value, dict) or not depth or len(json.dumps(value)) < 100:
        return json.dumps(value)
    rows = (f"{json.dumps(key)}: {json_lines(entry, depth - 1)}" for key, entry in value.items())
    return "{\n" + ",\n".join(rows) + "\n}"


def compare(recorded: Mapping[str, Any], figures: Figures, options: argparse.Namespace) -> int:
    """Print what moved; return the status."""
    if (this_commit := machine()) != recorded["machine"]:
        print(f"Bits may move: the record was made by {recorded['machine']}, not by {this_commit}.")
    counts = Counter[str]()
    for path, new in figures.items():
        if path not in recorded["figures"]:
            counts["not recorded"] += 1
            continue
        for kind, part, text in differences(recorded["figures"][path], new, path):
            counts[kind] += 1
            if kind != "bits moved" or options.bits:
                print(f"{kind}: {part}: {text}")
    totals = ", ".join(f"{counts[kind]} {kind}" for kind in ("moved", "gone", "not recorded", "bits moved"))
    print(
        f"{len(figures)} lifts beside {recorded['commit']}: {totals}.{'' if options.bits else ' --bits lists bits.'}"
    )
    return int(bool(counts["moved"] or counts["gone"] or (options.bits and counts["bits moved"])))


def library_commit() -> str:
    """Return the last commit that changed the library, which names the record."""
    git = partial(subprocess.run, cwd=ROOT, capture_output=True, text=True, check=True)
    if git(["git", "status", "--porcelain", "liftcore"]).stdout:
        sys.exit("liftcore differs from its last commit, which is to name the record: commit it first.")
    return git(["git", "log", "-1", "--format=%h", "--", "liftcore"]).stdout.strip()


def write(recorded: dict[str, Any], figures: Figures) -> None:
    """Add figures to the record; those of another commit or machine go."""
    facts = {"commit": library_commit(), "machine": machine()}
    equal_bits = all(recorded[name] == value for name, value in facts.items())
    recorded |= facts | {"figures": (recorded["figures"] if equal_bits else {}) | figures}
    RECORD.write_text(json_lines(recorded) + "\n")


def lift_in_process(checkout: Path, folder: Path, pack: str, preset: str, threads: int) -> tuple[float, float]:
    """Lift from files by the command line of a checkout: processor seconds, and the peak memory in MiB."""
    files = folder / "point_cloud.ply", folder / "cameras.json", folder / f"{pack}.safetensors"
    with tempfile.TemporaryDirectory() as output, open(Path(output) / "log", "w+") as log:
        options = "-o", f"{output}/lift.safetensors", "--preset", preset, "--device", "cpu", "--threads", str(threads)
        command = [sys.executable, "-m", "liftcore.cli", "lift", *map(str, files), *options]
        environment = os.environ | {"PYTHONPATH": str(checkout)}
        process = subprocess.Popen(command, cwd=output, env=environment, stdout=log, stderr=log)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            log.seek(0)
            sys.exit(f"The lift of {folder.name} by {checkout} failed:\n{log.read()}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def compare_seconds(options: argparse.Namespace) -> int:
    """Print medians of processor seconds and peaks of whole lifts, in turns with another checkout."""
    packs = {options.data / name: pack for name, pack in TIMED_PACKS.items()}
    packs |= {options.room: "features"} if options.room else {}
    checkouts, threads = (ROOT, options.seconds.resolve()), options.threads or os.cpu_count() or 1
    print("| scene | preset | s here | s there | ratio | least, most ratio of a turn | MiB here | there |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for (folder, pack), preset in product(packs.items(), TIMED_PRESETS):
        if options.only and not f"{folder.name} / {preset}".startswith(tuple(options.only)):
            continue
        lifts = partial(lift_in_process, folder=folder.resolve(), pack=pack, preset=preset, threads=threads)
        list(map(lifts, checkouts))  # compiles kernels and reads files, not counted
        turns = np.array([list(map(lifts, checkouts)) for _ in range(options.turns)])  # [turns, 2, 2]
        (first, second), ratios = np.median(turns[..., 0], axis=0), turns[:, 0, 0] / turns[:, 1, 0]
        seconds = f"{first:.2f} | {second:.2f} | {first / second:.3f} | {ratios.min():.3f}, {ratios.max():.3f}"
        peaks = " | ".join(f"{peak:.0f}" for peak in turns[..., 1].max(axis=0))
        print(f"| {folder.name} | {preset} | {seconds} | {peaks} |", flush=True)
    return 0


def main() -> int:
    """Compare with the record, write it, or compare seconds."""
    parser = argparse.ArgumentParser("python -m tests.benchmarks.record", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    recorded = json.loads(RECORD.read_text())
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="the folder of the scenes")
    parser.add_argument("--only", nargs="+", default=(), metavar="TEXT", help="beginnings of paths of lifts")
    parser.add_argument("--threads", type=int, help="of lifts; default: the number of cores")
    parser.add_argument("--bits", action="store_true", help="list moved bits, and fail by them")
    parser.add_argument("--write", action="store_true", help="write figures of this checkout into the record")
    parser.add_argument("--seconds", type=Path, metavar="CHECKOUT", help="compare seconds with another checkout")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--room", type=Path, metavar="FOLDER", help="a scene of --seconds")
    options = parser.parse_args()
    if missing := [str(options.data / name) for name in recorded["scenes"] if not (options.data / name).is_dir()]:
        parser.error(f"the scenes are missing, so nothing was compared: {', '.join(missing)}")
    if options.seconds:
        return compare_seconds(options)
    figures = Figures()
    for name, scene in recorded["scenes"].items():
        only, all_lifts = tuple(options.only or [name]), scene["lifts"]
        if lifts := {path: entry for path, entry in all_lifts.items() if path.startswith(only)}:
            first = dict(list(all_lifts.items())[:1])  # its total weights choose the splats that accuracy counts
            real = RealScene(options.data / name, scene | {"lifts": first | lifts})
            for path, parts in run_scene(real, options.threads):
                figures[path] = parts
                if options.write:  # a run that is cut short leaves what it has
                    write(recorded, figures)
    return 0 if options.write else compare(recorded, figures, options)


if __name__ == "__main__":
    sys.exit(main())
