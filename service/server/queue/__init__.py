"""The job engine: a small interface to DBOS."""
