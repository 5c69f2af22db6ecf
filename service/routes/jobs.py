"""/lift and /jobs: work and how far it is. /tradeoff is beside its results, in `service.routes.tradeoffs`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import anyio
from fastapi import APIRouter, Header, Query, Response
from fastapi.responses import JSONResponse

from liftcore.settings import LiftSettings
from service import models
from service.child import error_of
from service.content import Cursor, Limit, listed
from service.jobs.fit import check_fit, check_kernel, check_labels, scratch_bytes
from service.observe import current_id
from service.problems import problem_of
from service.requests import described_body, json_body
from service.state import AppState, Deps
from service.store.jobs import Event, EventKind, JobOrder, JobRecord, fingerprint, labels_of

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
RESULT_LINKS: dict[models.JobKind, Callable[[str], dict[str, str]]] = {
    models.JobKind.LIFT: lambda job: {"lift": f"/lifts/{job}", "features": f"/lifts/{job}/features"},
    models.JobKind.TRADEOFF: lambda job: {"tradeoff": f"/tradeoffs/{job}", "chart": f"/tradeoffs/{job}/chart"},
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
    200: {"model": models.Job, "description": "The job that the same key made before"}
}


LIFT_BODY = json_body(models.LiftRequest)


@router.post(
    "/lift", response_model=models.Job, status_code=202, responses=REPEATED,
    openapi_extra=described_body(models.LiftRequest),
)  # fmt: skip
async def submit(deps: Deps, order: models.LiftRequest = LIFT_BODY, key: Key = None) -> Response:
    """Lift features onto splats. The job is on the disk before this answers."""
    return await anyio.to_thread.run_sync(_submit, order, deps, key, limiter=deps.ordering)


def _submit(order: models.LiftRequest, deps: AppState, key: str | None) -> Response:
    settings = LiftSettings.of_json(order.settings)
    wanted = JobOrder(
        splats=order.splats,
        cameras=order.cameras,
        features=tuple(order.features),
        settings=settings.model_dump(mode="json"),
        key=key,
        fingerprint=None if key is None else fingerprint(order.model_dump(mode="json")),
        request_id=current_id(),
    )
    return take(wanted, deps)


@router.get("/jobs", response_model=models.Jobs)
def list_jobs(deps: Deps, limit: Limit = None, cursor: Cursor = None) -> Response:
    """All jobs, newest first."""
    return listed("jobs", partial(deps.store.jobs.page, deps.owner), shape, limit=limit, cursor=cursor)


@router.get("/jobs/{job}", response_model=models.Job)
def get_job(job: str, deps: Deps) -> models.Job:
    """One job: its state, its progress, and what came of it."""
    return shape(deps.store.jobs.get(deps.owner, job))


@router.get("/jobs/{job}/events", response_class=Response, responses=EVENTS)
async def follow_job(job: str, deps: Deps, last_event: LastEvent = 0) -> Response:
    """What happens to a job, as it happens: its states, plan, latest progress and log. Ends after the last state."""
    look = partial(deps.store.jobs.events, deps.owner, job)
    state = await anyio.to_thread.run_sync(deps.store.jobs.state, deps.owner, job)
    if not await anyio.to_thread.run_sync(look, last_event) and state in models.ENDED:
        return Response(status_code=204)
    return deps.streams.answer(look, event_data, last_event)


@router.post(
    "/jobs/{job}/cancel",
    response_model=models.Job,
    status_code=202,
    responses={200: {"model": models.Job, "description": "It is canceled, and nothing of it runs any more"}},
)
def cancel_job(job: str, deps: Deps) -> Response:
    """End a job. It is ``canceling`` until its processes are gone, then ``canceled``; asking twice does no harm."""
    deps.store.jobs.cancel(deps.owner, job)
    found = deps.store.jobs.get(deps.owner, job)
    status = 200 if found.state is models.JobState.CANCELED else 202
    return JSONResponse(shape(found).model_dump(mode="json"), status, headers={"Location": f"/jobs/{job}"})


@router.delete("/jobs/{job}", status_code=204)
def delete_job(
    job: str,
    deps: Deps,
    with_lift: Annotated[bool, Query(description="its lift goes too; without this a job with a lift stays")] = False,
    with_tradeoff: Annotated[bool, Query(description="its trade-off goes too, likewise")] = False,
) -> None:
    """Forget a job that has ended."""
    said = {models.JobKind.LIFT: with_lift, models.JobKind.TRADEOFF: with_tradeoff}
    deps.store.jobs.delete(deps.owner, job, given_up=[kind for kind, gone in said.items() if gone])


def take(order: JobOrder, deps: AppState) -> Response:
    """The answer to an order: the job that it makes, or made before."""
    job, new = deps.store.jobs.repeated(deps.owner, order), False
    if job is None:
        require_fit(order, deps)
        deps.devices.require(order.settings.get("device", "auto"))
        job, new = deps.store.jobs.submit(deps.owner, order, max_queued=deps.settings.max_queued)
        deps.runner.wake()
    shaped = shape(deps.store.jobs.get(deps.owner, job)).model_dump(mode="json")
    return JSONResponse(shaped, 202 if new else 200, headers={"Location": f"/jobs/{job}"})


def require_fit(order: JobOrder, deps: AppState) -> None:
    """Refuse an order that cannot be lifted, or that there is no room for."""
    cameras = deps.store.assets.get(deps.owner, order.cameras, models.AssetKind.CAMERAS)
    packs = [deps.store.assets.get(deps.owner, pack, models.AssetKind.FEATURES) for pack in order.features]
    splats = deps.store.assets.get(deps.owner, order.splats, models.AssetKind.SPLATS)
    check_kernel(splats, order.settings)
    check_fit(cameras, packs)
    judges = [deps.store.assets.get(deps.owner, *named) for named in labels_of(order.parameters)]
    if judges:
        check_labels(order, cameras, packs, *judges)
    deps.store.files.require_room(scratch_bytes(order.kind, splats, packs))


def event_data(event: Event) -> str:
    """An event's data as clients get it."""
    if event.kind is EventKind.PROGRESS:
        return models.Progress.model_validate(event.data).model_dump_json()
    if event.kind is EventKind.PLAN:
        return models.Plan.model_validate(event.data).model_dump_json()
    if event.kind is EventKind.LOG:
        return models.LogLine.model_validate(event.data).model_dump_json()
    problem = event.data["problem"]
    told = None if problem is None else problem_of(error_of(problem))
    return models.JobStep(state=event.data["state"], attempt=event.data["attempt"], problem=told).model_dump_json()


def shape(job: JobRecord) -> models.Job:
    """A job as clients get it."""
    links = {"self": f"/jobs/{job.id}", "events": f"/jobs/{job.id}/events"}
    if job.state not in models.ENDED:
        links["cancel"] = f"/jobs/{job.id}/cancel"
    if job.state is models.JobState.SUCCEEDED:
        links |= RESULT_LINKS[job.kind](job.id)
    return models.Job(
        id=job.id,
        kind=job.kind,
        state=job.state,
        attempt=job.attempt,
        splats=job.splats,
        cameras=job.cameras,
        features=list(job.features),
        settings=job.settings,
        parameters=job.parameters,
        plan=None if job.plan is None else models.Plan.model_validate(job.plan),
        progress=None if job.progress is None else models.Progress.model_validate(job.progress),
        problem=None if job.problem is None else problem_of(error_of(job.problem)),
        created=job.created,
        started=job.started,
        ended=job.ended,
        request_id=job.request_id,
        links=links,
    )
