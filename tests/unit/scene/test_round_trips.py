"""Every export of every kernel, read back: equal to 1e-6, or to half a step where the format has steps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from liftcore.io.quantised import gaussian_rows
from liftcore.io.splats import blocks_as, labelled, read_splats, write_splats
from liftcore.scene.harmonics import SH_C0
from liftcore.scene.kernel import Kernel
from liftcore.scene.quaternions import rotation_matrices
from liftcore.scene.splats import Splats
from tests.unit.scene.test_gltf import P, labels, some_splats

BYTE = 0.5 / 255
EXACT = {"means": 1e-6, "log_scales": 1e-6, "opacities": 1e-6, "turns": 1e-6, "base": 1e-6, "sh": 1e-6}
SPZ_COLOUR = BYTE / 0.15  # of its bytes: (colour - 0.5) / SH_C0 times 0.15
STEPS = {  # the largest difference; of means as a share of the largest
    ".glb": EXACT,
    ".spz": {
        "means": 2**-23,
        "log_scales": 1 / 32,
        "opacities": BYTE,
        "turns": 4e-3,
        "base": SPZ_COLOUR,
        "sh": 1 / 16,
    },
    ".splat": {"means": 0, "log_scales": 1e-6, "opacities": BYTE, "turns": 0.02, "base": BYTE / SH_C0},
}


def scene(kernel: Kernel) -> Splats:
    """Return splats whose colours are whole numbers of bytes."""
    splats = some_splats(kernel)
    assert splats.sh is not None
    sh = splats.sh.clamp(-3, 3) / 3
    sh[:, 1:] *= 0.9
    return replace(splats, sh=sh, opacity_logits=splats.opacity_logits.clamp(-4, 4))


def parts(splats: Splats) -> dict[str, np.ndarray]:
    """Return what a viewer draws, any kernel as Gaussians: logarithms of scales, quaternions as rotation matrices."""
    (rows,) = gaussian_rows(splats)
    assert splats.sh is not None
    sh = splats.sh.numpy()
    arrays = {"means": splats.positions(), "log_scales": np.log(rows.scales), "opacities": rows.opacities}
    return arrays | {"turns": rotation_matrices(rows.quats), "base": sh[:, 0], "sh": sh[:, 1:]}


@pytest.mark.parametrize("kernel", Kernel)
@pytest.mark.parametrize("suffix", STEPS)
def test_every_kernel_comes_back_through_every_format(kernel: Kernel, suffix: str, tmp_path: Path) -> None:
    expected, label_table, path = scene(kernel), labels(), tmp_path / f"s{suffix}"
    write_splats(tmp_path / "s.ply", expected)
    if suffix in (".splat", ".spz"):
        path.write_bytes(b"".join(blocks_as(expected, suffix)))
    else:
        path.write_bytes(b"".join(labelled(tmp_path / "s.ply", label_table, suffix)))
        columns = read_splats(path).extras
        assert columns.keys() == label_table.columns.keys()
        for name, values in label_table.columns.items():
            np.testing.assert_array_equal(columns[name], values)
    actual_parts, expected_parts = parts(read_splats(path)), parts(expected)
    for name, step in STEPS[suffix].items():
        size = np.abs(expected_parts[name]).max() if name == "means" or suffix == ".glb" else 1.0
        tolerance = step * max(1.0, size) * 1.001 + 1e-6
        np.testing.assert_allclose(actual_parts[name], expected_parts[name], rtol=0, atol=tolerance, err_msg=name)
    assert suffix != ".splat" or actual_parts["sh"].shape == (P, 0, 3)
