"""The test piece that shows how well a mill cuts and what a finish does to heights: its shape, its light, the fit."""
