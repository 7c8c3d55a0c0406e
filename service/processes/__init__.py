"""Processes and folders: children, locks, priorities, compiled kernels, privacy."""
