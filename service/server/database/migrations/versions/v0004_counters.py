"""Lists, the queue and retention by indexes; figures that took a scan become counters; leases of mills go."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"

_INDEXES = {
    "jobs": (
        ("created_at", "id"),
        ("state", "created_at", "id"),
        ("state", "priority", "queued_at", "id"),
        ("ended_at", "id"),
        ("image_sha256",),
    ),
    "stage_runs": (("log_sha256",),),
    "stage_results": (("used_at",),),
    "idempotency_keys": (("resource_id",),),
    "runs": (("created_at", "id"), ("machine", "created_at", "id"), ("job_id", "created_at", "id")),
}
_REPLACED = {"jobs": ("state", "created_at"), "runs": ("machine", "job_id")}


def upgrade() -> None:
    op.drop_table("controls")  # who has control is the mill's agent's to know
    for table, columns in _REPLACED.items():
        for column in columns:
            op.drop_index(f"ix_{table}_{column}", table)
    for table, indexes in _INDEXES.items():
        for names in indexes:
            op.create_index(f"ix_{table}_{'_'.join(names)}", table, list(names))
    op.create_table(
        "result_files",
        sa.Column("key", sa.String(length=64), nullable=False),
        sa.Column("name", sa.String(length=100), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.ForeignKeyConstraint(["key"], ["stage_results.key"], name="fk_result_files_key", ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("key", "name", name="pk_result_files"),
    )
    op.create_table(
        "counters",
        sa.Column("name", sa.String(length=40), nullable=False),
        sa.Column("stage", sa.String(length=40), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("value", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("name", "stage", "state", name="pk_counters"),
    )
    _fill_result_files()
    _fill_counters()
    op.create_index("ix_result_files_sha256", "result_files", ["sha256"])


def _fill_result_files() -> None:
    sha256 = (
        "json_extract(file.value, '$.sha256')" if op.get_bind().dialect.name == "sqlite" else "file.value->>'sha256'"
    )
    op.execute(
        f"INSERT INTO result_files (key, name, sha256) SELECT result.key, file.key, {sha256} "
        "FROM stage_results AS result, json_each(result.outputs) AS file"
    )


def _fill_counters() -> None:
    into = "INSERT INTO counters (name, stage, state, value) SELECT"
    op.execute(f"{into} 'jobs', '', state, count(*) FROM jobs GROUP BY state")
    op.execute(
        f"{into} 'stage_runs', stage, state, count(*) FROM stage_runs WHERE state <> 'running' GROUP BY stage, state"
    )
    op.execute(
        f"{into} 'stage_seconds', stage, state, sum(ended_at - started_at) FROM stage_runs "
        "WHERE state = 'committed' GROUP BY stage, state"
    )
    op.execute(f"{into} 'stage_results', '', '', count(*) FROM stage_results")
