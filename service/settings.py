"""Settings of the service, and the text encoder for each text space.

Each field may be set by an environment variable, SPLATLIFT_ and its name in capitals; empty means not set.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict, SettingsError

from liftcore.errors import InvalidInput
from liftcore.text import BUILT_IN, NO_WORDS, OWN_WORDS, check_encoder, encoder_file
from service.errors import InvalidRequest, Misconfigured

MiB, GiB = 1 << 20, 1 << 30


class ServiceSettings(BaseSettings):
    """Settings of the service; none can be changed over HTTP."""

    model_config = SettingsConfigDict(env_prefix="SPLATLIFT_", env_ignore_empty=True, frozen=True, extra="forbid")

    data: Path = Field(Path("splatlift-data"), description="the directory that holds the database and all files")
    host: str = Field("127.0.0.1", description="the address to bind; beyond loopback only with keys")
    port: int = Field(8787, ge=0, le=65_535, description="the port to bind; 0 picks a free one")
    allowed_hosts: Annotated[tuple[str, ...], NoDecode] = Field(
        (), description="names in Host and Origin beside those of loopback and the bound address, with commas between"
    )
    forwarded_allow: str = Field(
        "", description="addresses of proxies whose X-Forwarded-For is trusted, for the log, with commas between"
    )
    upload_bytes: int = Field(16 * GiB, gt=0, description="the largest upload")
    disk_floor_bytes: int = Field(
        256 * MiB, ge=0, description="free disk that uploads and jobs must leave; else they are answered 507"
    )
    check_seconds: float = Field(300, gt=0, description="wall time that the check of an upload, or a plan, may take")
    check_memory_bytes: int = Field(
        8 * GiB, gt=0, description="private memory of the check of an upload or a plan, beside its imports"
    )
    max_queued: int = Field(100, ge=1, description="jobs that may wait in line; more are answered 503")
    parallel_jobs: int = Field(1, ge=1, le=64, description="jobs that run at the same time")
    threads: int | None = Field(
        None, ge=1, description="threads of a job; not set = the cores shared out among the parallel jobs"
    )
    job_seconds: float = Field(86_400, gt=0, description="wall time that one attempt at a job may take")
    engine: Literal["local", "ray"] | None = Field(
        None,
        description="engine of lifts in blocks, of bounded memory: local, or ray of RAY_ADDRESS; not set = in memory",
    )
    encoder: str = Field(
        "lvis",
        description="text encoder for lifts of its own text space and, if you set it, for those whose text space has "
        "no entry in SPLATLIFT_TEXT_SPACES: lvis, table:FILE, open_clip:MODEL...",
    )
    text_spaces: dict[str, str] = Field(
        {}, description="text space -> text encoder, in the same notation (JSON object)"
    )
    query_seconds: float = Field(120, gt=0, description="wall time after which a query is given up")

    @field_validator("allowed_hosts", mode="before")
    @classmethod
    def _names(cls, value: Any) -> Any:
        return [name.strip() for name in value.split(",") if name.strip()] if isinstance(value, str) else value

    @property
    def job_threads(self) -> int:
        """Threads of a job."""
        return self.threads or max(1, len(os.sched_getaffinity(0)) // self.parallel_jobs)


def variables() -> Iterator[tuple[str, str, str]]:
    """Yield the environment variable, default and description of each setting, in order."""
    for name, field in ServiceSettings.model_fields.items():
        default = field.default
        text = "" if default in (None, ()) else str(default)
        if isinstance(default, int) and name.endswith("bytes"):
            text = f"{default} ({default // MiB} MiB)"
        yield f"SPLATLIFT_{name.upper()}", text, field.description or ""


def read_settings(**values: Any) -> ServiceSettings:
    """Return the settings: of a command line (None is not set), else of the environment, else the defaults."""
    try:
        return ServiceSettings(**{name: value for name, value in values.items() if value is not None})
    except SettingsError:  # malformed JSON in a variable
        raise Misconfigured(
            "SPLATLIFT_TEXT_SPACES", expected="JSON", got=repr(os.environ.get("SPLATLIFT_TEXT_SPACES"))[:120],
            hint="a JSON object looks like '{\"NAME\": \"table:FILE\"}'",
        ) from None  # fmt: skip
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        raise Misconfigured(name, expected=first["msg"].lower(), got=repr(first["input"])[:120]) from None


def encoder_spec(settings: ServiceSettings, text_space: str, requested: str | None) -> str:
    """Return the specification of a query's text encoder: of the requested space, else of the lift's.

    The default stands in for a space that has none only where the operator chose it: scores of an encoder of another
    space look like any others, and mean nothing. A lift with words of its own is queried in these.
    """
    if requested == "default":
        return settings.encoder
    if requested in (None, text_space) and text_space == OWN_WORDS:
        return OWN_WORDS
    if requested not in (None, text_space):
        if requested not in settings.text_spaces:
            raise InvalidRequest(
                "encoder", expected="the name of a text space that the operator set up", got=repr(requested),
                hint=f"known here: {', '.join(['default', *sorted(settings.text_spaces)])}",
            )  # fmt: skip
        return settings.text_spaces[requested]
    if text_space in settings.text_spaces:
        return settings.text_spaces[text_space]
    if text_space == settings.encoder or (text_space != NO_WORDS and "encoder" in settings.model_fields_set):
        return settings.encoder
    for encoder, space in BUILT_IN.items():
        if text_space == space:
            return encoder
    if text_space == NO_WORDS:
        raise InvalidRequest(
            "lift", expected="features that share a space with a text encoder", got="text space 'none'",
            hint="ask by example, with like=; or name an encoder with encoder= if you know better",
        )  # fmt: skip
    example = json.dumps({text_space or "NAME": "table:FILE"})
    raise InvalidRequest(
        "lift", expected="features of a text space that this server has an encoder for",
        got=f"text space {text_space!r}" if text_space else "features that name no text space",
        hint="ask with table=ID of an uploaded text table, or by example, with like="
        + ("" if text_space else "; splatlift pack retag names a pack's text space, for a lift of it")
        + f"; or the operator sets SPLATLIFT_TEXT_SPACES='{example}' or SPLATLIFT_ENCODER;"
        f" encoder=default asks {encoder_label(settings.encoder)} all the same",
    )  # fmt: skip


def encoder_label(spec: str) -> str:
    """Return the specification of an encoder without private paths."""
    return "table" if spec.startswith("table:") or spec.endswith(".safetensors") else spec.partition("@")[0]


def encoder_version(spec: str) -> list[int] | None:
    """Return the time and size of an encoder's file, which change with it; None without a file."""
    file = encoder_file(spec)
    try:
        status = file.stat() if file is not None else None
    except OSError:
        return None
    return None if status is None else [status.st_mtime_ns, status.st_size]


def require_encoder_files(settings: ServiceSettings) -> None:
    """Require that every file of a text encoder is there, and that tables look like tables.

    The query process opens an encoder at its first question, whose client could not mend the error.
    """
    specs = {"encoder": settings.encoder}
    specs |= {f"text_spaces, {space!r}": spec for space, spec in settings.text_spaces.items()}
    for argument, spec in specs.items():
        try:
            check_encoder(spec)
        except InvalidInput as error:
            raise Misconfigured(argument, expected=error.expected, got=error.got, hint=error.hint) from None
