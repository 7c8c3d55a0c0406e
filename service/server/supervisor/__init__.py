"""One computer's services: starting, stopping, installing, backing up."""
