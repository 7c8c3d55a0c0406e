"""Data that the operator page draws: the lens's surface, pictures through focus, the paths of the passes."""
