"""The core works where no extra is installed, and where the calls that Linux alone has are missing."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "core_alone.py"


@pytest.mark.slow
def test_core_reads_lifts_asks_and_renders_without_extras_and_without_linux():
    command = [sys.executable, SCRIPT, "--block", "--no-linux"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith("read, lifted, saved, asked and rendered on")
