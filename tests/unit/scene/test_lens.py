"""A distorted photo has a pinhole that it shows whole, and one that shows all of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from liftcore.errors import InvalidCameras
from liftcore.scene.cameras import Camera
from liftcore.scene.distortion import Brown, Distortion, Fisheye
from liftcore.scene.lens import Lens, behind_lens, drawn_by, photo_places, photo_size, pixel_of

BARREL = Brown(k1=-0.2, k2=0.03, p1=0.001, p2=-0.002)
PINCUSHION = Brown(k1=0.15)
WIDE = Fisheye(k1=0.01, k2=-0.003)
LENSES = {"barrel": BARREL, "pincushion": PINCUSHION, "fisheye": WIDE}


def camera(distortion: Distortion, width: int = 64, height: int = 48, focal: float = 50.0) -> Camera:
    plain = Camera("v", width, height, focal, 1.02 * focal, 0.49 * width, 0.52 * height, np.eye(4))
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
        replace(view, width=view.width + 1, cx=view.cx + 1),
        replace(view, width=view.width + 1),
        replace(view, height=view.height + 1, cy=view.cy + 1),
        replace(view, height=view.height + 1),
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
    assert pixel_of(view, 10, 20) == (math.floor(u[20, 10]), math.floor(v[20, 10]))


def test_a_camera_without_a_lens_is_its_own_pinhole() -> None:
    plain = Camera("v", 64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4))
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
        (Brown(k1=-1.5), "turns back within the photo"),
        (Brown(k1=math.nan), "turns back"),
        (Brown(k1=1e200, k2=1e200), "turns back|nothing of the photo"),
        (Fisheye(k1=-0.9), "turns back"),
        (Fisheye(k1=math.inf), "turns back"),
        (Brown(p1=5.0, p2=5.0), "turns back|nothing of the photo"),
    ],
)
def test_what_no_lens_does_is_refused(distortion: Distortion, message: str) -> None:
    with pytest.raises(InvalidCameras, match=f"camera 'v' distortion: .*({message}).*calibrate"):
        camera(distortion)
