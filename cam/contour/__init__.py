"""One connected path that follows the contour lines of the surface over the whole aperture."""
