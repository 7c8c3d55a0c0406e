"""A job: its spec, its stages, what they make of it, and what is done by hand afterwards."""
