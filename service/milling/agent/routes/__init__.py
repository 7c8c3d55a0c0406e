"""The agent's routes."""
