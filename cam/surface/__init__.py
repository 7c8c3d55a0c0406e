"""Where the tip is when a ball touches the lens, and the stock that it meets."""
