"""Why a run is in its state, as a code with values beside the words."""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"


def upgrade() -> None:
    op.add_column("runs", sa.Column("reason", sa.JSON(none_as_null=True), nullable=True))
