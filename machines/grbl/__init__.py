"""GRBL 1.1, grblHAL and FluidNC: what they say, what may be sent when, and the driver that drives them."""
