"""How jobs, events and files are answered."""
