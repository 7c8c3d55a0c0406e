"""A job: its spec, its stages and what they make of it."""
