"""The optical path to the screen as the unknown of the default method: pre-images, rims, levels, mixing."""
