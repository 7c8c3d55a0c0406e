"""How the tables of an earlier program become those of this one, step by step (alembic)."""
