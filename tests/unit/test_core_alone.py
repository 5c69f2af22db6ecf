"""The core works where no extra is installed, and where what Linux alone has is missing."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "core_alone.py"


@pytest.mark.slow
@pytest.mark.parametrize("system", ["darwin", "win32"])
def test_core_reads_lifts_asks_renders_and_exports_without_extras_and_without_linux(system: str) -> None:
    command = [sys.executable, SCRIPT, "--block", "--as", system]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith("read, planned, lifted, saved, asked, rendered and exported on")


def test_service_says_that_it_needs_linux() -> None:
    # shutil imports a module of Windows by the system's name, from Python 3.13 on: it comes before the change.
    program = "import shutil, sys; sys.platform = 'win32'; from liftcore.cli import main; sys.exit(main(['serve']))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert run.returncode == 2
    assert run.stderr.count("\n") == 1
    assert "Linux" in run.stderr
