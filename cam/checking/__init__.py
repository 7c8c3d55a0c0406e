"""Simulates what a written program does to the block, and decides whether it may be used."""
