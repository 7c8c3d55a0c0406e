"""A photograph of a finished lens's light on the wall: read, compared with the prediction, reported in sentences."""
