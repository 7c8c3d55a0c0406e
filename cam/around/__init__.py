"""What is milled around the passes of the lens: a trace in the air, facing, cutting out with tabs; and its check."""
