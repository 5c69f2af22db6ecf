"""A lifted tiny scene: three clusters side by side, 1.2 apart, "apple" on the left."""

from pathlib import Path

import pytest

from liftcore.query.scene import Scene
from liftcore.text import LVIS_TABLE
from liftcore.text.table import TableEncoder
from tests.promises.tiny_files import write_lift

from .made_up import with_parts


@pytest.fixture(scope="session")
def table() -> TableEncoder:
    """The words that ship."""
    return TableEncoder.open(LVIS_TABLE)


@pytest.fixture(scope="session")
def tiny_lift(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_lift(tmp_path_factory.mktemp("tiny"))


@pytest.fixture
def scene(tiny_lift: Path) -> Scene:
    """The lifted tiny scene, open for queries."""
    return Scene(tiny_lift)


@pytest.fixture
def nested(scene: Scene, tmp_path: Path) -> Scene:
    """The scene with its first object in two parts, nodes 3 and 4."""
    with_parts(scene).save(tmp_path / "parts.lift.safetensors")
    return Scene(tmp_path / "parts.lift.safetensors", scene.splats, scene.cameras)
