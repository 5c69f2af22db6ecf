"""The tiny scene as files, and scenes of splats whose features a test chooses."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import liftcore as lc
import numpy as np
import torch
from safetensors.numpy import save_file

from tests.tiny_scene import make_scene

FILES = {"splats": "s.ply", "cameras": "c.json", "features": "f.safetensors", "table": "words.safetensors"}


def write_files(folder: Path, **contents: bytes) -> dict[str, Path]:
    """Write the splats, cameras, features and text table of the tiny scene, or others; return the paths by kind."""
    contents = vars(make_scene()) | contents
    paths = {kind: folder / name for kind, name in FILES.items()}
    for kind, path in paths.items():
        path.write_bytes(contents[kind])
    return paths


def write_lift(folder: Path, splats: bytes = b"", **settings: object) -> Path:
    """Lift the tiny scene, or other splats, in a folder; return the lift's file. The default preset is row-sum."""
    paths = write_files(folder, **({"splats": splats} if splats else {}))
    options = lc.LiftSettings.of(**{"preset": "row-sum", **settings})
    result = lc.lift_files(paths["splats"], paths["cameras"], [paths["features"]], options)
    result.save(folder / "scene.lift.safetensors")
    return folder / "scene.lift.safetensors"


def write_table(path: Path, words: Sequence[str], rows: np.ndarray) -> str:
    """Write a text table of words with rows [n, F]; return its encoder's specification."""
    save_file({"embeddings": np.ascontiguousarray(rows, np.float32)}, path, {"words": json.dumps(list(words))})
    return f"table:{path}"


def row_of_splats(count: int) -> lc.Splats:
    """Return splats [count] on a line, a unit apart, four units in front of the camera of `scene_with`."""
    means = torch.zeros(count, 3)
    means[:, 0], means[:, 2] = torch.arange(count) - (count - 1) / 2, 4.0
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    return lc.Splats(
        means, quats, torch.full((count, 3), -1.5), torch.full((count,), 4.0), sh=torch.zeros(count, 1, 3)
    )


def scene_with(features: np.ndarray, weights: np.ndarray | None = None, **fields: object) -> lc.Scene:
    """Return a scene whose splats have features [P, F] of total weight one, or of weights [P].

    The splats are a row (`row_of_splats`), and its view is called "front". ``fields`` are others of the lift.
    """
    count, channels = features.shape
    splats = row_of_splats(count)
    width = count + 2
    K = np.array([[4.0, 0, width / 2], [0, 4.0, 1.5], [0, 0, 1]])
    cameras = {"front": lc.Camera(np.eye(4), K, width, 3)}
    grid = lc.FeatureGrid(torch.ones(3, width, channels))
    result = lc.lift(splats, cameras, {"front": grid}, preset="row-sum", progress=False)
    rows = torch.from_numpy(features.astype(np.float32))
    total_weight = torch.ones(count) if weights is None else torch.from_numpy(weights.astype(np.float32))
    values: dict[str, object] = {"rows": rows, "total_weight": total_weight, "has_feature": total_weight > 0}
    return lc.Scene(replace(result, **values, **fields), splats, cameras)


def photo_vectors(words: Sequence[str], noise: float = 0.1) -> np.ndarray:
    """Return vectors [n, 512] like those of photos of words of the shipped table: near to each other, and a cosine of
    .29 to their own word.
    """
    encoder = lc.open_encoder("lvis")
    rng = np.random.default_rng(0)
    rows = encoder.encode(list(words))
    mean = rows.mean(axis=0)
    gap = rng.normal(size=512)
    gap -= mean * (gap @ mean) / np.square(mean).sum()
    offsets = rng.normal(size=rows.shape)
    rows = 0.28 * rows + 0.9 * gap / np.linalg.norm(gap)
    return rows + noise * offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
