"""The operator page: plain HTML, CSS and ES modules, served unchanged (`files.py`)."""
