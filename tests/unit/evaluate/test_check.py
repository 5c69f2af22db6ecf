"""``splatlift check``: reports inputs that contradict each other, and no healthy ones."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

from liftcore import cli
from liftcore.evaluate.check import check_scene
from liftcore.io.inria import write_inria_cameras
from liftcore.io.splats import write_splats
from liftcore.lifting.planning import contradictions
from liftcore.lifting.planning.contradictions import ViewAgreement
from liftcore.query.splat_colours import view_colours
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.cameras import Cameras
from liftcore.scene.compositing import CompositingParams
from liftcore.text.table import TableEncoder
from liftcore.values.lift_views import LiftViews
from liftcore.values.pack import as_views, read_features, write_pack
from liftcore.values.settings import LiftSettings
from liftcore.values.views import FeatureGrid, Regions
from tests.still_life.masks import Mistakes, observe
from tests.still_life.scene import StillLife, still_life


@pytest.fixture(scope="module")
def scene() -> StillLife:
    return still_life(seed=7, views=4, density=0.1)


@pytest.fixture(scope="module")
def photos(scene: StillLife, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder, raster = tmp_path_factory.mktemp("photos"), CpuRaster(scene.splats)
    for name, camera in scene.cameras.items():
        image = raster.render(camera, view_colours(scene.splats, camera), CompositingParams()).clamp(0, 1).numpy()
        Image.fromarray((255 * image).astype(np.uint8)).save(folder / f"{name}.png")
    return {path.stem: path for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def grids(photos: dict[str, Path]) -> dict[str, FeatureGrid]:
    """Return feature maps of the photos: their colours at low resolution, encoded as cosines in 32 channels."""
    maps = {}
    for name, path in photos.items():
        with Image.open(path) as image:
            small = np.asarray(image.resize((24, 18)), np.float32) / 255
        waves = np.random.default_rng(0).normal(size=(3, 32)).astype(np.float32)
        maps[name] = FeatureGrid(torch.from_numpy(np.cos(2 * small @ waves)))
    return maps


def test_what_belongs_together_is_healthy(scene: StillLife, photos, grids) -> None:
    report = check_scene(scene.splats, scene.cameras, photos, as_views(grids))
    assert report.wrong == () and report.notes == ()
    assert {view.view for view in report.views} == set(scene.cameras) and report.in_view > 0.9
    assert all(view.psnr and view.other_psnr and view.psnr > 30 > view.other_psnr for view in report.views)
    assert report.features["neighbouring_cells"] > report.features["[F, h, w]"] and report.worst is not None


def test_what_the_reader_of_cameras_says_is_noted(scene: StillLife) -> None:
    cameras = Cameras(scene.cameras.values(), warnings=["sparse/1 was read, and sparse/0 was not"])
    assert "cameras: sparse/1 was read, and sparse/0 was not" in check_scene(scene.splats, cameras).notes


def test_cameras_of_another_scale_are_recognised_from_photos(scene: StillLife, photos) -> None:
    scaled_cameras = []
    for camera in scene.cameras.values():
        pose = camera.viewmat.copy()
        pose[:3, 3] *= 0.3
        scaled_cameras.append(camera.replace(viewmat=pose))
    (problem,) = check_scene(scene.splats, Cameras(tuple(scaled_cameras)), photos).wrong
    assert problem.startswith("photos: renders are hardly more like their own photos")


def saved(photos, folder: Path, change, orientation: int = 1) -> dict[str, Path]:
    """Save the photos after `change` of their pixels, with an EXIF orientation; return their paths by view."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    folder.mkdir()
    for name, path in photos.items():
        with Image.open(path) as image:
            pixels = np.ascontiguousarray(change(np.asarray(image)))
        Image.fromarray(pixels).save(folder / f"{name}.png", exif=exif)
    return {name: folder / f"{name}.png" for name in photos}


SHAPES = {
    "crops of a video": (lambda image: image[image.shape[0] // 8 : -image.shape[0] // 8], "another shape than their"),
    "centre squares": (lambda image: image[:, : image.shape[0]], "another shape than their cameras"),
    "on their side": (np.rot90, "lie on their side"),
}


@pytest.mark.parametrize("case", SHAPES)
def test_photos_of_another_shape_are_reported_before_any_render(
    case: str, scene: StillLife, photos, tmp_path
) -> None:
    change, message = SHAPES[case]
    report = check_scene(scene.splats, scene.cameras, saved(photos, tmp_path / "changed", change))
    (problem,) = report.wrong
    assert message in problem and "4 of 4" in problem
    assert all(view.psnr is None for view in report.views)


def test_photos_of_the_same_shape_in_another_size_are_healthy(scene: StillLife, photos, tmp_path) -> None:
    half = saved(photos, tmp_path / "half", lambda image: image[::2, ::2])
    double = saved(photos, tmp_path / "double", lambda image: image.repeat(2, 0).repeat(2, 1))
    for resized in (half, double):
        report = check_scene(scene.splats, scene.cameras, resized)
        assert report.wrong == () and report.notes == ()


@pytest.mark.parametrize("tag", [2, 3, 6])
def test_photos_are_read_as_cameras_have_them_whatever_their_exif(
    tag: int, scene: StillLife, photos, tmp_path
) -> None:
    report = check_scene(scene.splats, scene.cameras, saved(photos, tmp_path / "tagged", lambda image: image, tag))
    assert report.wrong == ()
    assert "4 of 4 photos" in report.notes[0] and "EXIF" in report.notes[0]


def test_photos_whose_exif_is_applied_in_their_cameras_are_turned_where_sizes_tell(
    scene: StillLife, photos, tmp_path
) -> None:
    report = check_scene(scene.splats, scene.cameras, saved(photos, tmp_path / "tagged", np.rot90, 6))
    assert report.wrong == () and "were turned as their EXIF asks" in report.notes[0]


CAUSES = {  # change of the pixels and EXIF orientation -> the cause that is reported
    "EXIF that cameras have applied": (lambda image: image[::-1, ::-1], 3, "as their EXIF turns them"),
    "turned": (lambda image: image[::-1, ::-1], 1, "photos and cameras are turned to each other"),
    "mirrored": (lambda image: image[:, ::-1], 1, "mirrored left to right"),
    "upside down": (lambda image: image[::-1], 1, "mirrored upside down"),
}


@pytest.mark.parametrize("case", CAUSES)
def test_the_cause_of_photos_unlike_their_renders_is_named(case: str, scene: StillLife, photos, tmp_path) -> None:
    change, tag, cause = CAUSES[case]
    (problem,) = check_scene(scene.splats, scene.cameras, saved(photos, tmp_path / "changed", change, tag)).wrong
    assert cause in problem
    assert "positions times" not in problem and "frame" not in problem


def test_single_photos_that_are_turned_are_named(scene: StillLife, photos, tmp_path) -> None:
    for number, (name, path) in enumerate(photos.items()):
        image = Image.open(path)
        (image.transpose(Image.Transpose.ROTATE_180) if number == 1 else image).save(tmp_path / f"{name}.png")
    report = check_scene(scene.splats, scene.cameras, {name: tmp_path / f"{name}.png" for name in photos})
    [problem] = report.wrong
    assert f"1 of the {len(photos)}" in problem and repr(list(photos)[1]) in problem and "180 degrees" in problem


@pytest.mark.parametrize("transparent", [True, False])
def test_photos_without_a_background_are_healthy(transparent: bool, scene: StillLife, photos, tmp_path) -> None:
    raster = CpuRaster(scene.splats)
    for name, camera in scene.cameras.items():
        ones = torch.ones(scene.splats.count, 1)
        opacity = raster.render(camera, ones, CompositingParams()).clamp(0, 1).numpy()
        photo = np.asarray(Image.open(photos[name]), np.float32)
        over_white = Image.fromarray((photo + 255 * (1 - opacity)).clip(0, 255).astype(np.uint8))
        straight = np.concatenate([photo / np.maximum(opacity, 1e-3), 255 * opacity], axis=2).clip(0, 255)
        image = Image.fromarray(straight.astype(np.uint8), "RGBA") if transparent else over_white
        image.save(tmp_path / f"{name}.png")
    report = check_scene(scene.splats, scene.cameras, {name: tmp_path / f"{name}.png" for name in photos})
    assert report.wrong == () and min(view.psnr or 0.0 for view in report.views) > 30


def test_photos_of_another_scene_blame_no_scale_and_no_turn(scene: StillLife, photos, tmp_path) -> None:
    names, rng = list(photos), np.random.default_rng(3)
    swapped = {name: photos[names[(k + 1) % len(names)]] for k, name in enumerate(names)}
    noise = saved(photos, tmp_path / "noise", lambda image: rng.integers(0, 255, image.shape).astype(np.uint8))
    for wrong in (swapped, noise):
        (problem,) = check_scene(scene.splats, scene.cameras, wrong).wrong
        assert "not of each other" in problem and "times about" not in problem and "EXIF" not in problem


def test_cameras_of_half_the_scale_are_reported_with_the_scale(scene: StillLife, photos) -> None:
    scale = np.ones((4, 4))
    scale[:3, 3] = 0.5
    scaled_cameras = Cameras([camera.replace(viewmat=camera.viewmat * scale) for camera in scene.cameras.values()])
    (problem,) = check_scene(scene.splats, scaled_cameras, photos).wrong
    assert "with positions times about 2 " in problem


def test_cameras_of_another_scale_are_recognised_from_features_alone() -> None:
    scene = still_life(seed=7, views=12, density=0.1)
    words = TableEncoder("words", [*scene.objects, *scene.parts], np.eye(len(scene.objects) + len(scene.parts)))
    masks = as_views(observe(scene, CpuRaster(scene.splats), words, Mistakes(), 7))
    scale = np.ones((4, 4))
    scale[:3, 3] = 0.3
    scaled_cameras = Cameras([camera.replace(viewmat=camera.viewmat * scale) for camera in scene.cameras.values()])
    assert check_scene(scene.splats, scene.cameras, features=masks).wrong == ()
    (problem,) = check_scene(scene.splats, scaled_cameras, features=masks).wrong
    assert "with positions times about" in problem


def test_a_principal_point_that_is_off_is_no_scale() -> None:
    scene = still_life(seed=7, views=12, density=0.1)
    words = TableEncoder("words", [*scene.objects, *scene.parts], np.eye(len(scene.objects) + len(scene.parts)))
    observed = observe(scene, CpuRaster(scene.splats), words, Mistakes(), 7)
    masks = as_views(observed)
    scrambled = {
        name: Regions(regions.labels, regions.codebook.roll(k, 0))
        for k, (name, regions) in enumerate(observed.items())
    }
    off = [camera.replace(cx=camera.cx + 0.15 * camera.width) for camera in scene.cameras.values()]
    for cameras, features in ((Cameras(off), masks), (scene.cameras, as_views(scrambled))):
        for text in check_scene(scene.splats, cameras, features=features).wrong:
            assert "positions times" not in text and "share a frame" not in text


def test_cameras_that_see_nothing_are_reported_without_photos(scene: StillLife) -> None:
    away = replace(scene.splats, means=scene.splats.means + 1000)
    report = check_scene(away, scene.cameras)
    assert len(report.wrong) == 2 and all(problem.startswith("cameras: ") for problem in report.wrong)
    assert "none were given" in report.notes[0]


def test_grids_whose_bytes_lie_in_another_order_are_reported(scene: StillLife, grids) -> None:
    transposed = {
        name: FeatureGrid(grid.grid.permute(2, 0, 1).contiguous().reshape(grid.grid.shape))
        for name, grid in grids.items()
    }
    (problem,) = check_scene(scene.splats, scene.cameras, features=as_views(transposed)).wrong
    assert "read as [F, h, w]" in problem and "contiguous" in problem
    noise = {name: FeatureGrid(torch.randn(grid.grid.shape)) for name, grid in grids.items()}
    (problem,) = check_scene(scene.splats, scene.cameras, features=as_views(noise)).wrong
    assert "like any two cells" in problem


def test_masks_of_other_photos_are_reported(scene: StillLife, photos) -> None:
    masks, mirrored = {}, {}
    for name, path in photos.items():
        with Image.open(path) as image:
            grey = np.asarray(image.convert("L").resize((120, 90)), np.int32)
        labels = torch.from_numpy(grey // 32)[None]
        masks[name] = Regions(labels, torch.eye(8))
        mirrored[name] = Regions(labels.flip(2), torch.eye(8))
    assert check_scene(scene.splats, scene.cameras, photos, as_views(masks)).wrong == ()
    (problem,) = check_scene(scene.splats, scene.cameras, photos, as_views(mirrored)).wrong
    assert "masks must be of these photos" in problem


def test_photos_without_cameras_are_named(scene: StillLife, photos) -> None:
    subset = {name: photos[name] for name in list(photos)[:2]} | {"stranger": next(iter(photos.values()))}
    report = check_scene(scene.splats, scene.cameras, subset)
    assert report.wrong == () and len(report.views) == 2
    assert "2 cameras have none" in report.notes[0] and "1 have no camera: 'stranger'" in report.notes[1]
    (problem,) = check_scene(scene.splats, scene.cameras, {"stranger": photos["view_00"]}).wrong
    assert "none is named as a camera" in problem


def test_command_says_what_is_wrong_and_exits_2(scene: StillLife, photos, grids, tmp_path: Path, capsys) -> None:
    write_splats(tmp_path / "s.ply", scene.splats)
    write_inria_cameras(scene.cameras, tmp_path / "c.json")
    write_pack(tmp_path / "f.safetensors", grids, {})
    folder = next(iter(photos.values())).parent
    command = ["check", *(str(tmp_path / name) for name in ("s.ply", "c.json")), str(folder)]
    pack, worst = str(tmp_path / "f.safetensors"), tmp_path / "worst.png"
    assert cli.main([*command, pack, "--worst", str(worst), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["healthy"] and document["wrong"] == [] and document["worst"] == str(worst)
    camera = next(iter(scene.cameras.values()))
    with Image.open(worst) as picture:
        assert picture.size == (2 * camera.width, camera.height)
    broken = {
        name: values.permute(2, 0, 1).contiguous().reshape(values.shape) for name, values in load_file(pack).items()
    }
    save_file(broken, tmp_path / "b.safetensors", metadata={"encoder": "x"})
    assert read_features(tmp_path / "b.safetensors").views
    assert cli.main([*command, str(tmp_path / "b.safetensors")]) == 2
    assert "wrong: features: " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("near", "trial_count"), [((0.3, 0.39), 2), ((0.3, 0.41), 5), ((None, 0.3), 5), ((None, None), 5)], ids=str
)
def test_far_scales_are_left_out_where_both_near_ones_agree_less(
    near: tuple[float | None, ...], trial_count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = [*near, 0.1, 0.9, 0.1]  # three times the scale is the right one
    remaining = iter(values)
    monkeypatch.setattr(contradictions, "agreement_of_views", lambda *_, **__: ViewAgreement(1.0, next(remaining)))
    monkeypatch.setattr(contradictions, "_scaled", lambda views, factor: views)
    unused: Any = None
    problems = contradictions.disagreement(unused, unused, unused, 0.4)
    assert len(values) - len(list(remaining)) == trial_count
    assert [text.partition(":")[0] for text in problems] == (["cameras"] if trial_count == 5 else [])


def test_views_that_show_one_region_alone_blame_no_camera(scene: StillLife) -> None:
    """As packs of views in which nothing was annotated: such views distinguish nothing, whatever the cameras are."""
    names = [*scene.cameras]
    single_region = Regions(np.zeros((1, 1, 1), np.int32), np.eye(1, 3, 2, dtype=np.float32))
    two_regions = Regions(np.repeat([[[0, 1]]], 4, axis=1).astype(np.int32), np.eye(2, 3, dtype=np.float32))
    settings = LiftSettings.of()

    def agreement(count: int) -> float | None:
        views = {name: two_regions if number < count else single_region for number, name in enumerate(names)}
        lifted = LiftViews.of(as_views(views), scene.cameras, settings)
        return contradictions.agreement_of_views(CpuRaster(scene.splats), lifted, settings, rays=0).agreement

    assert len(names) == contradictions.MIN_VIEWS
    assert agreement(1) is None and agreement(2) is None and agreement(4) is not None
