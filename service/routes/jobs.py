"""/lift and /jobs: work and how far it is. /tradeoff is beside its results, in `service.routes.tradeoffs`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import anyio
from fastapi import APIRouter, Header, Query, Response
from fastapi.responses import JSONResponse

from liftcore.settings import LiftSettings
from service import request_id, wire
from service.faults import error_of
from service.jobs.fit import check_fit, check_kernel, check_labels, scratch_bytes
from service.parts import Here, Parts
from service.problems import problem_of
from service.store.events import Event, EventKind
from service.store.jobs import JobOrder, JobRecord, fingerprint, labels_of

router = APIRouter(tags=["jobs"])

Key = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key", min_length=1, max_length=255, pattern=r"^[\x20-\x7e]+$",
        description="chosen by the client; the same order with the same key is the same job",
    ),
]  # fmt: skip
LastEvent = Annotated[
    int, Header(alias="Last-Event-ID", ge=0, le=2**53, description="the last event that the client has")
]
RESULT_LINKS: dict[wire.JobKind, Callable[[str], dict[str, str]]] = {
    wire.JobKind.LIFT: lambda job: {"lift": f"/lifts/{job}", "features": f"/lifts/{job}/features"},
    wire.JobKind.TRADEOFF: lambda job: {"tradeoff": f"/tradeoffs/{job}", "chart": f"/tradeoffs/{job}/chart"},
}
EVENT = {
    "type": "object",
    "description": "one event",
    "required": ["id", "event", "data"],
    "properties": {
        "id": {"type": "string", "pattern": "^[0-9]+$"},
        "event": {"enum": [kind.value for kind in EventKind]},
        "data": {"type": "string", "contentMediaType": "application/json"},
    },
}
EVENTS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Server-sent events; the data are a JobStep, a Plan, a Progress or a LogLine as JSON",
        "content": {"text/event-stream": {"schema": EVENT}},
    },
    204: {"description": "The job has ended, and the client has its last event"},
}


REPEATED: dict[int | str, dict[str, Any]] = {
    200: {"model": wire.Job, "description": "The job that the same key made before"}
}


@router.post("/lift", response_model=wire.Job, status_code=202, responses=REPEATED)
def submit(order: wire.LiftRequest, here: Here, key: Key = None) -> Response:
    """Lift features onto splats. The job is on the disk before this answers."""
    settings = LiftSettings.of_json(order.settings)
    wanted = JobOrder(
        splats=order.splats,
        cameras=order.cameras,
        features=tuple(order.features),
        settings=settings.model_dump(mode="json"),
        key=key,
        fingerprint=None if key is None else fingerprint(order.model_dump(mode="json")),
        request_id=request_id.current(),
    )
    return take(wanted, here)


@router.get("/jobs", response_model=wire.Jobs)
def list_jobs(here: Here) -> wire.Jobs:
    """All jobs, newest first."""
    return wire.Jobs(jobs=[shape(job) for job in here.store.jobs.all()])


@router.get("/jobs/{job}", response_model=wire.Job)
def get_job(job: str, here: Here) -> wire.Job:
    """One job: its state, its progress, and what came of it."""
    return shape(here.store.jobs.get(job))


@router.get("/jobs/{job}/events", response_class=Response, responses=EVENTS)
async def follow_job(job: str, here: Here, last_event: LastEvent = 0) -> Response:
    """What happens to a job, as it happens: its states, plan, latest progress and log. Ends after the last state."""
    look = partial(here.store.events.after, job)
    state = await anyio.to_thread.run_sync(here.store.attempts.state, job)
    if not await anyio.to_thread.run_sync(look, last_event) and state in wire.ENDED:
        return Response(status_code=204)
    return here.streams.answer(look, event_data, last_event)


@router.post(
    "/jobs/{job}/cancel",
    response_model=wire.Job,
    status_code=202,
    responses={200: {"model": wire.Job, "description": "It is canceled, and nothing of it runs any more"}},
)
def cancel_job(job: str, here: Here) -> Response:
    """End a job. It is ``canceling`` until its processes are gone, then ``canceled``; asking twice does no harm."""
    here.store.attempts.cancel(job)
    found = here.store.jobs.get(job)
    status = 200 if found.state is wire.JobState.CANCELED else 202
    return JSONResponse(shape(found).model_dump(mode="json"), status, headers={"Location": f"/jobs/{job}"})


@router.delete("/jobs/{job}", status_code=204)
def delete_job(
    job: str,
    here: Here,
    with_lift: Annotated[bool, Query(description="its lift goes too; without this a job with a lift stays")] = False,
    with_tradeoff: Annotated[bool, Query(description="its trade-off goes too, likewise")] = False,
) -> None:
    """Forget a job that has ended."""
    said = {wire.JobKind.LIFT: with_lift, wire.JobKind.TRADEOFF: with_tradeoff}
    here.store.jobs.delete(job, given_up=[kind for kind, gone in said.items() if gone])


def take(order: JobOrder, here: Parts) -> Response:
    """The answer to an order: the job that it makes, or made before."""
    job, new = here.store.jobs.repeated(order), False
    if job is None:
        require_fit(order, here)
        here.devices.require(order.settings.get("device", "auto"))
        job, new = here.store.jobs.submit(order, max_queued=here.settings.max_queued)
        here.runner.wake()
    shaped = shape(here.store.jobs.get(job)).model_dump(mode="json")
    return JSONResponse(shaped, 202 if new else 200, headers={"Location": f"/jobs/{job}"})


def require_fit(order: JobOrder, here: Parts) -> None:
    """Refuse an order that cannot be lifted, or that there is no room for."""
    cameras = here.store.assets.get(order.cameras, wire.AssetKind.CAMERAS)
    packs = [here.store.assets.get(pack, wire.AssetKind.FEATURES) for pack in order.features]
    splats = here.store.assets.get(order.splats, wire.AssetKind.SPLATS)
    check_kernel(splats, order.settings)
    check_fit(cameras, packs)
    judges = [here.store.assets.get(*named) for named in labels_of(order.parameters)]
    if judges:
        check_labels(order, cameras, packs, *judges)
    here.store.files.require_room(scratch_bytes(order.kind, splats, packs))


def event_data(event: Event) -> str:
    """An event's data as the wire has it."""
    if event.kind is EventKind.PROGRESS:
        return wire.Progress.model_validate(event.data).model_dump_json()
    if event.kind is EventKind.PLAN:
        return wire.Plan.model_validate(event.data).model_dump_json()
    if event.kind is EventKind.LOG:
        return wire.LogLine.model_validate(event.data).model_dump_json()
    problem = event.data["problem"]
    told = None if problem is None else problem_of(error_of(problem))
    return wire.JobStep(state=event.data["state"], attempt=event.data["attempt"], problem=told).model_dump_json()


def shape(job: JobRecord) -> wire.Job:
    """A job as the wire has it."""
    links = {"self": f"/jobs/{job.id}", "events": f"/jobs/{job.id}/events"}
    if job.state not in wire.ENDED:
        links["cancel"] = f"/jobs/{job.id}/cancel"
    if job.state is wire.JobState.SUCCEEDED:
        links |= RESULT_LINKS[job.kind](job.id)
    return wire.Job(
        id=job.id,
        kind=job.kind,
        state=job.state,
        attempt=job.attempt,
        splats=job.splats,
        cameras=job.cameras,
        features=list(job.features),
        settings=job.settings,
        parameters=job.parameters,
        plan=None if job.plan is None else wire.Plan.model_validate(job.plan),
        progress=None if job.progress is None else wire.Progress.model_validate(job.progress),
        problem=None if job.problem is None else problem_of(error_of(job.problem)),
        created=job.created,
        started=job.started,
        ended=job.ended,
        request_id=job.request_id,
        links=links,
    )
