"""`serve`: API, worker and agents of one computer started, watched, and ended with it."""
