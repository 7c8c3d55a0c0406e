"""Polishing on the mill: a path of a soft ball without preferred direction, and its check."""
