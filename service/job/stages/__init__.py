"""Stages of a job, each between the files of earlier ones and its own."""
