"""The journal of a run on disk, readable after a power failure."""
