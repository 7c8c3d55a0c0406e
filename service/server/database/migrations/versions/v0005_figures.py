"""A job keeps the figures of mill, tools and finishing processes that it was submitted with."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    op.add_column("jobs", sa.Column("figures", sa.Text()))
