"""Runs jobs: the engine, leases between hosts, and each stage in a process that can be killed."""
