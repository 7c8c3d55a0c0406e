"""Mills: drivers and their one interface, the port, what each mill can do (profiles), the states of runs."""
