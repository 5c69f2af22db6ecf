"""Choice of a lift's device, errors without one, and the device in the diagnostics."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

import pytest
import torch

from liftcore.errors import InvalidSettings, Unavailable
from liftcore.lifting.files import lift_files
from liftcore.lifting.planning.plan import check_device_memory
from liftcore.runtime.device import CPU, Device, choose_device, processor, within_memory
from liftcore.values.settings import LiftSettings
from tests.scenes import write_scene

CARD = Device("cuda", torch.device("cuda", 0))
GIB = 1 << 30


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Make torch report all that a lift on a GPU needs; tests remove one thing at a time."""
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda *_: "Card")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda *_: (9, 0))
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_: (3 * GIB, 8 * GIB))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda *_: 2 * GIB)
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda *_: GIB)
    return monkeypatch


LACKS = {
    "a build without CUDA": (torch.version, "cuda", None),
    "no C compiler": (shutil, "which", lambda *_: None),
    "is_available() is False": (torch.cuda, "is_available", lambda: False),
    "no package triton": (importlib.util, "find_spec", lambda name: None),
    "compute capability 6.1": (torch.cuda, "get_device_capability", lambda *_: (6, 1)),
}


def test_what_a_card_lacks_is_said_with_a_hint_of_its_own(card: pytest.MonkeyPatch) -> None:
    assert choose_device("auto") == choose_device("cuda") == CARD
    assert choose_device("cpu") == CPU
    hints = set()
    for lack, change in LACKS.items():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(*change)
            assert choose_device("auto") == CPU
            with pytest.raises(Unavailable) as excinfo:
                choose_device("cuda")
            error = excinfo.value
            assert (error.argument, lack in error.got, "device=cpu" in error.hint) == ("device", True, True)
            hints.add(error.hint)
    assert len(hints) == len(LACKS)
    with pytest.raises(InvalidSettings, match="device"):
        LiftSettings.of(device="gpu")


def test_facts_of_a_card_name_it_and_all_versions(card: pytest.MonkeyPatch) -> None:
    facts = CARD.facts()
    assert (facts["kind"], facts["name"]) == ("cuda", "Card")
    assert facts["versions"].keys() == {"torch", "triton", "numpy", "cuda"}
    assert CARD.free_bytes() == 4 * GIB  # with what torch holds and does not use
    interpreter = Device("cuda", torch.device("cpu"))
    assert interpreter.name.startswith("Triton's interpreter") and interpreter.free_bytes() is None


def test_diagnostics_name_the_device_that_lifted(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, 3)
    result = lift_files(scene[0], scene[1], [scene[2]], LiftSettings.of(device="cpu", diagnostic_rays=10))
    device = result.metadata.diagnostics["device"]
    assert (device["kind"], device["name"]) == ("cpu", processor())
    assert device["versions"]["torch"] == torch.__version__ and device["versions"].keys() == {
        "torch",
        "numba",
        "numpy",
    }
    assert result.metadata.diagnostics["plan"]["device"] == "cpu"


def test_room_that_ends_in_the_middle_is_said_in_words(card: pytest.MonkeyPatch) -> None:
    with pytest.raises(Unavailable, match=r"memory for the lift on Card, got 4\.0 GiB free"), within_memory(CARD):
        raise torch.OutOfMemoryError
    with pytest.raises(Unavailable, match=r"memory for the lift on Card, got 4\.0 GiB free"), within_memory(CARD):
        raise RuntimeError("Triton Error [CUDA]: out of memory")
    with pytest.raises(ValueError, match="memory"), within_memory(CARD):  # no device's
        raise ValueError("out of memory")
    with pytest.raises(RuntimeError, match="illegal"), within_memory(CARD):
        raise RuntimeError("Triton Error [CUDA]: an illegal memory access was encountered")


def test_scene_without_room_on_the_card_is_refused_or_left_to_the_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Device, "free_bytes", lambda device: GIB)
    monkeypatch.setattr(Device, "name", "Card")
    assert check_device_memory(CARD, 1_000_000, "cuda") == []
    with pytest.raises(Unavailable, match=r"3\.7 GiB of free memory on Card, got 1\.0 GiB"):
        check_device_memory(CARD, 10_000_000, "cuda")
    assert "the lift runs on the CPU" in check_device_memory(CARD, 10_000_000, "auto")[0]
