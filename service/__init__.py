"""The shell: command line, job specification, files and reports around the pure packages."""
