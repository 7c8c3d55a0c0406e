"""The test piece: its programs, the predicted photograph, and what a photograph of it says of mill and finish."""
