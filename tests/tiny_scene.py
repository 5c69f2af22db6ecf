"""A scene that a test can reason about: three clusters side by side, each with its word.

Cluster k lies at x = -1.2, 0, 1.2, four units in front of three cameras that look along -z from z = 0 and
stand a little apart. Every pixel is labelled with the cluster in its column, and the codebook's rows are the
text table's rows, so "apple" is cluster 0 and nothing else.
"""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import dataclass
from typing import Any

import numpy as np
from safetensors.numpy import save

WORDS = ("apple", "book", "lamp")
CHANNELS = 8
AXES = np.eye(3, CHANNELS).tolist()  # the vectors of the words
SPLATS_A_CLUSTER = 20
WIDTH, HEIGHT, FOCAL, DISTANCE = 32, 24, 30.0, 4.0
VIEWS = {"left": -0.1, "middle": 0.0, "right": 0.1}  # name -> the camera's x
PROPERTIES = [
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]


@dataclass(frozen=True)
class TinyScene:
    """The files of the scene, as bytes."""

    splats: bytes
    cameras: bytes
    features: bytes
    table: bytes  # a text table, for the encoder table:FILE


def make_scene() -> TinyScene:
    """The scene; always the same bytes."""
    return TinyScene(ply(splat_rows()), cameras_json(), pack(labels()), text_table())


def splat_rows() -> np.ndarray:
    """[60, 14] f32, one row a splat in the order of PROPERTIES; cluster k is rows 20 k to 20 k + 19."""
    rng = np.random.default_rng(7)
    count = 3 * SPLATS_A_CLUSTER
    cluster = np.repeat(np.arange(3), SPLATS_A_CLUSTER)
    rows = np.zeros((count, len(PROPERTIES)), np.float32)
    rows[:, 0] = (cluster - 1) * 1.2 + rng.normal(0, 0.1, count)
    rows[:, 1] = rng.uniform(-0.8, 0.8, count)
    rows[:, 2] = -DISTANCE + rng.normal(0, 0.1, count)
    rows[np.arange(count), 3 + cluster] = 1.5
    rows[:, 6] = 3.0
    rows[:, 7:10] = np.log(0.12)
    rows[:, 10] = 1.0
    return rows


def ply(rows: np.ndarray, properties: list[str] = PROPERTIES) -> bytes:
    """A binary PLY with those columns."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float {name}" for name in properties]
    return ("\n".join([*lines, "end_header"]) + "\n").encode() + rows.astype("<f4").tobytes()


def cameras_document(views: dict[str, float] = VIEWS, width: int = WIDTH) -> dict[str, Any]:
    """A transforms.json with the three views, or others, of 4:3."""
    frames, focal = [], width * FOCAL / WIDTH
    for name, x in views.items():
        pose = np.eye(4)
        pose[0, 3] = x
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": pose.tolist()})
    return {"w": width, "h": width * HEIGHT // WIDTH, "fl_x": focal, "fl_y": focal, "frames": frames}


def cameras_json() -> bytes:
    """The same as bytes."""
    return json.dumps(cameras_document()).encode()


def colmap_zip() -> bytes:
    """The same views as a zipped COLMAP text model."""
    lines = []
    for number, (name, x) in enumerate(VIEWS.items(), start=1):
        # OpenGL's camera axes are OpenCV's turned by half a turn around x.
        lines += [f"{number} 0 1 0 0 {-x} 0 0 1 {name}.png", ""]
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr(
            "sparse/0/cameras.txt", f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
        )
        archive.writestr("sparse/0/images.txt", "\n".join(lines) + "\n")
    return content.getvalue()


def labels(views: dict[str, float] = VIEWS, width: int = WIDTH) -> dict[str, np.ndarray]:
    """View -> [1, 24, 32] i32, or of another width, the cluster that owns each column."""
    columns, shape = np.arange(width) + 0.5, (1, width * HEIGHT // WIDTH, width)
    label_maps = {}
    for name, x in views.items():
        world = (columns - width / 2) * DISTANCE / (width * FOCAL / WIDTH) + x
        label_maps[name] = np.broadcast_to(np.digitize(world, [-0.6, 0.6]).astype(np.int32), shape)
    return label_maps


def codebook(channels: int = CHANNELS) -> np.ndarray:
    """[3, channels] f32, one unit row a word."""
    return np.eye(3, channels, dtype=np.float32)


def pack(by_view: dict[str, np.ndarray], rows: np.ndarray | None = None) -> bytes:
    """A feature pack of region maps that share one codebook."""
    rows = codebook() if rows is None else rows
    tensors: dict[str, np.ndarray] = {}
    for name, view in by_view.items():
        tensors[f"{name}/labels"] = np.ascontiguousarray(view)
        tensors[f"{name}/codebook"] = rows
    return save(tensors, metadata={"encoder": "by hand", "text_space": "tiny", "normalised": "true"})


def text_table(channels: int = CHANNELS, words: tuple[str, ...] = WORDS, rows: np.ndarray | None = None) -> bytes:
    """A text table with the three words, or others."""
    rows = codebook(channels) if rows is None else rows
    return save({"embeddings": rows}, metadata={"words": json.dumps(words)})


def masks(by_view: dict[str, np.ndarray]) -> bytes:
    """Masks [h, w] of class numbers."""
    return save({f"{view}/mask": np.ascontiguousarray(mask.astype(np.int16)) for view, mask in by_view.items()})
