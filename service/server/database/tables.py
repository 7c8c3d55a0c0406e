"""The database: one table per thing that must survive a crash. Times are seconds since 1970, ids are text.

`jobs` is authoritative for a job. The engine only guarantees that a submitted ticket runs until it has ended. Every
write of a worker names the fence under which it owns the job, so late writes of a dead owner change nothing.
"""

from __future__ import annotations

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    false,
    text,
)

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s",
        "pk": "pk_%(table_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
    }
)

# spec is the resolved one, figures those behind the names in it (None: of a job from before they were kept); error =
# {stage, detail, field, phrases}; fence counts the claims by workers, version every change; attempt counts from 1 and
# grows with :retry; stage, progress (0..1 of the whole job) belong to the running attempt.
jobs = Table(
    "jobs",
    metadata,
    Column("id", String(40), primary_key=True),
    Column("name", String(255), nullable=False),
    Column("state", String(16), nullable=False),
    Column("priority", Integer, nullable=False),
    Column("spec", JSON, nullable=False),
    Column("figures", Text),
    Column("image_sha256", String(64), nullable=False, index=True),
    Column("image_bytes", BigInteger, nullable=False),
    Column("created_by", String(100), nullable=False),
    Column("created_at", Float, nullable=False),
    Column("queued_at", Float, nullable=False),
    Column("started_at", Float),
    Column("ended_at", Float),
    Column("stage", String(40)),
    Column("progress", Float, nullable=False),
    Column("error", JSON(none_as_null=True)),
    Column("report", JSON(none_as_null=True)),
    Column("cancel_requested", Boolean, nullable=False),
    Column("attempt", Integer, nullable=False),
    Column("owner", String(100), index=True),
    Column("fence", Integer, nullable=False),
    Column("version", Integer, nullable=False),
)
Index(None, jobs.c.created_at, jobs.c.id)  # the list, newest first
Index(None, jobs.c.state, jobs.c.created_at, jobs.c.id)  # the list of one state
Index(None, jobs.c.state, jobs.c.priority, jobs.c.queued_at, jobs.c.id)  # the queue
Index(None, jobs.c.ended_at, jobs.c.id)  # retention

# One row per try of a stage. log_sha256: the log of the stage's process, kept as an artifact.
stage_runs = Table(
    "stage_runs",
    metadata,
    Column("id", Integer, primary_key=True, autoincrement=True),
    Column("job_id", ForeignKey("jobs.id", ondelete="CASCADE"), nullable=False, index=True),
    Column("attempt", Integer, nullable=False),
    Column("number", Integer, nullable=False),
    Column("stage", String(40), nullable=False),
    Column("state", String(16), nullable=False),
    Column("key", String(64), nullable=False),
    Column("executor", String(100), nullable=False),
    Column("fence", Integer, nullable=False),
    Column("started_at", Float, nullable=False),
    Column("ended_at", Float),
    Column("peak_rss_mb", Float),
    Column("log_sha256", String(64), index=True),
    Column("words", String(2000)),
)

# The results of a stage, by the content of everything on which it depends. outputs = {name: {sha256, bytes}}; report
# and notes are its part of report.json. Shared by all jobs; job_id is the job that computed it, for information only.
stage_results = Table(
    "stage_results",
    metadata,
    Column("key", String(64), primary_key=True),
    Column("stage", String(40), nullable=False),
    Column("outputs", JSON, nullable=False),
    Column("report", JSON, nullable=False),
    Column("notes", JSON, nullable=False),
    Column("seconds", Float, nullable=False),
    Column("peak_rss_mb", Float, nullable=False),
    Column("job_id", String(40), nullable=False),
    Column("created_at", Float, nullable=False),
    Column("used_at", Float, nullable=False, index=True),
)

# The files in `outputs`, one row each, indexed by their hash.
result_files = Table(
    "result_files",
    metadata,
    Column("key", ForeignKey("stage_results.key", ondelete="CASCADE"), primary_key=True),
    Column("name", String(100), primary_key=True),
    Column("sha256", String(64), nullable=False, index=True),
)

# Files of a job, each there as soon as its stage is committed.
artifacts = Table(
    "artifacts",
    metadata,
    Column("job_id", ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True),
    Column("name", String(100), primary_key=True),
    Column("sha256", String(64), nullable=False, index=True),
    Column("bytes", BigInteger, nullable=False),
    Column("stage", String(40), nullable=False),
    Column("created_at", Float, nullable=False),
)

# The events of a job, in order; seq counts from 1 in each job and is the id of a server-sent event.
events = Table(
    "events",
    metadata,
    Column("job_id", ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True),
    Column("seq", Integer, primary_key=True),
    Column("at", Float, nullable=False),
    Column("kind", String(40), nullable=False),
    Column("data", JSON, nullable=False),
)

# Progress of the running stage: overwritten at most twice a second; its loss does no harm.
progress = Table(
    "progress",
    metadata,
    Column("job_id", ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True),
    Column("stage", String(40), nullable=False),
    Column("share", Float, nullable=False),
    Column("at", Float, nullable=False),
)

# The result of each request, so that a client can repeat it. principal: id of the token; kind = "job" |
# "run".
idempotency_keys = Table(
    "idempotency_keys",
    metadata,
    Column("principal", String(100), primary_key=True),
    Column("kind", String(16), primary_key=True),
    Column("key", String(200), primary_key=True),
    Column("request_sha256", String(64), nullable=False),
    Column("resource_id", String(40), nullable=False, index=True),
    Column("created_at", Float, nullable=False),
)

# Counters that would otherwise need a scan: each is changed in the same transaction as the rows that it counts.
counters = Table(
    "counters",
    metadata,
    Column("name", String(40), primary_key=True),
    Column("stage", String(40), primary_key=True),
    Column("state", String(16), primary_key=True),
    Column("value", Float, nullable=False),
)

# Workers that are alive; seen_at is the database's own clock.
executors = Table(
    "executors",
    metadata,
    Column("id", String(100), primary_key=True),
    Column("host", String(255), nullable=False),
    Column("pid", Integer, nullable=False),
    Column("boot", String(40), nullable=False),
    Column("version", String(40), nullable=False),
    Column("started_at", Float, nullable=False),
    Column("seen_at", Float, nullable=False),
)

# sha256 of a token, never the token. scopes is a list of words; paired: made with a code, by the operator page.
tokens = Table(
    "tokens",
    metadata,
    Column("id", String(40), primary_key=True),
    Column("name", String(100), nullable=False),
    Column("sha256", String(64), nullable=False, unique=True),
    Column("scopes", JSON, nullable=False),
    Column("created_at", Float, nullable=False),
    Column("expires_at", Float),
    Column("last_used_at", Float),
    Column("revoked_at", Float),
    Column("paired", Boolean, nullable=False, server_default=false()),
)

# Codes with which a page is paired, by digest. wrong counts the tries with another code since it was made.
pairings = Table(
    "pairings",
    metadata,
    Column("id", String(40), primary_key=True),
    Column("salt", String(64), nullable=False),
    Column("digest", String(64), nullable=False),
    Column("created_at", Float, nullable=False),
    Column("expires_at", Float, nullable=False),
)

# Codes tried from an address, and from all of them together: `used` at the moment `at`, fewer since.
pairing_tries = Table(
    "pairing_tries",
    metadata,
    Column("address", String(100), primary_key=True),
    Column("used", Float, nullable=False),
    Column("at", Float, nullable=False),
)

# Programs given to mills. agent_run is the agent's own id of the run; view is the agent's last report on it. reason is
# {code, values} behind `words`; null where there is no code, and in rows from before there were codes.
runs = Table(
    "runs",
    metadata,
    Column("id", String(40), primary_key=True),
    Column("machine", String(100), nullable=False),
    Column("job_id", String(40), nullable=False),
    Column("program", String(100), nullable=False),
    Column("number", Integer, nullable=False),
    Column("sha256", String(64), nullable=False),
    Column("lift_mm", Float),
    Column("agent_run", String(60)),
    Column("state", String(16), nullable=False),
    Column("open", Boolean, nullable=False),
    Column("view", JSON(none_as_null=True)),
    Column("words", String(1000)),
    Column("reason", JSON(none_as_null=True)),
    Column("created_by", String(100), nullable=False),
    Column("created_at", Float, nullable=False),
    Column("ended_at", Float),
)
# One run per mill, by the database itself.
Index("uq_runs_open_machine", runs.c.machine, unique=True, sqlite_where=text("open = 1"), postgresql_where=text("open"))
Index(None, runs.c.created_at, runs.c.id)
Index(None, runs.c.machine, runs.c.created_at, runs.c.id)
Index(None, runs.c.job_id, runs.c.created_at, runs.c.id)
