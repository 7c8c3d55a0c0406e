"""Post-processors: each turns moves into the blocks of one control dialect."""
