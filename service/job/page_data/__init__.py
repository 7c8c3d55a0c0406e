"""Data that the operator page draws: the lens's surface, its light, the paths of the passes."""
