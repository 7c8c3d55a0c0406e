"""One mill and its owner: link, runs, journal, and the snapshot for others."""
