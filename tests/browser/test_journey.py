"""The whole way, as a stranger goes it: files are dropped, a lift runs, a phrase lights up the object in 3D."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.still_life.files import write_still_life
from tests.still_life.scene import still_life

from .browser import Browser, chromium
from .conftest import NO_BROWSER, browsing, serving
from .looking import AMBER, READY, ask, columns, text_of

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if chromium() is None:
        pytest.skip(NO_BROWSER)
    folder = tmp_path_factory.mktemp("still-life")
    write_still_life(folder, still_life(views=9, density=0.3))
    return folder


def test_files_become_an_object_that_lights_up(
    scene: Path, tmp_path: Path, keep: Callable[[Browser, str], None]
) -> None:
    words = f"table:{scene}/text_table.safetensors"
    with serving(tmp_path / "data", encoder=words) as (address, _), browsing(tmp_path / "profile") as page:
        page.window(1280, 800)
        page.open(address)
        page.until("globalThis.splatlift && !document.querySelector('#empty').hidden")
        keep(page, "empty")
        (tmp_path / "broken.ply").write_bytes((scene / "point_cloud.ply").read_bytes()[:-40])
        page.give("#files", [tmp_path / "broken.ply", scene / "cameras.json"])
        page.until("document.querySelector('.file.bad')")
        assert "broken.ply" in text_of(page, ".file.bad .name")
        assert "expected" in text_of(page, ".file.bad .state") and "got" in text_of(page, ".file.bad .state")
        assert page.value("document.querySelector('#lift-it').disabled") is True
        page.press(".file.bad .away")
        page.drop([scene / "point_cloud.ply", scene / "features.safetensors"])
        page.until("!document.querySelector('#lift-it').disabled")
        assert "views" in text_of(page, "#sent")
        keep(page, "bring")
        page.press("#lift-it")
        page.until("document.querySelector('#jobs .job')")
        for _ in range(20):  # as long as it takes on a busy machine, kernels and all
            with_it = "globalThis.splatlift.lift || document.querySelector('#jobs .failed')"
            try:
                page.until(with_it)
                break
            except AssertionError:
                continue
        assert page.value("document.querySelector('#jobs .failed')") is None
        page.until(READY)
        ask(page, "mug")
        lit = columns(page, AMBER)
        keep(page, "found")
        assert len(lit) > 2000 and page.value("splatlift.ask.now.things.length") >= 1
        low, high = page.value("(({low, high}) => [low, high])(splatlift.ask.now.things[0].box)")
        assert low[0] < -2.7 < high[0] and low[1] < -1.5 < high[1]  # where the mug stands
        page.press("#tab-bring")
        page.until("document.querySelector('#jobs .succeeded')")
        page.value("splatlift.bring.refresh()")
        page.press("#jobs button.danger")  # and away with it
        page.press("#jobs button.danger")
        page.until("!document.querySelector('#empty').hidden")
