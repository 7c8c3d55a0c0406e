"""Shared parts of all HTTP interfaces."""
