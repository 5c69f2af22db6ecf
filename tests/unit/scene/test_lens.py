"""A distorted photo has a pinhole that it shows whole, and one that shows all of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from liftcore.errors import InvalidCameras
from liftcore.scene.cameras import Camera, behind_lens, distortion_warning, drawn_by, photo_size, pixel_of
from liftcore.scene.distortion import Brown, Distortion, Fisheye, Lens, photo_places

BARREL = Brown(k1=-0.2, k2=0.03, p1=0.001, p2=-0.002)
PINCUSHION = Brown(k1=0.15)
WIDE = Fisheye(k1=0.01, k2=-0.003)
LENSES = {"barrel": BARREL, "pincushion": PINCUSHION, "fisheye": WIDE}


def camera(distortion: Distortion, width: int = 64, height: int = 48, focal: float = 50.0) -> Camera:
    plain = Camera.pinhole("v", width, height, focal, 1.02 * focal, 0.49 * width, 0.52 * height, np.eye(4))
    return behind_lens(plain, distortion)


def corners(view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The plane places of all corners of a pinhole's pixels."""
    x, y = np.meshgrid(np.arange(view.width + 1), np.arange(view.height + 1))
    return (x - view.cx) / view.fx, (y - view.cy) / view.fy


def lens_of(view: Camera) -> Lens:
    assert view.lens is not None
    return view.lens


@pytest.mark.parametrize("name", LENSES)
def test_the_pinhole_of_a_photo_is_the_largest_that_it_shows_whole(name: str) -> None:
    view = camera(LENSES[name])
    lens = lens_of(view)
    assert photo_size(view) == (64, 48)
    assert (view.fx, view.fy) == (lens.fx, lens.fy)

    def outside(of: Camera) -> float:
        """By how many pixels of the photo the farthest corner lies beside it."""
        u, v = lens.on_photo(*corners(of))
        return float(max(-u.min(), u.max() - lens.width, -v.min(), v.max() - lens.height))

    assert outside(view) < 1e-9
    wider = [
        view.replace(width=view.width + 1, cx=view.cx + 1),
        view.replace(width=view.width + 1),
        view.replace(height=view.height + 1, cy=view.cy + 1),
        view.replace(height=view.height + 1),
    ]
    assert all(outside(other) > 0 for other in wider)


@pytest.mark.parametrize("name", ["barrel", "pincushion"])
def test_every_pixel_of_a_perspective_photo_is_drawn(name: str) -> None:
    view = camera(LENSES[name])
    lens, drawn = lens_of(view), drawn_by(view)
    u, v = photo_places(lens)
    assert u.shape == v.shape == (48, 64)
    assert u.min() >= 0 and u.max() < drawn.width and v.min() >= 0 and v.max() < drawn.height
    back = lens.on_photo((u - drawn.cx) / drawn.fx, (v - drawn.cy) / drawn.fy)
    assert np.abs(back[0] - (np.arange(64) + 0.5)).max() < 1e-4
    assert np.abs(back[1] - (np.arange(48)[:, None] + 0.5)).max() < 1e-4
    for x, y in ((0, 0), (10, 20), (63, 47)):
        assert pixel_of(view, x, y) == (math.floor(u[y, x]), math.floor(v[y, x]))


def test_a_camera_without_a_lens_is_its_own_pinhole() -> None:
    plain = Camera.pinhole("v", 64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4))
    assert drawn_by(plain) is plain
    assert photo_size(plain) == (64, 48)
    assert pixel_of(plain, 3, 4) == (3, 4)


def test_the_pinhole_of_a_whole_hemisphere_ends_at_sixty_degrees() -> None:
    view = camera(Fisheye(), width=160, height=160, focal=50.0)  # 92 degrees to each side
    drawn = drawn_by(view)
    for pinhole in (view, drawn):
        x, y = corners(pinhole)
        assert max(x.max(), -x.min(), y.max(), -y.min()) < math.tan(math.radians(60)) + 2 / 50
        assert pinhole.width > 2 * 50 * math.tan(math.radians(60)) - 4
    assert pixel_of(view, 78, 83) is not None
    assert pixel_of(view, 0, 83) is None  # 92 degrees off the axis


@pytest.mark.parametrize(
    ("distortion", "message"),
    [
        (Brown(k1=-9.0), r"a pinhole sees \d\.\d% of the photo"),
        (Brown(k1=math.nan), "nothing of the photo"),
        (Brown(k1=1e200, k2=1e200), "turns back|nothing of the photo"),
        (Brown(k4=-2.0), "turns back within the photo"),
        (Fisheye(k1=-5.0), r"a pinhole sees \d\.\d% of the photo"),
        (Fisheye(k1=math.inf), "nothing of the photo"),
        (Brown(p1=5.0, p2=5.0), "nothing of the photo"),
    ],
)
def test_what_no_lens_does_is_refused(distortion: Distortion, message: str) -> None:
    with pytest.raises(InvalidCameras, match=f"camera 'v' distortion: .*({message}).*calibrate"):
        camera(distortion)


@pytest.mark.parametrize(
    ("distortion", "width", "height", "focal"),
    [
        (Brown(k1=-0.2), 1920, 1080, 1150.0),  # COLMAP's own for wide lenses: its corners have no rays
        (Brown(k1=-0.3), 1920, 1080, 1000.0),  # nor have the left and right sides
        (Fisheye(-1 / 24, 1 / 1920), 1000, 1000, 330.0),  # a circle in a square
    ],
)
def test_a_photo_whose_corners_show_no_ray_is_lifted_as_far_as_it_shows_some(
    distortion: Distortion, width: int, height: int, focal: float
) -> None:
    view = behind_lens(Camera.pinhole("v", width, height, focal, focal, width / 2, height / 2, np.eye(4)), distortion)
    lens = view.lens
    assert lens is not None and lens.share > 0.3
    u, v = np.meshgrid(np.linspace(0, view.width, 65), np.linspace(0, view.height, 65))
    x, y = (u - view.cx) / view.fx, (v - view.cy) / view.fy
    on_photo = lens.on_photo(x, y)
    for at, length in zip(on_photo, (width, height), strict=True):
        assert at.min() > -1e-3 and at.max() < length + 1e-3
    back = lens.on_plane(*on_photo)  # no other ray is at the same place
    inside = np.hypot(x, y) < 0.999 * np.hypot(x, y).max()
    assert np.abs(back[0] - x)[inside].max() < 1e-6 and np.abs(back[1] - y)[inside].max() < 1e-6
    drawn = drawn_by(view)
    assert drawn.width >= view.width and drawn.height >= view.height


def test_share_of_a_photo_that_is_lifted_is_what_its_pinhole_sees() -> None:
    view = camera(BARREL)
    assert view.lens is not None
    v, u = np.meshgrid(np.arange(view.lens.height) + 0.5, np.arange(view.lens.width) + 0.5, indexing="ij")
    x, y = view.lens.on_plane(u, v)
    x, y = x * view.fx + view.cx, y * view.fy + view.cy
    seen = (x >= 0) & (x <= view.width) & (y >= 0) & (y <= view.height)
    assert view.lens.share == pytest.approx(seen.mean(), abs=0.01)


def test_warning_tells_the_least_share_and_knows_no_hundred_percent_or_more() -> None:
    barrel, slight, plain = (
        camera(Brown(k1=-0.25)),
        camera(Brown(k1=1e-12)),
        replace(camera(Brown(k1=0.0)), lens=None),
    )
    (told,) = distortion_warning([slight, barrel, plain])
    assert (
        f"2 of 3 views are of distorted photos, of each of which {lens_of(barrel).share:.0%} or more is lifted"
        in told
    )
    (told,) = distortion_warning([slight])
    assert "of each of which nearly all is lifted: features" in told
    assert distortion_warning([plain]) == []
