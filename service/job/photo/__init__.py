"""A photograph of a finished lens's light on the wall: read, compared with what was foretold, told in sentences."""
