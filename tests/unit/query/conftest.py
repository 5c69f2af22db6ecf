"""A lifted tiny scene: three clusters side by side, 1.2 apart, "apple" on the left."""

from pathlib import Path

import pytest

from liftcore.query.scene import Scene
from tests.promises.tiny_files import write_lift


@pytest.fixture(scope="session")
def tiny_lift(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_lift(tmp_path_factory.mktemp("tiny"))


@pytest.fixture
def scene(tiny_lift: Path) -> Scene:
    """The lifted tiny scene, open for queries."""
    return Scene(tiny_lift)
