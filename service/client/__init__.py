"""Commands that talk to a job server."""
