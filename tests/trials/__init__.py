"""Long trials of the streamer against the simulated mill; `make soak` runs them, `pytest` does not."""
