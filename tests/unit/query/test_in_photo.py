"""Pictures of distorted photos lie over the photos, pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.query.in_photo import _read, in_photo
from liftcore.scene.cameras import Camera, behind_lens, drawn_by
from liftcore.scene.distortion import Brown, Distortion, Fisheye, photo_places

BARREL = Brown(k1=-0.25, k2=0.04, p1=0.002, p2=-0.001)
PINCUSHION = Brown(k1=0.2)
PLAIN = Camera.pinhole("v", 60, 44, 48.0, 47.0, 29.0, 23.0, np.eye(4))


def places(of: Camera) -> torch.Tensor:
    """[H, W, 2], the places of a pinhole's own pixels."""
    y, x = torch.meshgrid(torch.arange(of.height) + 0.5, torch.arange(of.width) + 0.5, indexing="ij")
    return torch.stack([x, y], dim=2)


@pytest.mark.parametrize("distortion", [BARREL, PINCUSHION])
def test_numbers_are_interpolated_where_the_photo_shows_them(distortion: Distortion) -> None:
    camera = behind_lens(PLAIN, distortion)
    picture = in_photo(camera, places)  # linear, so interpolation is exact off the very border
    assert picture.shape == (44, 60, 2)
    wanted = torch.stack([torch.from_numpy(axis) for axis in photo_places(camera.lens)], dim=2) if camera.lens else 0
    assert float((picture - wanted)[2:-2, 2:-2].abs().max()) < 1e-4
    assert float((picture - wanted).abs().max()) <= 0.5


def test_labels_are_those_of_the_nearest_pixel() -> None:
    camera = behind_lens(PLAIN, BARREL)

    def columns(of: Camera) -> torch.Tensor:
        return torch.arange(of.width, dtype=torch.int32).expand(of.height, -1)

    picture = in_photo(camera, columns)
    assert picture.dtype == torch.int32
    assert camera.lens is not None
    assert torch.equal(picture, torch.from_numpy(np.floor(photo_places(camera.lens)[0])).to(torch.int32))


def test_a_photo_without_a_lens_is_as_drawn() -> None:
    drawn = torch.rand(44, 60)
    assert in_photo(PLAIN, lambda _: drawn) is drawn


@pytest.mark.parametrize("dtype", [torch.float32, torch.int32])
def test_the_rim_that_no_pinhole_sees_is_empty(dtype: torch.dtype) -> None:
    whole = Camera.pinhole("v", 160, 160, 50.0, 50.0, 80.0, 80.0, np.eye(4))
    camera = behind_lens(whole, Fisheye())
    picture = in_photo(camera, lambda of: torch.ones(of.height, of.width, dtype=dtype))
    assert float(picture[80, 80]) == 1
    assert float(picture[0, 0]) == float(picture[80, 0]) == 0
    assert drawn_by(camera).width < 180


def test_large_pictures_are_carried_in_bands_to_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = behind_lens(PLAIN, BARREL)
    whole = in_photo(camera, places)
    monkeypatch.setattr("liftcore.query.in_photo.BAND_PIXELS", 1)
    assert torch.equal(in_photo(camera, places), whole)


def test_reading_reaches_the_borders_and_no_farther() -> None:
    image = torch.rand(5, 7)
    v, u = torch.meshgrid(torch.arange(5) + 0.5, torch.arange(7) + 0.5, indexing="ij")
    assert torch.equal(_read(image, u, v), image)
    labels = torch.arange(35, dtype=torch.int32).reshape(5, 7)
    assert torch.equal(_read(labels, u, v), labels)
    corner = torch.tensor([[0.0, 6.999]]), torch.tensor([[0.0, 4.999]])
    assert torch.allclose(_read(image, *corner), torch.stack([image[0, 0], image[-1, -1]]))
    assert _read(labels, *corner).tolist() == [[0, 34]]
    beyond = torch.tensor([[-0.001, 7.0, 3.0, 3.0]]), torch.tensor([[2.0, 2.0, -0.001, 5.0]])
    assert not _read(image, *beyond).any() and not _read(labels + 1, *beyond).any()
