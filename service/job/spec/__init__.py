"""The job spec: its model, files, overrides and resolution; the libraries of tools and finishes."""
