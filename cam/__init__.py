"""Computes milling programs from a heightfield, and simulates their removal. Knows no port and no HTTP."""
