"""Computes a refracting heightfield from a target picture, and simulates its light. Arrays in, arrays out."""
