"""What is milled before and after the passes of the lens: a trace in the air, facing, cutting out; and their check."""
