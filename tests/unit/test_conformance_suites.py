"""The suites of ``liftcore.testing``: what conforms passes them, and what does not fails where it is wrong."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore.raster.base import Raster
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import ReferenceRaster
from liftcore.scene.kernel import Kernel
from liftcore.testing import RasterConformance, TextEncoderConformance
from liftcore.text import check_texts


class TestCpuRaster(RasterConformance):
    def open_raster(self, splats: lc.Splats) -> Raster:
        return CpuRaster(splats, threads=1)


class TestReferenceRaster(RasterConformance):
    kernels = (Kernel.GAUSSIAN_3D,)

    def open_raster(self, splats: lc.Splats) -> Raster:
        return ReferenceRaster(splats)


class TestTable(TextEncoderConformance):
    def open_encoder(self) -> lc.TextEncoder:
        return lc.open_encoder("lvis")


def suite_of(change: Callable[[CpuRaster], None]) -> RasterConformance:
    class Suite(RasterConformance):
        kernels = (Kernel.GAUSSIAN_3D,)

        def open_raster(self, splats: lc.Splats) -> Raster:
            raster = CpuRaster(splats, threads=1)
            change(raster)
            return raster

    return Suite()


def brighter(raster: CpuRaster) -> None:
    """Let renders be a thousandth too bright."""
    render = raster.render
    raster.render = lambda *arguments: render(*arguments) * 1.001  # pyright: ignore


def upside_down(raster: CpuRaster) -> None:
    """Let the adjoint read its image from below."""
    adjoint = raster.adjoint
    raster.adjoint = lambda camera, values, params: adjoint(camera, values.flip(0), params)  # pyright: ignore


def unshifted(raster: CpuRaster) -> None:
    """Let labels be of the rays in another order."""
    labels = raster.strongest_labels
    raster.strongest_labels = lambda *arguments: torch.flip(labels(*arguments), [1])  # pyright: ignore


@pytest.mark.parametrize(
    ("change", "test"),
    [
        (brighter, "test_renders_equal_the_oracle"),
        (upside_down, "test_adjoints_equal_the_oracle"),
        (unshifted, "test_rows_labels_and_footprints_equal_the_oracle"),
    ],
)
def test_a_wrong_raster_fails(change: Callable[[CpuRaster], None], test: str) -> None:
    with pytest.raises(AssertionError):
        getattr(suite_of(change), test)()


class Letters:
    """Vectors of how often letters stand in a text."""

    name, channels = "letters", 26

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        check_texts(texts)
        counts = [[text.count(chr(97 + letter)) for letter in range(26)] for text in texts]
        rows = np.array(counts, np.float32).reshape(-1, 26)
        return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9)


WRONG: dict[str, Callable[[Sequence[str]], np.ndarray]] = {
    "test_vectors_are_unit_rows_of_float32_in_the_order_of_the_texts": lambda texts: 2 * Letters().encode(texts),
    "test_same_text_has_the_same_bits": lambda texts: Letters().encode(texts) + np.random.rand(),
    "test_no_texts_are_no_rows": lambda texts: Letters().encode(texts or ["mug"]),
    "test_what_is_no_list_of_texts_is_refused": lambda texts: np.ones((len(texts or ""), 26), np.float32),
}


@pytest.mark.parametrize("test", WRONG)
def test_a_wrong_text_encoder_fails(test: str) -> None:
    class Suite(TextEncoderConformance):
        def open_encoder(self) -> lc.TextEncoder:
            encoder = Letters()
            encoder.encode = WRONG[test]  # pyright: ignore
            return encoder

    class Right(TextEncoderConformance):
        def open_encoder(self) -> lc.TextEncoder:
            return Letters()

    getattr(Right(), test)()
    with pytest.raises(AssertionError):
        getattr(Suite(), test)()
