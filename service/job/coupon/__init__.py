"""The test piece: its programs, the photograph foretold, and what a photograph of it says of mill and finish."""
