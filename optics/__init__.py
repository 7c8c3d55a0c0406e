"""From a target picture to a refracting heightfield, and light through it. Arrays in, arrays out."""
