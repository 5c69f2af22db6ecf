"""Each experiment runs as a command on a scene with truth, and finds what is known of that scene."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from liftcore.cli import EXPERIMENTS, main
from liftcore.io.cameras import read_cameras
from tests.benchmarks.experiments.report import page_of
from tests.truth_scene import write_truth_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small scene, written once."""
    return write_truth_scene(tmp_path_factory.mktemp("balls"))


def run(name: str, scene: Path, out: Path) -> dict:
    """The document that the command writes."""
    assert main(["experiment", name, str(scene), "-o", str(out)]) == 0
    with Image.open(out / f"{name}-{scene.name}.png") as plot:
        assert min(plot.size) > 400
    return json.loads((out / f"{name}-{scene.name}.json").read_text())


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_has_a_title_a_source_and_rows(scene, tmp_path, name, monkeypatch):
    _keep_it_short(monkeypatch)
    document = run(name, scene, tmp_path)
    assert document["title"] and document["source"] and document["rows"]
    assert all(column in row for row in document["rows"] for column in document["columns"])
    assert document["command"].startswith(f"splatlift experiment {name}")
    assert document["hardware"]["cores"] >= 1


def _keep_it_short(monkeypatch):
    """Fewer points a curve; each kind of point stays."""
    from tests.benchmarks.experiments import conditioning, fidelity, lambda_sweep, mask_noise, overfitting, pose_noise

    monkeypatch.setattr(conditioning, "GAINS", (1.0, 4.0))
    monkeypatch.setattr(conditioning, "RAYS", 3_000)
    monkeypatch.setattr(conditioning, "ROOM_SPLATS", 100)
    monkeypatch.setattr(fidelity, "PRESETS", ("row-sum", "tikhonov"))
    monkeypatch.setattr(lambda_sweep, "PAIRS", ((1.0, 1.0), (1.2, 1.2), (0.5, 1.0)))
    monkeypatch.setattr(mask_noise, "RATES", (0.0, 0.6))
    monkeypatch.setattr(overfitting, "STEPS", 3)
    monkeypatch.setattr(pose_noise, "SHARES", (0, 100))
    monkeypatch.setattr(pose_noise, "SEEDS", (0,))


def test_row_sums_stay_below_one(scene, tmp_path):
    rows = run("row_sums", scene, tmp_path)["rows"]
    assert [row["gain"] for row in rows] == [1.0, 1.2]
    assert all(0 <= row["min"] <= row["mean"] <= 1 for row in rows)


def test_polarised_opacities_leave_splats_more_to_themselves(scene, tmp_path, monkeypatch):
    _keep_it_short(monkeypatch)
    rows = [row for row in run("conditioning", scene, tmp_path)["rows"] if row["scene"] == "room"]
    assert [row["gain"] for row in rows] == [1.0, 4.0]
    assert rows[1]["own_share_w"] > rows[0]["own_share_w"]
    assert all(row["own_share_w2"] > row["own_share_w"] and row["noise_w2"] > row["noise_w"] for row in rows)
    assert all(row["cond_w"] > 1 and row["coupling"] > 1 for row in rows)


def test_wrong_masks_cost_accuracy(scene, tmp_path, monkeypatch):
    _keep_it_short(monkeypatch)
    rows = {(row["method"], row["rate"]): row for row in run("mask_noise", scene, tmp_path)["rows"]}
    assert rows["row-sum", 0.0]["accuracy"] > 0.99
    assert rows["row-sum", 0.6]["miou"] < rows["row-sum", 0.0]["miou"]


def test_wrong_poses_cost_accuracy(scene, tmp_path, monkeypatch):
    _keep_it_short(monkeypatch)
    monkeypatch.setattr("tests.benchmarks.noise.POSE_DEGREES", 15.0)
    rows = {(row["method"], row["noisy_of_100"]): row for row in run("pose_noise", scene, tmp_path)["rows"]}
    assert rows["tikhonov", 100]["miou"] < rows["tikhonov", 0]["miou"]


def test_exact_masks_are_rendered_faithfully(scene, tmp_path, monkeypatch):
    _keep_it_short(monkeypatch)
    rows = {(row["pack"], row["preset"]): row for row in run("fidelity", scene, tmp_path)["rows"]}
    assert rows["features_clean", "row-sum"]["cosine"] > 0.9
    assert rows["features_hard", "row-sum"]["cosine"] < rows["features_clean", "row-sum"]["cosine"]


def test_the_report_holds_every_table_and_plot(scene, tmp_path):
    run("row_sums", scene, tmp_path / "found")
    page = page_of(tmp_path / "found")
    assert "## Row sums of A" in page
    assert f"(found/row_sums-{scene.name}.png)" in page
    assert page.count("\n| ") >= 3


def test_cameras_are_read_in_any_format(scene, tmp_path):
    folder = tmp_path / "colmap"
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "point_cloud.ply").symlink_to(scene / "point_cloud.ply")
    lines, cameras = [], list(read_cameras(scene / "cameras.json").values())
    for number, camera in enumerate(cameras, start=1):
        x, y, z, w = Rotation.from_matrix(camera.viewmat[:3, :3]).as_quat()
        place = " ".join(map(str, (w, x, y, z, *camera.viewmat[:3, 3])))
        lines += [f"{number} {place} 1 {camera.name}.jpg", ""]
    lens = cameras[0]
    sides = (lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
    (folder / "sparse" / "0" / "cameras.txt").write_text(f"1 PINHOLE {' '.join(map(str, sides))}\n")
    (folder / "sparse" / "0" / "images.txt").write_text("\n".join(lines) + "\n")
    ours, theirs = run("row_sums", folder, tmp_path)["rows"], run("row_sums", scene, tmp_path)["rows"]
    assert [row["mean"] for row in ours] == pytest.approx([row["mean"] for row in theirs], abs=1e-6)


@pytest.mark.parametrize("name", ["ablation", "kernels", "lambda_sweep", "mask_noise", "overfitting", "pose_noise"])
def test_a_scene_without_truth_is_told_what_truth_is(scene, tmp_path, capsys, name):
    for file in ("point_cloud.ply", "cameras.json", "features.safetensors", "truth.json"):
        (tmp_path / file).symlink_to(scene / file)
    assert main(["experiment", name, str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert "truth in the layout of tabletop" in err and "no truth.safetensors and no text_table.safetensors" in err
    assert "Errno" not in err and err.count("\n") == 1


def test_truth_of_another_layout_is_bad_input(scene, tmp_path, capsys):
    for file in scene.iterdir():
        (tmp_path / file.name).symlink_to(file)
    (tmp_path / "truth.json").unlink()
    (tmp_path / "truth.json").write_text("{}")
    assert main(["experiment", "ablation", str(tmp_path)]) == 2
    assert "truth in the layout of tabletop" in capsys.readouterr().err


def test_truth_of_distorted_photos_is_told_what_takes_it(scene, tmp_path, capsys):
    for file in scene.iterdir():
        (tmp_path / file.name).symlink_to(file)
    (tmp_path / "cameras.json").unlink()
    frames = []
    for camera in read_cameras(scene / "cameras.json").values():
        pose = np.linalg.inv(camera.viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
        photo = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "k1": -0.1}
        frames.append({"file_path": f"{camera.name}.jpg", "transform_matrix": pose.tolist(), **photo})
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    assert main(["experiment", "ablation", str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert "undistorted cameras beside its truth" in err and "splatlift tradeoff --labels" in err


@pytest.mark.parametrize("name", ["fidelity", "ablation"])
def test_a_scene_without_any_of_the_packs_is_told_which(scene, tmp_path, capsys, monkeypatch, name):
    monkeypatch.setattr(f"tests.benchmarks.experiments.{name}.PACKS", ("other", "more"))
    assert main(["experiment", name, str(scene), "-o", str(tmp_path)]) == 2
    assert "one of other.safetensors, more.safetensors" in capsys.readouterr().err


def test_a_folder_that_is_no_scene_is_bad_input(tmp_path, capsys):
    assert main(["experiment", "row_sums", str(tmp_path)]) == 2
    assert "point_cloud.ply" in capsys.readouterr().err
