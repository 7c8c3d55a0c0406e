"""The tables of the first release. Nothing to do: a database without tables gets those of `tables.py` at once.

The step after this one begins at tests/service/server/database/tables-0006.sql.
"""

revision = "0006"
down_revision = None


def upgrade() -> None:
    """Change nothing."""
