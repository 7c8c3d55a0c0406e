"""Long trials of the streamer against the simulated mill, and of the job server (`server`); `make soak` runs them."""
