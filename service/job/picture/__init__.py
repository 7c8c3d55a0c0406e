"""From a picture file to the light that a lens aims at."""
