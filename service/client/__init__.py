"""The commands `submit`, `jobs`, `get` and `runs`: they know the job server's REST interface and nothing else of it."""
