"""Masks by phrase become a pack with its own words, the same from every kind of file."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from liftcore.errors import InvalidFeatures
from liftcore.features.prompts import prompt_views
from liftcore.values.pack import read_features
from liftcore.values.views import Regions
from tests.promises.command_line import run
from tests.run_lengths import write_files
from tests.tiny_scene import labels

PHRASES = {0: "red_apple", 2: "Lamp"}  # the cluster between them has no phrase
MASKS = {
    view: {phrase: label_map[0] == cluster for cluster, phrase in PHRASES.items()}
    for view, label_map in labels().items()
}


def binary(name: str) -> dict[str, np.ndarray]:
    return {
        f"{name.format(view=view, phrase=phrase)}.png": 255 * mask.astype(np.uint8)
        for view, masks in MASKS.items()
        for phrase, mask in masks.items()
    }


def numbered_masks(view: str) -> np.ndarray:
    return sum((7 * number * mask for number, mask in enumerate(MASKS[view].values(), 1)), np.zeros(())).astype("u1")


def with_legend(view: str) -> bytes:
    content, text = io.BytesIO(), PngInfo()
    text.add_text("legend", json.dumps({7: "red apple", 14: "Lamp", 21: "elsewhere"}))
    Image.fromarray(numbered_masks(view)).save(content, format="PNG", pnginfo=text)
    return content.getvalue()


LABELS = {**{f"{view}.png": numbered_masks(view) for view in MASKS}, "names.json": {7: "red_apple", 14: "Lamp"}}
COLOURS = {name: np.repeat(mask[..., None] // 255, 3, axis=2) for name, mask in binary("{phrase}/{view}").items()}
KINDS: dict[str, tuple[dict[str, Any], dict[str, str]]] = {
    "binary PNGs": (binary("{phrase}/{view}"), {}),
    "binary PNGs in colours": (COLOURS, {}),
    "label PNGs": (LABELS, {"names": "names.json"}),
    "label PNGs with a legend": ({f"{view}.png": with_legend(view) for view in MASKS}, {}),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_makes_the_same_pack(kind: str, tmp_path: Path) -> None:
    files, options = KINDS[kind]
    write_files(tmp_path / "masks", files)
    options = {name: str(tmp_path / "masks" / value) if name == "names" else value for name, value in options.items()}
    flags = [part for name, value in options.items() for part in (f"--{name}", value)]
    pack = tmp_path / "pack.safetensors"
    document = run("pack", "prompts", tmp_path / "masks", "-o", pack, "--json", *flags).document
    assert (document["words"], document["text_space"]) == (["Lamp", "red apple"], "prompts")
    views = read_features(pack)
    assert views.table is not None and views.table.words == ("Lamp", "red apple")
    assert views.views == tuple(sorted(MASKS))
    for name, masks in MASKS.items():
        view = views[name]
        assert isinstance(view, Regions)
        channels = view.codebook.numpy()[view.labels[0].numpy()]  # [h, w, 3]: a channel a phrase, and the rest
        assert np.array_equal(channels[..., 0] == 1, masks["Lamp"])
        assert np.array_equal(channels[..., 1] == 1, masks["red_apple"])
        assert np.array_equal(channels.sum(axis=2), np.ones_like(channels[..., 0]))


def test_masks_that_overlap_count_for_both_phrases(tmp_path: Path) -> None:
    mask = MASKS["middle"]["Lamp"]
    empty, full = np.zeros_like(mask), np.ones_like(mask)
    files = {"lamp/a.png": mask, "lamp/b.png": empty, "thing/a.png": full, "ghost/a.png": empty}
    prompts = prompt_views(write_files(tmp_path, files))
    assert prompts.table.words == ("lamp", "thing")
    assert "no view has a mask of ghost: phrases omitted" in prompts.warnings
    view = prompts.views["a"]
    pixel_codes = [
        {tuple(view.codebook[row].tolist()) for row in pixel if row >= 0} for pixel in view.labels.flatten(1).T
    ]
    assert pixel_codes == [{(1, 0, 0), (0, 1, 0)} if inside else {(0, 1, 0)} for inside in mask.ravel()]
    assert prompts.views["b"].codebook[prompts.views["b"].labels.flatten()].tolist() == [[0, 0, 1]]


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"a.png": MASKS["left"]["Lamp"]}, "outside of folders of phrases, without names"),
        ({"mug/a.png": numbered_masks("left")}, r"one value besides 0, a mask, got values from 7 to 14"),
        ({"mug/a.png": 128 * np.eye(3, dtype=np.uint8)[[[0, 1]]]}, r"one colour besides black, a mask, got several"),
        ({"mug/a.png": MASKS["left"]["Lamp"], "a.json": "[]"}, "got a.json and a.png; .*--names"),
        (
            {"a.json": '[{"phrase": "mug", "segmentation": [[0, 0, 4, 0, 4, 4]]}]'},
            "the size of the image of a polygon",
        ),
        (
            {
                "a.json": {
                    "width": 4,
                    "height": 4,
                    "annotations": [{"phrase": "mug", "segmentation": [[0, 0, 0.4, 0, 0.4, 0.4]]}],
                }
            },
            "a polygon in pixels, got one in fractions of the image",
        ),
        (
            {"lamp/a.png": np.ones((2, 2), np.uint8), "mug/a.png": np.ones((2, 3), np.uint8)},
            "masks of one size, got 2 x 2 and 2 x 3",
        ),
    ],
)
def test_what_is_no_such_folder_is_refused(files: dict[str, Any], message: str, tmp_path: Path) -> None:
    write_files(tmp_path / "masks", files)
    with pytest.raises((InvalidFeatures, ValueError), match=message):
        prompt_views(tmp_path / "masks").views["a"]
