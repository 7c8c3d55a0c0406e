"""Programs on mills: the agent that owns one, the terminal, and pre-flight in a child process."""
