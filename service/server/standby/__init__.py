"""Serves stops while the API does not: before it is there, while it is started again, and while it hangs."""
