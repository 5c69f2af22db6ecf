"""The render mode that splats were trained with: read from their file, used by the lift, and reported."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore.evaluate.inspect import inspect_file
from liftcore.io.labels import Labels
from liftcore.io.splats import labelled, read_splats, some_rows, write_splats
from liftcore.scene.kernel import Kernel
from liftcore.scene.splats import Splats
from liftcore.values.settings import LiftSettings
from tests.promises.bad_files import sog_with
from tests.scenes import observed, random_camera, random_splats

FILES = Path(__file__).parents[2] / "data" / "splats"
CLASSIC, MIP, DISCS = (Kernel.GAUSSIAN_3D, False), (Kernel.GAUSSIAN_3D, True), (Kernel.GAUSSIAN_2D, False)


def ply_saying(folder: Path, *lines: str, splats: Splats | None = None) -> Path:
    path = folder / "s.ply"
    write_splats(path, splats or random_splats(3))
    comments = "".join(f"{line}\n" for line in lines).encode()
    path.write_bytes(path.read_bytes().replace(b"element vertex", comments + b"element vertex"))
    return path


def compressed_saying(folder: Path, line: str) -> Path:
    content = (FILES / "degree1.compressed.ply").read_bytes()
    (folder / "s.ply").write_bytes(content.replace(b"element chunk", f"{line}\nelement chunk".encode(), 1))
    return folder / "s.ply"


def spz_saying(folder: Path, version: int, flags: int) -> Path:
    content = bytearray((FILES / f"degree3.v{version}.spz").read_bytes())
    if version == 4:
        content[14] = flags
        (folder / "s.spz").write_bytes(content)
        return folder / "s.spz"
    import gzip

    payload = bytearray(gzip.decompress(bytes(content)))
    payload[14] = flags
    (folder / "s.spz").write_bytes(gzip.compress(bytes(payload)))
    return folder / "s.spz"


def sog_saying(folder: Path, model: Any) -> Path:
    (folder / "s.sog").write_bytes(sog_with("degree1.sog", lambda meta: meta.update(model=model)))
    return folder / "s.sog"


def checkpoint_beside(folder: Path, name: str, text: str) -> Path:
    splats = random_splats(3)
    tensors = {"means": splats.means, "quats": splats.quats, "scales": splats.log_scales}
    (folder / "ckpts").mkdir()
    torch.save({"splats": tensors | {"opacities": splats.opacity_logits}}, folder / "ckpts" / "c.pt")
    (folder / name).write_text(text)
    return folder / "ckpts" / "c.pt"


GSPLAT = "absgrad: false\nantialiased: {}\napp_opt: false\nresult_dir: results\nstrategy: !!python/object:gsplat.X\n"
NERFSTUDIO = "!!python/object:T\npipeline: !!python/object:V\n  model: !!python/object:S\n    rasterize_mode: {}\n"
SAYING: dict[str, tuple[Callable[[Path], Path], tuple[Kernel, bool], str | None]] = {
    "nothing": (ply_saying, CLASSIC, None),
    "2dgs of three scales": (lambda f: ply_saying(f, "comment SplatRenderMode: 2dgs"), DISCS, "2dgs"),
    "Postshot's 1": (lambda f: ply_saying(f, "comment antialiased 1"), MIP, "antialiased 1"),
    "the last of two": (
        lambda f: ply_saying(f, "comment antialiased 0", "comment SplatRenderMode: mip"), MIP, "mip"
    ),
    "a comment on it": (lambda f: ply_saying(f, "comment not antialiased 1 at all"), CLASSIC, None),
    "compressed PLY": (lambda f: compressed_saying(f, "comment SplatRenderMode: mip"), MIP, "mip"),
    **{f"SPZ {v}": (lambda f, v=v: spz_saying(f, v, 1), MIP, "flag") for v in (1, 2, 3, 4)},
    "SOG": (lambda f: sog_saying(f, "antialiased"), MIP, "model"),
    "gsplat's configuration": (lambda f: checkpoint_beside(f, "cfg.yml", GSPLAT.format("true")), MIP, "cfg.yml"),
    "gsplat's discs": (lambda f: checkpoint_beside(f, "cfg.yml", "model_type: 2dgs\n"), DISCS, "cfg.yml"),
    "nerfstudio's": (
        lambda f: checkpoint_beside(f, "config.yml", NERFSTUDIO.format("antialiased")), MIP, "config.yml"
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", SAYING)
def test_a_file_is_taken_at_its_word(case: str, tmp_path: Path) -> None:
    make, (kernel, antialiased), source = SAYING[case]
    path = make(tmp_path)
    for colour in (True, False):
        splats = read_splats(path, colour=colour)
        assert (splats.kernel, splats.antialiased) == (kernel, antialiased)
        assert LiftSettings.of().for_splats(splats).compositing.antialiased is antialiased
    report = inspect_file(path)
    assert report["kernel"] == str(kernel)
    if source is None:
        assert report["render_mode"] is None
    else:
        assert report["render_mode"] == (
            "antialiased" if antialiased else "2dgs" if kernel is DISCS[0] else "classic"
        )
        assert source in report["render_mode_source"]


def test_what_a_file_says_is_contradicted_aloud(tmp_path: Path) -> None:
    def warnings_of(path: Path, **kernel: Any) -> str:
        return " | ".join(read_splats(path, **kernel).warnings)

    assert "contradict each other" in warnings_of(
        ply_saying(tmp_path, "comment antialiased 1", "comment SplatRenderMode: 2dgs")
    )
    assert "not known" in warnings_of(ply_saying(tmp_path, "comment SplatRenderMode: wavelets"))
    assert "not known" in warnings_of(sog_saying(tmp_path, ["mip"]))
    beta = ply_saying(tmp_path, "comment SplatRenderMode: 2dgs", splats=random_splats(3, kernel=Kernel.BETA))
    assert read_splats(beta).kernel is Kernel.BETA and "taken for dbs" in warnings_of(beta)
    discs = ply_saying(tmp_path, "comment antialiased 1", splats=random_splats(3, kernel=Kernel.GAUSSIAN_2D))
    assert not read_splats(discs).antialiased and "taken for 2dgs" in warnings_of(discs)
    forced = ply_saying(tmp_path, "comment SplatRenderMode: 2dgs")
    assert read_splats(forced, "3dgs").kernel is Kernel.GAUSSIAN_3D and "taken for 3dgs" in warnings_of(
        forced, kernel="3dgs"
    )


def test_mip_splattings_filter_says_that_opacities_are_compensated(tmp_path: Path) -> None:
    splats = replace(random_splats(3), extras={"filter_3D": torch.full((40,), 0.01)})
    path = ply_saying(tmp_path, splats=splats)
    assert read_splats(path).antialiased
    assert not read_splats(ply_saying(tmp_path, "comment antialiased 0", splats=splats)).antialiased


def test_exports_say_how_their_splats_were_trained(tmp_path: Path) -> None:
    mip = spz_saying(tmp_path, 4, 1)
    mask = np.ones(40, bool)
    for suffix in (".ply", ".spz"):
        (tmp_path / f"copy{suffix}").write_bytes(b"".join(some_rows(mip, mask, suffix)))
        assert read_splats(tmp_path / f"copy{suffix}").antialiased
    (tmp_path / "c.ply").write_bytes(b"".join(labelled(mip, Labels({"score": np.ones(40, np.float32)}, {}))))
    assert read_splats(tmp_path / "c.ply").antialiased
    mip_ply = ply_saying(tmp_path, "comment SplatRenderMode: mip")
    (tmp_path / "c.ply").write_bytes(b"".join(some_rows(mip_ply, mask)))
    assert read_splats(tmp_path / "c.ply").antialiased
    discs = sog_saying(tmp_path, "2dgs")
    (tmp_path / "c.ply").write_bytes(b"".join(some_rows(discs, np.ones(300, bool))))
    assert read_splats(tmp_path / "c.ply").kernel is Kernel.GAUSSIAN_2D


def test_splats_in_memory_are_drawn_and_lifted_in_their_mode() -> None:
    splats, camera, values = random_splats(3), random_camera(0), torch.ones(40)
    mip, params = replace(splats, render_mode="antialiased"), lc.CompositingParams(antialiased=True)
    assert torch.equal(lc.render(mip, camera, values), lc.render(splats, camera, values, params))
    assert not torch.equal(lc.render(mip, camera, values), lc.render(splats, camera, values))
    cameras, views = {"v0": camera}, {"v0": observed(0, 0)}
    lifts = [lc.lift(mip, cameras, views), lc.lift(splats, cameras, views, antialiased=True)]
    assert torch.equal(lifts[0].features, lifts[1].features) and lifts[0].settings.antialiased is True
    against = lc.lift(mip, cameras, views, antialiased=False)
    assert any("antialiased=false is set by hand" in text for text in against.diagnostics["warnings"])
    with pytest.raises(lc.InvalidSettings, match="antialiased"):
        lc.lift(random_splats(3, kernel=Kernel.BETA), cameras, views, antialiased=True)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["motion_0", "trbf_center", "omega_3"], "motion_0, trbf_center, omega_3 are not read: these splats move"),
        (["shape"], "shape are not read: these splats have a footprint"),
        (["f_asg_0", "roughness"], "f_asg_0, roughness are not read: these splats have colours"),
        (["opacity_compensation"], "have opacities"),
        (["mask", "class_id", "instance_id", "confidence", "nx"], ""),
    ],
)
@pytest.mark.parametrize("colour", [True, False])
def test_properties_that_change_what_is_rendered_and_are_not_read_are_named(
    names: list[str], words: str, colour: bool, tmp_path: Path
) -> None:
    path = ply_saying(tmp_path, splats=replace(random_splats(3), extras={name: torch.ones(40) for name in names}))
    warnings = read_splats(path, colour=colour).warnings
    assert bool(warnings) is bool(words) and words in " | ".join(warnings)
