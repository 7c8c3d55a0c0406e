"""The tables of the job spec."""
