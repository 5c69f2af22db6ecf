"""A lifted tiny scene: three clusters side by side, 1.2 apart, "apple" on the left."""

from collections.abc import Callable
from pathlib import Path

import pytest

from liftcore.lifting.files import lift_files
from liftcore.query.scene import Scene
from liftcore.values.lift_file import save_lift
from liftcore.values.settings import LiftSettings
from tests.tiny_scene import make_scene


@pytest.fixture(scope="session")
def lift_tiny() -> Callable[..., Path]:
    """Function that lifts the tiny scene in a folder and returns the lift's file."""

    def lift_in(folder: Path, preset: str = "row-sum", splats: bytes = b"") -> Path:
        tiny = make_scene()
        for name, content in (("s.ply", splats or tiny.splats), ("c.json", tiny.cameras), ("f.st", tiny.features)):
            (folder / name).write_bytes(content)
        lift = lift_files(folder / "s.ply", folder / "c.json", [folder / "f.st"], LiftSettings.of(preset=preset))
        save_lift(lift, folder / "scene.lift")
        return folder / "scene.lift"

    return lift_in


@pytest.fixture(scope="session")
def tiny_lift(lift_tiny: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return lift_tiny(tmp_path_factory.mktemp("tiny"))


@pytest.fixture
def scene(tiny_lift: Path) -> Scene:
    """The lifted tiny scene, open for queries."""
    return Scene(tiny_lift)
