"""Flux tubes: their rays, their areas on the pixels, and the transposed derivative of the picture that they make."""
