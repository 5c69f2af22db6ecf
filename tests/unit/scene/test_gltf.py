"""glTF with KHR_gaussian_splatting: read as splat-transform writes it, written and read back, within limits.

``tests/data/splats/degree3.glb`` is what splat-transform 3.7.0 makes of ``degree3.sog.decoded.ply``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidSplats
from liftcore.io.gltf import TO_FILE, gltf_blocks
from liftcore.io.labels import Labels
from liftcore.io.quantised import gaussian_rows
from liftcore.io.splats import labelled, read_splats, write_splats
from liftcore.scene.kernel import Kernel
from liftcore.scene.splats import Splats
from tests.promises.bad_files import glb_of, glb_parts
from tests.scenes import random_splats

FILES = Path(__file__).parents[2] / "data" / "splats"
P = 40


def some_splats(kernel: Kernel = Kernel.GAUSSIAN_3D) -> Splats:
    generator = np.random.default_rng(7)
    sh = generator.normal(size=(P, 16, 3)).astype("f4")
    return replace(random_splats(3, kernel=kernel, count=P), sh=torch.from_numpy(sh))


def activated(splats: Splats) -> dict[str, np.ndarray]:
    """Return the splats as the format stores them, with quaternions as rotation matrices."""
    (rows,) = gaussian_rows(splats)
    w, x, y, z = rows.quats.T
    turns = np.stack([w * w + x * x - 0.5, x * y - w * z, x * z + w * y, w * w + y * y - 0.5, y * z - w * x])
    assert splats.sh is not None
    fields = {"means": splats.positions(), "scales": rows.scales, "opacities": rows.opacities, "turns": turns}
    return fields | {"sh": splats.sh.numpy()}


def assert_same(actual: Splats, expected: Splats) -> None:
    actual_values, expected_values = activated(actual), activated(expected)
    for name, values in expected_values.items():
        np.testing.assert_allclose(
            actual_values[name], values, atol=1e-6 * max(1.0, np.abs(values).max()), err_msg=name
        )


def write(path: Path, splats: Splats) -> Path:
    path.write_bytes(b"".join(gltf_blocks(splats)))
    return path


def parts_of(path: Path) -> tuple[dict[str, Any], bytes]:
    return glb_parts(path.read_bytes())


def join(path: Path, document: dict[str, Any], binary: bytes) -> Path:
    path.write_bytes(glb_of(document, binary))
    return path


def test_what_the_format_has_no_word_for_is_kept(tmp_path: Path) -> None:
    splats = replace(some_splats(), render_mode="antialiased")
    assert read_splats(write(tmp_path / "s.glb", splats)).antialiased


def test_viewers_that_draw_points_have_linear_colours(tmp_path: Path) -> None:
    grey = replace(some_splats(), sh=torch.zeros(P, 1, 3))
    document, binary = parts_of(write(tmp_path / "s.glb", grey))
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    start = document["bufferViews"][accessor["bufferView"]].get("byteOffset", 0)
    assert [*binary[start : start + 3]] == [55, 55, 55]  # half of sRGB's range is .214 of the light


@pytest.mark.parametrize("kernel", [Kernel.GAUSSIAN_2D, Kernel.BETA])
def test_other_kernels_are_written_as_gaussians(kernel: Kernel, tmp_path: Path) -> None:
    splats = some_splats(kernel)
    assert_same(read_splats(write(tmp_path / "s.glb", splats)), splats)


def test_nodes_move_what_they_hold(tmp_path: Path) -> None:
    splats, half = some_splats(), np.sqrt(0.5)
    document, binary = parts_of(write(tmp_path / "s.glb", splats))
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # a quarter about z
    document["nodes"] = [
        {"children": [1, 2], "rotation": [0, 0, half, half], "translation": [1, 2, 3]},
        {"mesh": 0, "scale": [2, 2, 2]},
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]},
    ]
    scene = read_splats(join(tmp_path / "moved.glb", document, binary))
    assert scene.count == 2 * P
    in_our_frame = TO_FILE @ turn @ TO_FILE
    assert_same(scene[:P], splats.transformed(np.column_stack([2 * in_our_frame, TO_FILE @ [1, 2, 3]])))
    shift = TO_FILE @ (turn @ [5, 0, 0] + [1, 2, 3])
    assert_same(scene[P:], splats.transformed(np.column_stack([in_our_frame, shift])))


def test_buffers_of_other_things_in_the_model_do_not_matter(tmp_path: Path) -> None:
    path = write(tmp_path / "a.glb", splats := some_splats())
    document, binary = parts_of(path)
    document["buffers"].append({"uri": "mesh.bin", "byteLength": 8})
    assert_same(read_splats(join(path, document, binary)), splats)
    document["bufferViews"][0]["buffer"] = 1
    with pytest.raises(InvalidSplats, match=r"within the file as POSITION.*; make one \.glb of it, with its buffers"):
        read_splats(join(path, document, binary))


def labels() -> Labels:
    box = {"low": [-1.0, -2.0, -3.0], "high": [1.0, 2.0, 4.0]}
    oriented_box = {
        "centre": [0.1, 0.2, 0.3],
        "axes": [[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]],
        "half_sizes": [3.0, 2.0, 1.0],
    }
    mug = {"instance_id": 1, "class_id": 2, "name": "mug ☕", "score": 0.25, "confidence": 0.5, "colour": [1, 2, 255]}
    mug |= {"splats": 9, "box": box, "oriented_box": oriented_box, "question": "a mug", "provenance": "18 views"}
    document = {
        "instances": [mug, mug | {"instance_id": 2, "class_id": 1, "name": "plate"}],
        "classes": [{"class_id": 1, "name": "plate"}, {"class_id": 2, "name": "mug ☕"}],
    }
    columns = {"class_id": np.arange(P) % 3, "instance_id": (-np.arange(P)) % 3, "score": np.linspace(-1, 1, P)}
    kinds = {"class_id": "i4", "instance_id": "i4", "score": "f4"}
    return Labels({name: values.astype(kinds[name]) for name, values in columns.items()}, document)


def document_of(path: Path) -> dict[str, Any]:
    return parts_of(path)[0]["asset"]["extras"]["splatlift_labels"]


def test_labels_come_back_and_the_document_is_in_the_file(tmp_path: Path) -> None:
    expected = labels()
    write_splats(tmp_path / "s.ply", some_splats())
    (tmp_path / "s.glb").write_bytes(b"".join(labelled(tmp_path / "s.ply", expected, ".glb")))
    assert document_of(tmp_path / "s.glb") == expected.document
    extras = read_splats(tmp_path / "s.glb").extras
    for name, values in expected.columns.items():
        np.testing.assert_array_equal(extras[name], values)
    mask = np.arange(P) % 3 == 1
    (tmp_path / "t.glb").write_bytes(b"".join(labelled(tmp_path / "s.ply", expected, ".glb", mask)))
    assert [row["name"] for row in document_of(tmp_path / "t.glb")["classes"]] == ["plate"]
    assert set(read_splats(tmp_path / "t.glb").extras["class_id"].tolist()) == {1}


def test_feature_ids_of_others_count_from_one_with_zero_for_none(tmp_path: Path) -> None:
    columns = {"instance_id": np.arange(P) % 4, "class_id": np.arange(P) % 2}
    write_splats(tmp_path / "s.glb", some_splats(), columns)
    document, binary = parts_of(tmp_path / "s.glb")
    primitive = document["meshes"][0]["primitives"][0]
    primitive["extensions"]["EXT_mesh_features"] = {
        "featureIds": [{"featureCount": 3, "nullFeatureId": 3, "attribute": 0}]
    }
    extras = read_splats(join(tmp_path / "t.glb", document, binary)).extras
    assert extras["instance_id"].tolist() == [1, 2, 3, 0] * 10
    assert extras["class_id"].tolist() == [1, 2] * 20  # of an attribute alone, every id is a feature


def test_columns_come_back_or_are_refused(tmp_path: Path) -> None:
    path, splats = tmp_path / "s.glb", some_splats()
    columns = {f"c{number}": np.full(P, number / 4, np.float32) for number in range(256)}
    write_splats(path, splats, columns)
    extras = read_splats(path).extras
    assert {name: extras[name].tolist() for name in columns} == {
        name: values.tolist() for name, values in columns.items()
    }
    ids = np.tile([3.0, np.nan, -1.0, 4e9], P // 4)  # as editors may leave them
    write_splats(path, splats, {"instance_id": ids})
    assert read_splats(path).extras["instance_id"].tolist() == [3, 0, 0, 0] * (P // 4)
    with pytest.raises(InvalidSplats, match="whole numbers"):
        write_splats(path, splats, {"tag": np.full(P, 4_000_000_000, np.uint32)})
    with pytest.raises(InvalidSplats, match="at most"):
        write_splats(path, splats, {f"c{number}": np.zeros(P) for number in range(300)})


def test_columns_that_would_share_an_attribute_are_refused(tmp_path: Path) -> None:
    for names in (("A", "a"), ("instance_id", "feature_id_0")):
        with pytest.raises(InvalidSplats, match="more than their case"):
            write_splats(tmp_path / "s.glb", some_splats(), {name: np.arange(P) for name in names})
