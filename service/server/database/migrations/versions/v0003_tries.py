"""Codes that are tried count for the address they come from, no longer against the code."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    with op.batch_alter_table("pairings") as table:
        table.drop_column("wrong")
    op.create_table(
        "pairing_tries",
        sa.Column("address", sa.String(length=100), nullable=False),
        sa.Column("used", sa.Float(), nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("address", name="pk_pairing_tries"),
    )
