"""Serves stops while the API does not: before it is ready, while it restarts, and while it hangs."""
