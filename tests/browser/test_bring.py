"""What is dropped on the page: files that are planned, compared and lifted, lift files and photos; names of lifts."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from PIL import Image

from liftcore.io.scene_files import lift_files
from liftcore.settings import LiftSettings
from tests.api.tiny_scene import cameras_document, colmap_zip, make_scene

from .browser import Browser
from .conftest import Served, serving
from .looking import AMBER, READY, ask, columns, text_of

pytestmark = pytest.mark.slow
OPEN = "globalThis.splatlift && !document.querySelector('#panel-bring').hidden"
CHART = "document.querySelector('.chart img')?.naturalWidth > 100"


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    scene, found = make_scene(), {}
    for name in ("splats.ply", "cameras.json", "features.safetensors", "table.safetensors"):
        found[name.split(".")[0]] = tmp_path / name
        (tmp_path / name).write_bytes(getattr(scene, name.split(".")[0]))
    return found


@pytest.fixture
def empty(browser: Browser, files: dict[str, Path], tmp_path: Path) -> Iterator[Browser]:
    """The page of a service that has nothing yet."""
    with serving(tmp_path / "data", encoder=f"table:{files['table']}") as (address, _):
        browser.window(1200, 800)
        browser.open(address)
        browser.until(OPEN)
        yield browser
        browser.open("about:blank#")


def test_dropped_files_are_planned_compared_and_cancelled(
    empty: Browser, files: dict[str, Path], keep: Callable[[Browser, str], None]
) -> None:
    empty.drop([files[kind] for kind in ("splats", "cameras", "features")])
    empty.until("!document.querySelector('#plan-it').disabled")
    empty.press("#plan-it")
    empty.until("document.querySelector('#plan').textContent.includes('60 splats')")
    keep(empty, "plan")
    assert empty.value("fetch('jobs').then(reply => reply.json()).then(({jobs}) => jobs.length)") == 0
    empty.value("document.querySelector('#budget').value = '60'")
    empty.press("#compare")
    empty.until("document.querySelectorAll('#jobs .job').length === 1")
    empty.press("#lift-it")  # which waits behind the comparison
    empty.until("document.querySelectorAll('#jobs .job').length === 2")
    empty.press("#jobs .job:first-child .actions button")
    empty.until("document.querySelector('#jobs .job:first-child').dataset.state === 'canceled'")
    for _ in range(5):  # as long as it takes on a busy machine
        try:
            empty.until("document.querySelector('#jobs .job:last-child').dataset.state === 'succeeded'")
            break
        except AssertionError:
            continue
    empty.until("splatlift.bring.followed.size === 0")  # the list is as it stays
    empty.press("#jobs .job:last-child .actions button")
    empty.until(CHART)
    keep(empty, "chart")


def test_lift_file_asks_for_what_it_was_made_of_and_opens(
    empty: Browser, served: Served, files: dict[str, Path], tmp_path: Path
) -> None:
    (tmp_path / "brought.safetensors").write_bytes(
        httpx.get(f"{served.address}/lifts/{served.lift}/features").content
    )
    empty.drop([tmp_path / "brought.safetensors"])
    empty.until("document.querySelector('.file .state')?.textContent.includes('was made of')")
    assert "(splats) and" in text_of(empty, ".file .state") and "(cameras)" in text_of(empty, ".file .state")
    empty.drop([files["splats"], files["cameras"]])
    empty.until(READY)
    ask(empty, "lamp")
    assert min(columns(empty, AMBER)) > 50


def test_dropped_folder_brings_its_cameras(empty: Browser, tmp_path: Path) -> None:
    model = tmp_path / "model"
    with zipfile.ZipFile(io.BytesIO(colmap_zip())) as archive:
        archive.extractall(model)
    (model / "sparse" / "0" / "notes.md").write_text("not a camera")
    (model / "point_cloud.ply").write_bytes(make_scene().splats)
    empty.drop([model])
    empty.until("document.querySelectorAll('.file.done').length === 2")
    names = empty.value("[...document.querySelectorAll('.file.done .name')].map(name => name.textContent)")
    assert sorted(names) == ["model.zip", "point_cloud.ply"] and "3 views" in text_of(empty, "#sent")


def test_lift_file_waits_for_other_cameras_after_wrong_ones(
    empty: Browser, files: dict[str, Path], tmp_path: Path
) -> None:
    model, lift = tmp_path / "model", tmp_path / "made.safetensors"
    with zipfile.ZipFile(io.BytesIO(colmap_zip())) as archive:
        archive.extractall(model)
    lift_files(files["splats"], model, [files["features"]], LiftSettings.of(preset="row-sum")).save(lift)
    wrong = tmp_path / "wrong.json"
    wrong.write_text(json.dumps({**cameras_document(), "fl_x": 31.0}), encoding="utf-8")
    empty.drop([lift, files["splats"], wrong])
    empty.until("document.querySelector('.file.bad .state')?.textContent.includes('cameras that see')")
    empty.drop([model])  # the right ones, which are another asset than the folder that was lifted with
    empty.until(READY)
    ask(empty, "lamp")
    assert min(columns(empty, AMBER)) > 50


def test_lift_takes_a_name_and_photos(browser: Browser, served: Served, tmp_path: Path) -> None:
    browser.window(1200, 800)
    browser.open(served.address)
    browser.until(READY)
    browser.press("#tab-bring")
    browser.until("document.querySelector('#lifts input')")
    browser.write("#lifts input", "Fruit and light")
    browser.key("Enter")
    browser.until("document.querySelector('#lift').selectedOptions[0].text === 'Fruit and light'")
    content = io.BytesIO()
    Image.new("RGB", (32, 24), (200, 40, 200)).save(content, "PNG")
    (tmp_path / "left.png").write_bytes(content.getvalue())
    browser.drop([tmp_path / "left.png"])
    browser.until("document.querySelector('.file .actions button')")
    browser.press(".file .actions button")
    browser.until("splatlift.lift.photos")
    browser.until(READY)
    browser.press("#tools input[value=view] + span")
    browser.press("#tab-look")
    browser.press("#layer-photo")
    browser.until("document.querySelector('#over').naturalWidth === 32")
    browser.press("#view-after")
    browser.until("document.querySelector('#layer-words').textContent === 'There is no photo of this view.'")
