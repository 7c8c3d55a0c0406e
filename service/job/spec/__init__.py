"""The job spec: its model, files and overrides, what it resolves to; the libraries of tools and finishes."""
