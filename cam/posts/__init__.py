"""Moves to the blocks of one control dialect each."""
