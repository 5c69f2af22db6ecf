"""The benchmarks, which are run by hand, can be run: each is imported and says how."""

import importlib
import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted(path.stem for path in (ROOT / "tests" / "benchmarks").glob("*.py") if path.stem != "__init__")


@pytest.mark.parametrize("name", SCRIPTS)
def test_every_benchmark_tells_its_command(name: str, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    module = importlib.import_module(f"tests.benchmarks.{name}")
    if name not in ("base", "extreme_measures"):  # which the others import
        monkeypatch.setattr("sys.argv", [name, "--help"])
        with pytest.raises(SystemExit, match="0"):
            module.main()
        assert f"python -m tests.benchmarks.{name}" in capsys.readouterr().out


@pytest.mark.skipif(shutil.which("nvidia-smi") is not None, reason="there is a card here: make gpu would measure it")
def test_make_gpu_without_a_card_says_so() -> None:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    process = subprocess.run(["make", "gpu"], cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert process.returncode == 2 and process.stdout == ""
    assert process.stderr.splitlines()[0] == "make gpu: nvidia-smi lists no card here, so nothing was run"
