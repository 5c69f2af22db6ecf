"""Public: conformance suites for rasters and text encoders; derive from them in a test file of pytest.

from liftcore.testing import RasterConformance

class TestMine(RasterConformance):
    def open_raster(self, splats): return MyRaster(splats)
"""

from liftcore.testing.raster import RasterConformance
from liftcore.testing.text import TextEncoderConformance

__all__ = ["RasterConformance", "TextEncoderConformance"]
