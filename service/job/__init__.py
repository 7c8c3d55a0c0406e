"""A job: its spec, its stages, their results, and the finish by hand afterwards."""
