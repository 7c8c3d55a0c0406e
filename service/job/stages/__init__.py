"""Stages of a job beside those of the lens and its passes."""
