"""The core works where no extra is installed, and says what the service needs."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_core_reads_lifts_asks_renders_and_exports_without_extras() -> None:
    command = [sys.executable, Path(__file__).parents[1] / "core_alone.py", "--block"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith("read, planned, lifted, saved, asked, rendered and exported on")


def test_service_says_that_it_needs_linux() -> None:
    # shutil imports a module of Windows by the system's name, from Python 3.13 on: it comes before the change.
    program = "import shutil, sys; sys.platform = 'win32'; from liftcore.cli import main; sys.exit(main(['serve']))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr.count("\n")) == (2, 1) and "Linux" in run.stderr
