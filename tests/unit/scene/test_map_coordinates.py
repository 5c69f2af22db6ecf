"""Scenes in map coordinates: as good as at the origin, with every place in the frame of their files."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData

import liftcore as lc
from liftcore.evaluate.inspect import describe_cameras, describe_splats
from liftcore.io.splat import splat_blocks
from liftcore.io.splats import read_places, read_splats, some_rows, with_columns, write_splats
from liftcore.io.spz import spz_blocks
from liftcore.lifting import pipeline
from liftcore.lifting.engines.base import LocalEngine
from liftcore.lifting.engines.lift import steps_in_blocks
from liftcore.lifting.files import lift_files
from liftcore.lifting.inputs import LiftInputs
from liftcore.lifting.planning.views import visibility
from liftcore.query.ask import ask, locate
from liftcore.query.catalogue import catalogue, table_csv
from liftcore.query.labels import labels
from liftcore.query.objects import objects
from liftcore.query.question import Query
from liftcore.query.render import expected_depth, render
from liftcore.query.scene import Scene
from liftcore.query.segment import segment
from liftcore.query.terms import Vector
from liftcore.raster.reference import dense_view
from liftcore.runtime.progress import Timings
from liftcore.scene.cameras import Camera, Cameras, viewmat_of
from liftcore.scene.compositing import CompositingParams
from liftcore.scene.kernel import Kernel
from liftcore.scene.origin import FILE_ORIGIN
from liftcore.scene.splats import Splats
from liftcore.values.lift import LiftMetadata
from liftcore.values.lift_file import open_lift, save_lift
from liftcore.values.settings import LiftSettings
from tests.api.tiny_scene import cameras_document, make_scene, ply, splat_rows
from tests.scenes import look_at, random_camera, random_regions, random_splats, splats_at
from tests.unit.command_line import run

UTM = np.array([500_000.25, 5_400_000.5, 300.125])
ROUNDING = 2e-5  # of float32 about an origin near the splats, in scene units; half a metre about the file's


def moved(splats: Splats, offset: np.ndarray = UTM) -> Splats:
    return replace(splats, means=splats.means.double() + torch.from_numpy(offset))


def moved_camera(camera: Camera, offset: np.ndarray = UTM) -> Camera:
    pose = camera.viewmat.copy()
    pose[:3, 3] -= pose[:3, :3] @ offset
    return camera.replace(viewmat=pose)


def scene_of(kernel: Kernel) -> tuple[Splats, list[Camera], dict[str, Any]]:
    cameras = [random_camera(k, 32 + 5 * k, 24 + 3 * k, name=f"v{k}") for k in range(4)]
    return (
        random_splats(3, 300, kernel=kernel),
        cameras,
        {one.name: random_regions(k) for k, one in enumerate(cameras)},
    )


def moved_back(splats: Splats, offset: np.ndarray = UTM) -> Splats:
    """The same splats at the origin, with the bits that they have about their own."""
    means = splats.means.double() + torch.tensor(splats.origin, dtype=torch.float64) - torch.from_numpy(offset)
    return replace(splats, means=means.float(), origin=FILE_ORIGIN)


@pytest.mark.parametrize("kernel", list(Kernel))
def test_a_moved_scene_has_the_same_features_pictures_and_plan(kernel: Kernel) -> None:
    splats, cameras, views = scene_of(kernel)
    there, there_cameras = moved(splats), [moved_camera(camera) for camera in cameras]
    settings = LiftSettings.of(dtype="float32", robust_steps=1)
    here = lc.lift(splats, Cameras(cameras), views, settings)
    far = lc.lift(there, Cameras(there_cameras), views, settings)
    assert far.metadata.origin == there.origin != FILE_ORIGIN
    assert np.abs(np.array(there.origin) - UTM).max() < 4
    assert torch.equal(far.seen, here.seen)
    apart = (far.features - here.features).norm(dim=1) / here.features.norm(dim=1).clamp_min(1e-9)
    assert float(apart[here.seen].quantile(0.95)) < 1e-3  # rays at the edge of a splat may fall on its other side
    assert torch.allclose(far.total_weight, here.total_weight, rtol=1e-2, atol=1e-2)
    first, second = Scene(here, splats, Cameras(cameras)), Scene(far, there, Cameras(there_cameras))
    for name in ("v0", "v3"):
        for one, other in zip(expected_depth(first, name), expected_depth(second, name), strict=True):
            assert np.mean(~np.isclose(one, other, atol=1e-3)) < 0.01
        pictures = (render(scene, name, "rgb").astype(int) for scene in (first, second))
        assert np.abs(next(pictures) - next(pictures)).mean() < 0.1
    params = CompositingParams()
    near, away = (visibility(of, these, params) for of, these in ((splats, cameras), (there, there_cameras)))
    assert np.allclose(near.areas, away.areas, rtol=1e-2, atol=1e-2)
    assert np.allclose(near.centres - near.means[:4], away.centres - away.means[:4], atol=1e-4)


@pytest.mark.parametrize("kernel", list(Kernel))
def test_the_plain_raster_sees_a_moved_scene_as_it_stood(kernel: Kernel) -> None:
    splats, camera = random_splats(5, 60, kernel=kernel), random_camera(5)
    there = moved(splats)
    here = dense_view(moved_back(there), camera, CompositingParams())
    far = dense_view(there, moved_camera(camera), CompositingParams())
    sure = ~(here.cut | far.cut)
    assert sure.mean() > 0.5
    assert np.allclose(far.A[sure], here.A[sure], atol=1e-4)


@pytest.mark.parametrize("kernel", list(Kernel))
def test_an_offset_that_float64_holds_leaves_every_bit(kernel: Kernel) -> None:
    # Cameras along the axes, whose poses an offset of whole numbers moves without rounding.
    offset = np.array([524_288.0, 4_194_304.0, 8_192.0])
    splats, cameras, views = scene_of(kernel)
    centres = np.array([(0.0, 0, -4), (4, 0, 0), (0, 0, 4), (-4, 0, 0)])
    cameras = [look_at(f"v{k}", centre, 32, 24, 30.0) for k, centre in enumerate(centres)]
    there = moved(splats, offset)
    lifts = [
        lc.lift(replace(splats, means=there.means), Cameras(cameras), views),
        lc.lift(there, Cameras([moved_camera(camera, np.array(there.origin)) for camera in cameras]), views),
    ]
    for name in ("features", "total_weight", "agreement", "seen"):
        assert torch.equal(getattr(lifts[0], name), getattr(lifts[1], name)), name


def test_scenes_about_their_own_origin_keep_it_and_their_bits() -> None:
    plain = random_splats(1)
    near = np.array([40.0, -300.0, 7.0])
    for splats in (
        plain,
        splats_at([[1.0, 2.0, 3.0]]),
        splats_at([[0.001, 2000.0, 3.0]], log_scales=0.0),
        replace(plain, means=torch.cat([plain.means[:-1], torch.full((1, 3), 1e7)])),  # a floater
        replace(plain, means=plain.means + torch.tensor(near, dtype=torch.float32)),
        replace(plain, means=plain.means * 1e5, log_scales=plain.log_scales + 11.5),  # millimetres of a house
    ):
        again = Splats(splats.means.double().numpy(), splats.quats, splats.log_scales, splats.opacity_logits)
        assert again.origin == FILE_ORIGIN and again.warnings == ()
        assert torch.equal(again.means, splats.means)
        assert np.array_equal(again.positions(), splats.means.numpy())


def test_an_origin_stays_with_splats_that_are_changed_and_a_broken_one_is_refused() -> None:
    there = moved(random_splats(2))
    some = replace(there, **{name: getattr(there, name)[:5] for name in ("means", "quats", "log_scales", "sh")},
                   opacity_logits=there.opacity_logits[:5])  # fmt: skip
    assert some.origin == there.origin
    assert np.array_equal(some.positions(), there.positions()[:5])
    with pytest.raises(lc.InvalidSplats, match="origin"):
        replace(there, origin=(1.0, float("nan"), 0.0))


def doubles(path: Path, splats: Splats, offset: np.ndarray) -> None:
    write_splats(path, moved(splats, offset))


def floats(path: Path, splats: Splats, offset: np.ndarray) -> None:
    write_splats(path, replace(splats, means=(splats.means.double() + torch.from_numpy(offset)).float()))


def checkpoint(path: Path, splats: Splats, offset: np.ndarray) -> None:
    means = splats.means.double() + torch.from_numpy(offset)
    named = {"means": means, "quats": splats.quats, "scales": splats.log_scales, "opacities": splats.opacity_logits}
    torch.save({"splats": named | {"sh0": splats.sh, "shN": torch.zeros(splats.count, 0, 3)}}, path)


def splat(path: Path, splats: Splats, offset: np.ndarray) -> None:
    shifted = (splats.means.double() + torch.from_numpy(offset)).float()
    path.write_bytes(b"".join(splat_blocks(replace(splats, means=shifted))))


FILES = {"doubles.ply": (doubles, 1e-5), "scene.pt": (checkpoint, 1e-5), "floats.ply": (floats, 0.5),
         "scene.splat": (splat, 0.5)}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_every_file_gives_the_positions_that_it_holds(name: str, tmp_path: Path) -> None:
    write, step = FILES[name]
    splats, path = random_splats(4, 200), tmp_path / name
    write(path, splats, UTM)
    read = read_splats(path)
    wanted = splats.means.double().numpy() + UTM
    assert read.origin != FILE_ORIGIN and np.abs(read.means.numpy()).max() < 16
    assert np.abs(read.positions() - wanted).max() <= step
    assert np.array_equal(read_places(path), read.positions())
    assert any("float32" in warning for warning in read.warnings) == (step > 0.1)
    described = describe_splats(read)
    assert np.abs(np.array(described["box"]) - [wanted.min(axis=0), wanted.max(axis=0)]).max() <= step
    assert described["origin"] == list(read.origin)
    # What is written is in the same frame: doubles, or the file's own bytes.
    kept = np.arange(200) % 3 == 0
    (tmp_path / "some.ply").write_bytes(b"".join(some_rows(path, kept)))
    assert np.abs(read_splats(tmp_path / "some.ply").positions() - read.positions()[kept]).max() <= ROUNDING
    numbers = {"object": np.arange(200, dtype=np.int32)}
    (tmp_path / "more.ply").write_bytes(b"".join(with_columns(path, numbers)))
    assert np.abs(read_splats(tmp_path / "more.ply").positions() - read.positions()).max() <= ROUNDING
    # The formats of viewers are about the origin: they have no room for it.
    for suffix, blocks in ((".splat", splat_blocks), (".spz", spz_blocks)):
        (tmp_path / f"again{suffix}").write_bytes(b"".join(blocks(read)))
        again = read_splats(tmp_path / f"again{suffix}")
        assert again.origin == FILE_ORIGIN and torch.allclose(again.means, read.means, atol=1e-5)


QUANTISED = Path(__file__).parents[2] / "data" / "splats"  # as splat-transform wrote them
PLACE = np.array([65_536.0, 40_960.0, 512.0])  # scene units; an .spz reaches no further with a hundredth of one


def compressed_ply(path: Path) -> np.ndarray:
    """Write a compressed PLY whose chunks are moved; the positions that it then says."""
    source = QUANTISED / "degree1.compressed.ply"
    there, said = PlyData.read(source), read_splats(source).positions().astype(np.float64)
    chunks = there["chunk"].data
    for axis, name in enumerate("xyz"):
        low, high = (chunks[f"{end}_{name}"] for end in ("min", "max"))
        of_row = np.arange(len(said)) // 256
        unit = (said[:, axis] - low[of_row]) / (high - low).astype(np.float64)[of_row]
        low += np.float32(PLACE[axis])
        high += np.float32(PLACE[axis])
        said[:, axis] = low[of_row] * (1 - unit) + high[of_row].astype(np.float64) * unit
    there.write(path)
    return said


def sog(path: Path) -> np.ndarray:
    """Write a SOG between bounds that are moved; the positions that it then says."""
    source = QUANTISED / "degree1.sog"
    said = read_splats(source).positions().astype(np.float64)
    with zipfile.ZipFile(source) as given, zipfile.ZipFile(path, "w") as made:
        for name in given.namelist():
            content = given.read(name)
            if name == "meta.json":
                meta = json.loads(content)
                low, high = (np.array(meta["means"][key]) for key in ("mins", "maxs"))
                unit = (np.sign(said) * np.log1p(np.abs(said)) - low) / (high - low)
                low, high = np.log1p(PLACE - 2), np.log1p(PLACE + 2)
                meta["means"] |= {"mins": low.tolist(), "maxs": high.tolist()}
                said = np.expm1(low + unit * (high - low))
                content = json.dumps(meta).encode()
            made.writestr(name, content)
    return said


def spz(path: Path) -> np.ndarray:
    """Write an ``.spz`` about the origin of its file; the positions that it was made of, to its last bit."""
    splats = random_splats(4, 200)
    there = replace(splats, means=(splats.means.double() + torch.from_numpy(PLACE)).float(), origin=FILE_ORIGIN)
    path.write_bytes(b"".join(spz_blocks(there)))
    return there.positions().astype(np.float64)


@pytest.mark.parametrize(("write", "step"), [(compressed_ply, 2e-5), (sog, 2e-5), (spz, 1 / 128)])
def test_quantised_files_far_from_their_origin_keep_their_digits(write: Any, step: float, tmp_path: Path) -> None:
    wanted = write(tmp_path / "far")
    read = read_splats(tmp_path / "far")
    assert read.origin != FILE_ORIGIN and np.abs(np.array(read.origin) - PLACE).max() < 16
    assert np.abs(read.positions() - wanted).max() <= step
    assert np.array_equal(read_places(tmp_path / "far"), read.positions())


def test_check_says_of_a_moved_scene_what_it_says_where_it_stood(
    tiny: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answers = []
    for name, lift in tiny.items():
        folder, photos = lift.parent, tmp_path / name
        photos.mkdir()
        for view in ("left", "middle", "right"):
            assert run(capsys, "render", tiny["here"], "--view", view, "-o", photos / f"{view}.png")[0] == 0
        (folder / "f.safetensors").write_bytes((folder / "f.st").read_bytes())
        files = folder / "s.ply", folder / "c.json", photos, folder / "f.safetensors"
        status, out, err = run(capsys, "check", *files, "--json")
        answers.append({"status": status, "err": err, **json.loads(out)})
    here, far = answers
    assert (here["status"], here["wrong"]) == (far["status"], far["wrong"]) and here["err"] == far["err"] == ""
    assert np.isclose(here["in_view"], far["in_view"]) and far["in_view"] > 0.9
    for one, other in zip(here["views"], far["views"], strict=True):
        assert np.allclose([one["row_sum"], one["psnr"]], [other["row_sum"], other["psnr"]], atol=0.1), one["view"]


def test_cameras_whose_rotation_has_few_digits_stand_where_their_file_says() -> None:
    camera = random_camera(9)
    rotation = camera.viewmat[:3, :3].T.astype(np.float32).astype(np.float64)
    rotation[:, 0] *= 1 + 1e-5  # as of a file with five digits
    there = camera.replace(viewmat=viewmat_of(rotation, UTM))
    assert np.abs(there.centre - UTM).max() < 1e-6
    assert np.abs(there.about((500_000.0, 5_400_000.0, 256.0)).centre - (0.25, 0.5, 44.125)).max() < 1e-2
    assert there.about(FILE_ORIGIN) is there
    assert np.allclose(describe_cameras(Cameras([there]))["box"], [UTM, UTM], atol=1e-6, rtol=0)


def asked_of(splats: Splats, cameras: Cameras, views: dict[str, Any]) -> dict[str, Any]:
    """Every answer that has a place in it: boxes and points [n, 3], and the rows that they are of."""
    lift = lc.lift(splats, cameras, views, LiftSettings.of(dtype="float32"))
    scene = Scene(lift, splats, cameras)
    vectors = np.eye(6, dtype=np.float32)[:2]
    answer = ask(scene, Query.of((Vector(tuple(vectors[0].tolist())),), threshold=0.2, absent="keep"))
    best, parts = locate(scene, answer, 5), objects(scene, answer)
    words = segment(scene, ["one", "two"], vectors)
    told = labels(scene, words).document
    whole = replace(lift, object=torch.arange(len(lift.features)).int() % 2, object_views=torch.zeros(2, 5).int())
    things = catalogue(Scene(whole, splats, cameras))
    rows = [line.split(",")[5:14] for line in table_csv(things).decode().splitlines()[1:]]
    return {
        "top": [one.position for one in best.top],
        "box": best.box,
        "objects": [point for one in parts.objects for point in (one.centre, *one.box)],
        "words": [point for one in words.named_words for point in one.box],
        "labels": [one["oriented_box"]["centre"] for one in told["instances"]],
        "catalogue": [point for one in things.objects for point in (one.centre, *one.box)],
        "table": np.array(rows, float).reshape(-1, 3),
    }


def test_every_answer_with_a_place_is_in_the_frame_of_the_file() -> None:
    splats, cameras, views = scene_of(Kernel.GAUSSIAN_3D)
    here = asked_of(splats, Cameras(cameras), views)
    far = asked_of(moved(splats), Cameras([moved_camera(camera) for camera in cameras]), views)
    for name, places in here.items():
        assert len(places) and np.abs(np.array(far[name]) - np.array(places) - UTM).max() < 1e-3, name


def test_a_lift_in_blocks_and_its_file_keep_the_origin(tmp_path: Path) -> None:
    splats, cameras, views = scene_of(Kernel.GAUSSIAN_3D)
    there, cameras = moved(splats), [moved_camera(camera) for camera in cameras]
    settings = LiftSettings.of(preset="row-sum")
    one = lc.lift(there, Cameras(cameras), views, settings)
    inputs, timings = LiftInputs.of(there, Cameras(cameras), views, settings), Timings()
    with steps_in_blocks(LocalEngine(), inputs, timings, selected=9) as steps:
        other = pipeline.run(steps, inputs, timings, lambda _: None)
    assert torch.equal(one.features, other.features) and one.metadata.origin == other.metadata.origin
    save_lift(other, tmp_path / "scene.lift")
    assert open_lift(tmp_path / "scene.lift").metadata.origin == there.origin
    told = one.metadata.model_dump()
    del told["origin"]  # as a lift of before has it
    assert LiftMetadata(**told).origin == FILE_ORIGIN


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The lift of a scene of files at the origin, and of the same moved: a PLY of doubles and a transforms.json."""
    lifts = {}
    for name, offset in (("here", np.zeros(3)), ("far", UTM)):
        folder, tiny = tmp_path_factory.mktemp(name), make_scene()
        rows = splat_rows()
        doubled = rows.astype("f8")
        doubled[:, :3] += offset
        (folder / "s.ply").write_bytes(
            ply(rows).split(b"end_header")[0].replace(b"float", b"double") + b"end_header\n"
        )
        with (folder / "s.ply").open("ab") as file:
            file.write(doubled.tobytes())
        document = cameras_document()
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] += offset
            frame["transform_matrix"] = pose.tolist()
        (folder / "c.json").write_text(json.dumps(document))
        (folder / "f.st").write_bytes(tiny.features)
        lift = lift_files(folder / "s.ply", folder / "c.json", [folder / "f.st"], LiftSettings.of(preset="row-sum"))
        save_lift(lift, folder / "scene.lift")
        lifts[name] = folder / "scene.lift"
    return lifts


def test_the_command_line_tells_places_in_the_frame_of_the_file(
    tiny: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["--like", "left:16,12", "--threshold", "0.5", "--top", "3", "--objects"]
    told = {}
    for name, lift in tiny.items():
        status, out, err = run(capsys, "query", lift, *asked, "--object", tmp_path / f"{name}.ply", "--json")
        assert (status, err) == (0, "")
        told[name] = json.loads(out)
    here, far = ([*(one["position"] for one in found["top"]), *found["box"], *found["objects"][0]["box"]]
                 for found in told.values())  # fmt: skip
    assert np.abs(np.array(far) - np.array(here) - UTM).max() < ROUNDING
    assert [one["splat"] for one in told["far"]["top"]] == [one["splat"] for one in told["here"]["top"]]
    positions = [read_splats(tmp_path / f"{name}.ply").positions() for name in told]
    assert np.abs(positions[1] - positions[0] - UTM).max() < ROUNDING
    status, out, _ = run(capsys, "query", tiny["far"], *asked, "--object", tmp_path / "far.splat")
    assert status == 0 and "5400000" in out.splitlines()[-1]
    assert np.abs(read_splats(tmp_path / "far.splat").means.numpy()).max() < 16
    status, out, _ = run(capsys, "inspect", tiny["far"].parent / "s.ply", "--json")
    assert status == 0 and np.abs(np.array(json.loads(out)["box"]) - UTM).max() < 8
    [shown] = [line for line in run(capsys, "inspect", tiny["far"].parent / "s.ply")[1].splitlines() if "box" in line]
    corners = [float(number.strip("(),")) for number in shown.split()[1:]]
    assert np.abs(np.array(corners) - np.array(json.loads(out)["box"]).ravel()).max() < 2e-3
