"""/lift and /jobs: work and how far it is."""

from __future__ import annotations

from fastapi import APIRouter, Response

from liftcore.errors import InvalidSettings
from liftcore.solve.settings import LiftSettings
from service import wire
from service.faults import error_of
from service.jobs.fit import check_fit
from service.parts import Here
from service.problems import problem_of
from service.store.jobs import JobRecord

router = APIRouter(tags=["jobs"])


@router.post("/lift", response_model=wire.Job, status_code=202)
def submit(order: wire.LiftRequest, response: Response, here: Here) -> wire.Job:
    """Lift features onto splats. The job is on the disk before this answers."""
    settings = parse_settings(order.settings)
    cameras = here.store.assets.get(order.cameras, wire.AssetKind.CAMERAS)
    packs = [here.store.assets.get(pack, wire.AssetKind.FEATURES) for pack in order.features]
    here.store.assets.get(order.splats, wire.AssetKind.SPLATS)
    check_fit(cameras, packs)
    job = here.store.jobs.submit(order.splats, order.cameras, order.features, settings.model_dump(mode="json"))
    here.runner.wake()
    response.headers["Location"] = f"/jobs/{job}"
    return shape(here.store.jobs.get(job))


@router.get("/jobs", response_model=wire.Jobs)
def list_jobs(here: Here) -> wire.Jobs:
    """All jobs, newest first."""
    return wire.Jobs(jobs=[shape(job) for job in here.store.jobs.all()])


@router.get("/jobs/{job}", response_model=wire.Job)
def get_job(job: str, here: Here) -> wire.Job:
    """One job: its state, its progress, and what came of it."""
    return shape(here.store.jobs.get(job))


def parse_settings(given: dict[str, wire.Scalar]) -> LiftSettings:
    """The settings of a lift.

    Raises:
        InvalidSettings: an unknown name or a value out of range.
    """
    known = LiftSettings.model_fields
    for name in given:
        if name not in known:
            raise InvalidSettings(name[:80], expected=f"one of {', '.join(known)}", got="an unknown setting")
    return LiftSettings.of(**given)


def shape(job: JobRecord) -> wire.Job:
    """A job as the wire has it."""
    links = {"self": f"/jobs/{job.id}"}
    if job.state is wire.JobState.SUCCEEDED:
        links |= {"lift": f"/lifts/{job.id}", "features": f"/lifts/{job.id}/features"}
    return wire.Job(
        id=job.id,
        state=job.state,
        attempt=job.attempt,
        splats=job.splats,
        cameras=job.cameras,
        features=list(job.features),
        settings=job.settings,
        progress=None if job.progress is None else wire.Progress.model_validate(job.progress),
        problem=None if job.problem is None else problem_of(error_of(job.problem)),
        created=job.created,
        started=job.started,
        ended=job.ended,
        links=links,
    )
