"""Rows along X or Y: their vertices, layers, entries and turns, and where stock was left."""
