"""What is known of a run, on disk, and still readable after the power failed."""
