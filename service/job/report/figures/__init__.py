"""The pictures of a job."""
