"""The test piece: its programs, the predicted photograph, and the evaluation of a photograph for mill and finish."""
