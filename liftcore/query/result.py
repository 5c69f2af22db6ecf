"""The result of a lift, which answers questions, is written to a file, and is shown."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from liftcore.errors import InvalidInput
from liftcore.runtime.aliases import deprecated_names
from liftcore.values.lift import Lift
from liftcore.values.lift_file import OLD_TENSORS, has_poses, open_lift, save_lift, tensors_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np

    from liftcore.query.ask import VectorAnswer
    from liftcore.query.catalogue import Catalogue
    from liftcore.query.scene import Scene
    from liftcore.query.segment import Segmentation
    from liftcore.runtime.progress import Progress
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats
    from liftcore.text import TextEncoder
    from liftcore.values.lift import InputFile, LiftMetadata


@deprecated_names(**OLD_TENSORS)
@dataclass(frozen=True, repr=False)
class LiftResult(Lift):
    """X and what supports it, one row a splat, in the splats' order."""

    @classmethod
    def of(cls, lift: Lift) -> Self:
        """The same values, which answer questions too."""
        return cls(**{field.name: getattr(lift, field.name) for field in fields(lift)})

    def scene(
        self, splats: Splats | None = None, cameras: Mapping[str, Camera] | None = None, *, device: str = "cpu"
    ) -> Scene:
        """The lift opened for questions (`liftcore.Scene`): once, while splats, cameras and device are the same.

        Args:
            splats: that were lifted. cameras: of its views. Both may be left out where the lift was made of files
                that are where they were. device: that draws.
        """
        from liftcore.query.scene import Scene

        parts = (splats, cameras, device)
        kept = self.__dict__.get("_scene")  # no field, so that copies with other values do not have it
        if kept is None or any(one is not other for one, other in zip(kept[0], parts, strict=True)):
            if isinstance(splats, str | Path):  # of a scene that may be another: values alone belong to a result
                self.require_splats(splats)
            kept = self.__dict__["_scene"] = parts, Scene(self, splats, cameras, device=device)
        return kept[1]

    def query(
        self,
        positives: Any,
        negatives: Any = (),
        *,
        splats: Splats | None = None,
        references: Any = None,
        encoder: TextEncoder | str | Path | None = None,
        **fields: Any,
    ) -> VectorAnswer:
        """Which splats answer words, or vectors of the lift's text space.

        Args:
            positives: a text or several, or [n, F] or [F], torch or numpy: what is looked for; rows of any length
                above zero.
            negatives: the same, what takes away from the scores.
            splats: that were lifted; with them the answer has objects with boxes.
            references: [n, F], the vectors of 200 words or more, by which presence is known; None = those of the
                lift's text space, where it has some.
            encoder: of texts and of reference words, or the specification of one (`liftcore.open_encoder`), which is
                opened once. None: the lift's own words (`table`), else the encoder of its text space, or the table of
                it that ships, where its weights cannot be had.
            fields: the others of `liftcore.Query`.

        Raises:
            InvalidQuery: a vector of another length, of zeros or not finite; a text that the encoder cannot read, or
                no encoder of the lift's text space; or an unknown threshold.
            Unavailable: the encoder's weights are not on this machine.
        """
        from liftcore.query.ask import query_vectors

        more = {"references": references, "encoder": encoder, "grouped": splats is not None}
        return query_vectors(self.scene(splats), positives, negatives, **more, **fields)

    def segment(
        self,
        words: Sequence[str],
        vectors: Any = None,
        splats: Splats | None = None,
        *,
        encoder: TextEncoder | str | Path | None = None,
    ) -> Segmentation:
        """Name every splat by the word that it is most like, or by none (`liftcore.query.segment`).

        Args:
            words: n different ones. vectors: [n, F], torch or numpy, their text vectors, of any length above zero.
                None: the encoder makes them.
            splats: that were lifted; may be left out where the lift was made of files that are where they were.
            encoder: as in `query`.

        Raises:
            InvalidQuery: no words, one word twice, vectors that are no directions of the lift's space, a word that
                the encoder cannot read, or no encoder of the space.
            Unavailable: the encoder's weights are not on this machine.
        """
        return self.scene(splats).segment(words, vectors, encoder=encoder)

    def objects(
        self,
        splats: Splats | None = None,
        words: Sequence[str] = (),
        vectors: Any = None,
        *,
        encoder: TextEncoder | str | Path | None = None,
    ) -> Catalogue:
        """The objects that masks of many views agree on, found at lift time without a word; the largest first.

        Args:
            splats: that were lifted; may be left out where the lift was made of files that are where they were.
            words: n, that objects are named by. vectors: [n, F], torch or numpy, their text vectors, of any length
                above zero. None: the encoder makes them.
            encoder: as in `query`.

        Raises:
            InvalidQuery: vectors that are no directions of the lift's space, a word that the encoder cannot read, or
                no encoder of the space.
            Unavailable: the encoder's weights are not on this machine.
        """
        return self.scene(splats).catalogue(words, vectors, encoder=encoder)

    def refined(
        self,
        splats: Splats,
        *,
        smoothness: float,
        progress: Progress | bool | None = None,
        threads: int | None = None,
    ) -> LiftResult:
        """The lift with smooth features, as the setting ``smoothness`` makes them, without lifting again.

        Args:
            splats: that were lifted, with their colours where they have any. smoothness: lambda, above zero.
            progress, threads: as `liftcore.lift` has them.

        Raises:
            InvalidSplats: other splats than were lifted.
            InvalidSettings: smoothness is zero or out of range.
            InvalidLift: it was smoothed before, or its splats have the features of clusters.
        """
        from liftcore.query.refine import refine
        from liftcore.runtime.progress import shown_progress

        with shown_progress(progress) as reporter:
            return refine(self, splats, smoothness, reporter, threads)

    def transferred(
        self, old: Splats, new: Splats | Path | str, *, matrix: Any = None, progress: Progress | bool | None = None
    ) -> LiftResult:
        """The lift on other splats of its scene: cropped, reordered, compressed, decimated, moved, trained anew.

        ``diagnostics["transfer"]`` has how many are rows of the old ones, are mixed of several, or found no partner,
        and how the scene was moved (`liftcore.query.transfer`).

        Args:
            old: splats that were lifted. new: Q others, in any order, or their file, which the lift remembers.
            matrix: [4, 4] or [3, 4], the similarity from the old frame to the new one; None: none, or one that is
                found. progress: as `liftcore.lift` has it.

        Raises:
            InvalidSplats: other splats than were lifted, or no place of the new ones in the scene is clear.
            InvalidInput: the matrix is no similarity.
        """
        from liftcore.io.splats import read_splats
        from liftcore.query.transfer import transfer
        from liftcore.runtime.progress import shown_progress
        from liftcore.values.lift_file import input_file

        with shown_progress(progress) as reporter:
            if not isinstance(new, str | Path):
                return transfer(self, old, new, matrix, reporter)
            result = transfer(self, old, read_splats(new), matrix, reporter)
        return replace(result, metadata=result.metadata.model_copy(update={"splats": input_file(Path(new))}))

    def arrays(self) -> dict[str, np.ndarray]:
        """Its tensors as arrays by their names, in the order of its file; those of a file are mapped, not read."""
        return {name: tensor.cpu().numpy() for name, tensor in tensors_of(self).items()}

    def has_cameras(self, path: Path | str) -> bool:
        """Return whether a file or folder has the cameras of the lifted views as they were, whatever others it has.

        Lifts from before poses were kept have none to compare: then it has not.

        Raises:
            InvalidCameras: it does not read.
        """
        return has_poses(Path(path), self.metadata)

    def save(self, path: Path | str, *, progress: Progress | bool | None = False) -> None:
        """Write a lift file (`liftcore.values.lift_file`), whole or not at all.

        Args:
            path: a file; with ``.shards`` at its end, a folder of shards. Either may lie elsewhere (`io.remote`).
            progress: as `liftcore.lift` has it; there is one step.

        Raises:
            InvalidInput: it lies elsewhere and cannot be sent there.
        """
        from liftcore.runtime.progress import one_step, shown_progress

        with shown_progress(progress) as reporter, one_step(reporter, "save"):
            save_lift(self, path)

    def save_scene(
        self, folder: Path, splats: Splats | None = None, cameras: Mapping[str, Camera] | None = None
    ) -> Path:
        """Write ``lift.safetensors`` in a folder, and beside it what the lift has in memory alone; its path.

        Args:
            splats: that were lifted; None: where the lift remembers them. cameras: likewise, of its views; of files
                that are there these count.

        Raises:
            InvalidInput: splats or cameras that it needs are not given, or not those of the lift.
        """
        inputs = {
            "splats": _splats_file(self, splats, folder),
            "cameras": _cameras_file(self.metadata, cameras, folder),
        }
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
        """Show it on the service's page at a port of this machine, until Ctrl-C or a notebook's interrupt.

        Args:
            splats: that were lifted. cameras: of its views. Both may be left out where the lift was made of files
                that are where they were.
            port: 0 picks a free one. browser: whether to open one; the address is printed.

        Raises:
            InvalidInput: splats or cameras that it needs are not given, or not those of the lift.
            Unavailable: no package with the page is installed.
        """
        from liftcore.runtime.plugins import load_plugin

        load_plugin("splatlift.viewers", "page")(self, splats, cameras, port=port, browser=browser)


def load_lift(path: Path | str) -> LiftResult:
    """Open a lift file; the tensors are mapped, not read.

    Raises:
        InvalidLift: the file is missing, is not a safetensors file, or is not a lift with a row a splat.
    """
    return LiftResult.of(open_lift(path))


def _splats_file(lift: Lift, splats: Splats | None, folder: Path) -> InputFile:
    if splats is None:
        return _remembered("splats", lift.metadata)
    from liftcore.io.splats import write_splats
    from liftcore.values.lift_file import input_file

    lift.require_splats(splats)
    write_splats(folder / "splats.ply", splats)
    return input_file(folder / "splats.ply")


def _cameras_file(metadata: LiftMetadata, cameras: Mapping[str, Camera] | None, folder: Path) -> InputFile:
    from liftcore.io.transforms import transforms_of
    from liftcore.values.lift_file import camera_input, found_input

    there = found_input("cameras", metadata.cameras, metadata, None) if metadata.cameras.path else None
    if cameras is None or there is not None:  # a file knows lenses and panoramas, too
        return _remembered("cameras", metadata)
    (folder / "cameras.json").write_text(json.dumps(transforms_of(cameras)), encoding="utf-8")
    return camera_input(folder / "cameras.json")


def _remembered(role: str, metadata: LiftMetadata) -> InputFile:
    from liftcore.values.lift_file import found_input

    remembered: InputFile = getattr(metadata, role)
    found = found_input(role, remembered, metadata, None) if remembered.path else None
    if found is None:
        got = f"nothing, and they are not at {remembered.path}" if remembered.path else "nothing, of a lift in memory"
        raise InvalidInput(role, expected=f"the {role} of the lift", got=got, hint=f"give show({role}=...)")
    return remembered
