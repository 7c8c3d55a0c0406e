"""Settings of the job server, its workers and its machines: from the environment (CAUSTICMILL_...), all with defaults.

Command-line options become environment variables of the processes that `serve` starts, so this is the one place where a
default is written. A misspelt variable, and its limit, would be ignored silently: `unknown_settings` finds it.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict

from service.errors import InputError, printable

PREFIX = "CAUSTICMILL_"
SAFE_SHARE = 0.6  # share of a lease: a worker that has not renewed it for that long stops, well before others take over
# Variables that are read elsewhere: by clients, profiles, secrets, the command itself. TRIAL... are for the trials of
# the server.
_OTHERS = ("SERVER", "TOKEN", "CONFIG_DIR", "SECRETS", "BEGAN", "PUBLISHED_PORT")
_TRIALS = ("TRIAL", "BENCH_", "FUZZ_", "SLOW", "REWRITE_")


class ServerSettings(BaseSettings):
    """Every value can be set as CAUSTICMILL_<NAME>.

    data              : folder of database, artifacts, scratch, agents and locks of this computer
    database_url      : postgresql://...; None: a SQLite file in `data`
    upgrade_to        : the version to which tables of PostgreSQL that hold jobs may be upgraded: a copy of them is kept
    store_url         : file:///folder, s3://bucket/prefix; None: the folder `objects` in `data`
    store_is_shared   : a person states that a file:// store is the same folder on every host of the farm
    host, port        : address to serve on; another computer needs a proxy with TLS
    anonymous         : what a caller on this computer without a token may do, as long as no token has ever been made
    allowed_hosts     : further names under which the server may be called (Host header)
    behind_proxy      : a proxy with TLS and its own authentication is in front; needed to bind anything but loopback
    lease_s           : a worker without a heartbeat for this time counts as dead, and its jobs move
    slots             : jobs that one worker runs at the same time
    executor          : this worker's name in the farm; None: made from host and data folder
    stage_memory_mb   : address space of a stage's process in addition to its size at the start
    stage_time_s      : the longest a stage may take
    max_upload_mb     : the largest picture that is accepted
    max_megapixels    : the most pixels of a picture
    free_disk_mb      : below this much free space nothing new is accepted or started
    keep_days         : ended jobs older than this are deleted; None: kept
    quota_mb          : artifacts beyond this are deleted, oldest ended jobs first; None: no quota
    requests_per_s    : of one caller, with bursts of ten times as many
    jobs_per_min      : jobs that one caller may submit
    agents_file       : TOML that lists the agents of mills on other computers
    start_agents      : `serve` starts an agent for every configured machine that has a port
    prepare           : compile kernels soon after the start, so that the first estimate and the first job need not wait
    simulated_mill    : `serve` also offers a simulated mill, to try everything on
    notify_url        : web address for JSON notices when a mill needs a person; None: no notices
    notify_email      : mailbox for the same notices
    smtp_url          : server that sends these mails: smtp://user:password@host:port, or smtps://
    mqtt_url          : broker by which Home Assistant shows the mills: mqtt://user:password@host, or mqtts://
    cameras           : {"mill": "http://..."}: beside each mill one that sends a JPEG, or a stream of them
    log_level         : the least important lines that are logged
    log_format        : json, a line each; text, for people; auto: text on a terminal, json elsewhere
    """

    model_config = SettingsConfigDict(env_prefix=PREFIX, frozen=True, extra="ignore")

    data: Path = Path("causticmill-data")
    database_url: str | None = None
    upgrade_to: str | None = None
    store_url: str | None = None
    store_is_shared: bool = False
    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    anonymous: Literal["jobs", "none"] = "jobs"
    allowed_hosts: tuple[str, ...] = ()
    behind_proxy: bool = False
    lease_s: Annotated[float, Field(ge=1, le=3600)] = 30.0
    slots: Annotated[int, Field(ge=1, le=64)] = 1
    executor: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.:-]{0,90}$")] | None = None
    stage_memory_mb: Annotated[int, Field(ge=256)] = 8000
    stage_time_s: Annotated[float, Field(ge=1)] = 6 * 3600.0
    max_upload_mb: Annotated[float, Field(gt=0, le=1024)] = 64.0
    max_megapixels: Annotated[float, Field(gt=0, le=100)] = 40.0
    free_disk_mb: Annotated[int, Field(ge=0)] = 1000
    keep_days: Annotated[float, Field(gt=0)] | None = None
    quota_mb: Annotated[int, Field(gt=0)] | None = None
    requests_per_s: Annotated[float, Field(gt=0)] = 50.0
    jobs_per_min: Annotated[float, Field(gt=0)] = 600.0
    agents_file: Path | None = None
    start_agents: bool = True
    prepare: bool = True
    simulated_mill: bool = False
    notify_url: Annotated[str, Field(pattern=r"^https?://\S+$")] | None = None
    notify_email: Annotated[str, Field(pattern=r"^[^@\s]+@[^@\s]+$")] | None = None
    smtp_url: Annotated[str, Field(pattern=r"^smtps?://\S+$")] = "smtp://localhost:25"
    mqtt_url: Annotated[str, Field(pattern=r"^mqtts?://\S+$")] | None = None
    cameras: dict[str, Annotated[str, Field(pattern=r"^https?://\S+$")]] = {}
    log_level: Literal["debug", "info", "warning"] = "info"
    log_format: Literal["auto", "json", "text"] = "auto"

    @property
    def embedded(self) -> bool:
        """Whether database and store belong to this folder alone: one computer, one worker."""
        return self.database_url is None

    @property
    def sqlite(self) -> Path:
        """The path of the database file that SQLite uses."""
        return self.data.absolute() / "causticmill.sqlite"

    @property
    def sqlalchemy_url(self) -> str:
        """The URL of the database for SQLAlchemy and the engine (psycopg 3 for PostgreSQL)."""
        if self.database_url is None:
            return f"sqlite:///{self.sqlite}"
        return self.database_url.replace("postgres://", "postgresql://", 1).replace(
            "postgresql://", "postgresql+psycopg://", 1
        )

    @property
    def scratch(self) -> Path:
        """Working folder of stages; on the store's file system if that is local, so that files need not be copied."""
        return self.data / "scratch"

    @property
    def plans(self) -> Path:
        """Folder of plans that estimates and jobs made, for later ones: see `job/stages/kept_plans`."""
        return self.data / "plans"

    @property
    def agents_folder(self) -> Path:
        """One folder per local mill: its agent's journal, programs, token and agent.json."""
        return self.data / "agents"

    @property
    def max_upload_bytes(self) -> int:
        return int(self.max_upload_mb * 1e6)

    @property
    def max_pixels(self) -> int:
        return int(self.max_megapixels * 1e6)

    def environment(self) -> dict[str, str]:
        """Return the environment of a child process with the same settings as this one."""
        own = {
            f"{PREFIX}{name.upper()}": _as_text(value)
            for name, value in self.model_dump(mode="json", exclude_none=True).items()
        }
        others = {key: value for key, value in os.environ.items() if key.upper() not in own}
        return others | own

    @classmethod
    def load(cls, **given: object) -> Self:
        """Load from the environment, `given` (those not None) on top. InputError names the variable at fault.

        Values that should not be in the environment may be in files: $CAUSTICMILL_SECRETS/causticmill_<name>.
        """
        secrets = os.environ.get(f"{PREFIX}SECRETS") or None
        if secrets is not None and not Path(secrets).is_dir():
            raise InputError(f"{PREFIX}SECRETS: there is no folder {secrets!r}")
        values = {key: value for key, value in given.items() if value is not None}
        try:
            return cls(_secrets_dir=secrets, **values)  # type: ignore[arg-type, call-arg]
        except ValidationError as error:
            raise InputError(*(_sentence(dict(problem)) for problem in error.errors())) from None


def _as_text(value: object) -> str:
    import json

    return value if isinstance(value, str) else json.dumps(value)


def _sentence(problem: dict[str, object]) -> str:
    where = problem["loc"]
    name = str(where[0]) if isinstance(where, tuple) and where else "settings"
    return printable(f"{PREFIX}{name.upper()}: {problem['input']!r} cannot be used: {problem['msg']}")


def unknown_settings(environment: Mapping[str, str]) -> Iterator[str]:
    """Yield a sentence for each variable that looks like a setting but is not one."""
    settings = [name.upper() for name in ServerSettings.model_fields]
    for variable in sorted(environment):
        name = variable.upper().removeprefix(PREFIX)
        if name == variable.upper() or name in settings or name in _OTHERS or name.startswith(_TRIALS):
            continue
        meant = difflib.get_close_matches(name, settings, n=1)
        hint = f"; {PREFIX}{meant[0]} is one" if meant else ""
        yield f"{variable} is not a setting{hint}"
