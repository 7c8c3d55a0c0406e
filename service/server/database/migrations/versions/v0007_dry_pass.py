"""A run may be a dry pass: its program at a raised height, with the spindle off."""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"


def upgrade() -> None:
    """Add the lift; None: the program unchanged, like all runs so far."""
    op.add_column("runs", sa.Column("lift_mm", sa.Float))
