"""The job server: API, worker, database, fleet of mills, supervisor."""
