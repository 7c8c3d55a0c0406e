"""The commands `submit`, `jobs`, `get` and `runs`: they use only the job server's REST interface."""
