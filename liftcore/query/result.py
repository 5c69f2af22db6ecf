"""The result of a lift, which is queried, saved and shown."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

from liftcore.errors import InvalidInput
from liftcore.values.lift import Lift
from liftcore.values.lift_file import has_poses, open_lift, save_lift, tensors_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

    from liftcore.query.question import Answer
    from liftcore.query.scene import Scene
    from liftcore.runtime.progress import Progress
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats
    from liftcore.text import TextEncoder
    from liftcore.values.lift import InputFile


@dataclass(frozen=True, repr=False)
class LiftResult(Lift):
    """X and its supporting values, one row a splat, in the splats' order."""

    @classmethod
    def of(cls, lift: Lift) -> Self:
        """Return a result with the values of a lift, which can be queried."""
        return cls(**{field.name: getattr(lift, field.name) for field in fields(lift)})

    def scene(self, splats: Splats | None = None, cameras: Mapping[str, Camera] | None = None) -> Scene:
        """Open the lift for queries (`liftcore.Scene`); cached while splats and cameras are the same.

        Args:
            splats: that were lifted. cameras: of its views. Both may be left out if the lift was made of files that
                are still in place.
        """
        from liftcore.query.scene import Scene

        parts = (splats, cameras)
        cached = self.__dict__.get("_scene")  # no field, so that copies with other values do not have it
        if cached is None or any(a is not b for a, b in zip(cached[0], parts, strict=True)):
            if isinstance(splats, str | Path):  # a result takes values alone: a file may be of another scene
                self.require_splats(splats)
            cached = self.__dict__["_scene"] = parts, Scene(self, splats, cameras)
        return cached[1]

    def query(
        self,
        positives: Any,
        negatives: Any = (),
        *,
        splats: Splats | None = None,
        encoder: TextEncoder | str | Path | None = None,
        **fields: Any,
    ) -> Answer:
        """Select the splats that answer words, or vectors of the lift's text space, which count as words.

        Args:
            positives: the target: a text or several, or [n, F] or [F], torch or numpy, rows of any length above zero.
            negatives: likewise; they reduce the scores.
            splats: that were lifted; with them the answer has its best splats and the box of its selection.
            encoder: of texts, as in `Scene.ask`. fields: the others of `liftcore.Query`.

        Raises:
            InvalidQuery: a vector of another length, of zeros or not finite; or as `Scene.ask`, like Unavailable.
        """
        from liftcore.query.ask import ask_vectors
        from liftcore.query.question import Query

        scene, words = self.scene(splats), [positives] if isinstance(positives, str) else positives
        if isinstance(words, list | tuple) and words and all(isinstance(word, str) for word in words):
            query = Query(text=list(words), negatives=negatives, **fields)
            return scene.ask(query, encoder=encoder, places=splats is not None)
        answer = ask_vectors(scene, positives, negatives, **fields)
        return answer if splats is None else scene.locate(answer)

    def transferred(self, old: Splats, new: Splats | Path | str, *, matrix: Any = None) -> LiftResult:
        """Transfer the lift to an edited copy of its splats: cropped, reordered, compressed or thinned.

        Each new splat takes the row of the nearest old one (`liftcore.query.transfer`). ``diagnostics["transfer"]``
        has the number of such rows, and of splats that are near none.

        Args:
            old: splats that were lifted. new: Q others, in any order, or their file, whose path the lift stores.
            matrix: [4, 4] or [3, 4], the similarity from the old frame to the new one, if the scene was moved.

        Raises:
            InvalidSplats: other splats than were lifted, or less than half of the new ones are near an old one.
            InvalidInput: the matrix is no similarity.
        """
        from liftcore.io.splats import read_splats
        from liftcore.query.transfer import transfer
        from liftcore.values.lift_file import input_file

        if not isinstance(new, str | Path):
            return transfer(self, old, new, matrix)
        result = transfer(self, old, read_splats(new), matrix)
        return replace(result, metadata=result.metadata.model_copy(update={"splats": input_file(Path(new))}))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return its tensors as arrays by their names, in the order of its file; those of a file are mapped."""
        return {name: tensor.cpu().numpy() for name, tensor in tensors_of(self).items()}

    def has_cameras(self, path: Path | str) -> bool:
        """Return True if a file or folder has the cameras of the lifted views with their poses; it may have others.

        A lift that was transformed stores no poses: then it is False.

        Raises:
            InvalidCameras: the file is invalid.
        """
        return has_poses(Path(path), self.metadata)

    def as_codes(self) -> Self:
        """Return the lift with at most 8,192 `rows`, and the number of its row for each splat, `code`.

        ``diagnostics["codes"]`` has the number of rows, and the loss: 1 - the mean cosine of splats about the scene's
        mean, by the root of total weight. Where it is too large, sooner for maps than for masks, or nothing is saved,
        it has the reason, and features stay exact.
        """
        import torch

        from liftcore.solve.codes import code_features

        if self.code is not None:
            return self
        lift = self.cpu()
        columns = (part.numpy() for part in (lift.rows, lift.has_feature, lift.total_weight))
        codes = code_features(*columns, of_masks=bool(self.diagnostics.get("masks")))
        facts, changes = {"reason": codes}, dict[str, Any]()
        if not isinstance(codes, str):
            facts = {"rows": len(codes.codebook), "loss": codes.loss}
            changes = {"rows": torch.from_numpy(codes.codebook), "code": torch.from_numpy(codes.code)}
            if (rounded := lift.total_weight.half().float()).isfinite().all():  # so that the file takes two bytes
                changes["total_weight"] = rounded
            if lift.confidence is not None:  # and one
                changes["confidence"] = (255 * lift.confidence).round() / 255
        metadata = self.metadata.model_copy(update={"diagnostics": self.diagnostics | {"codes": facts}})
        return replace(lift, **changes, metadata=metadata)

    def save(
        self,
        path: Path | str,
        *,
        features: Literal["exact", "codes"] | None = None,
        progress: Progress | bool | None = False,
    ) -> None:
        """Write a lift file (`liftcore.values.lift_file`), whole or not at all.

        Args:
            path: a file.
            features: ``codes``: two bytes a splat, where that loses little (`as_codes`); ``exact``: a row of features
                a splat; None: as the lift's setting ``codes`` has it, which is that of the last `save`.
            progress: as `liftcore.lift` has it; there is one step.

        Raises:
            InvalidInput: other ``features``.
        """
        from liftcore.runtime.progress import one_step, shown_progress

        if features not in (None, "exact", "codes"):
            raise InvalidInput("features", expected="exact, codes or None", got=repr(features))
        with shown_progress(progress) as reporter, one_step(reporter, "save"):
            as_codes = self.settings.codes if features is None else features == "codes"
            lift = self.as_codes() if as_codes else replace(self, rows=self.features, code=None)
            settings = self.settings.model_copy(update={"codes": as_codes})
            save_lift(replace(lift, metadata=lift.metadata.model_copy(update={"settings": settings})), path)

    def save_scene(
        self, folder: Path, splats: Splats | None = None, cameras: Mapping[str, Camera] | None = None
    ) -> Path:
        """Write ``lift.safetensors`` and files of inputs that are only in memory to a folder; return the lift's path.

        Args:
            splats: that were lifted; None: the lift's file of them. cameras: likewise, of its views; an existing file
                of the lift is preferred.

        Raises:
            InvalidInput: required splats or cameras are missing, or not those of the lift.
        """
        from liftcore.io.splats import write_splats
        from liftcore.io.transforms import transforms_of
        from liftcore.values.lift_file import camera_input, found_input, input_file

        inputs: dict[str, InputFile] = {}
        for role, values in (("splats", splats), ("cameras", cameras)):
            record: InputFile = getattr(self.metadata, role)
            path = found_input(role, record, self.metadata, None) if record.path else None
            if values is None and path is None:
                got = f"nothing, and they are not at {record.path}" if record.path else "nothing, of a lift in memory"
                hint = f"give show({role}=...)"
                raise InvalidInput(role, expected=f"the {role} of the lift", got=got, hint=hint)
            if role == "cameras" and cameras is not None and path is None:  # a file has lenses and panoramas, too
                (folder / "cameras.json").write_text(json.dumps(transforms_of(cameras)), encoding="utf-8")
                inputs[role] = camera_input(folder / "cameras.json")
        if splats is not None:
            self.require_splats(splats)
            write_splats(folder / "splats.ply", splats)
            inputs["splats"] = input_file(folder / "splats.ply")
        path = folder / "lift.safetensors"
        save_lift(replace(self.cpu(), metadata=self.metadata.model_copy(update=inputs)), path)
        return path

    def show(
        self,
        splats: Splats | None = None,
        cameras: Mapping[str, Camera] | None = None,
        *,
        port: int = 0,
        browser: bool = True,
    ) -> None:
        """Show the lift on the service's page at a port of this machine, until Ctrl-C or a notebook's interrupt.

        Args:
            splats: that were lifted. cameras: of its views. Both may be left out if the lift was made of files that
                are still in place.
            port: 0 takes a free one. browser: True to open one; the address is printed.

        Raises:
            InvalidInput: required splats or cameras are missing, or not those of the lift.
            Unavailable: no package with the page is installed.
        """
        from liftcore.runtime.lazy_names import load_command

        load_command("view").show(self, splats, cameras, port=port, browser=browser)


def load_lift(path: Path | str) -> LiftResult:
    """Open a lift file; the tensors are mapped, not read.

    Raises:
        InvalidLift: the file is missing, is not a safetensors file, or is not a lift with a row a splat.
    """
    return LiftResult.of(open_lift(path))
