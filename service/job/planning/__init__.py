"""Plans of a job: which passes, which finish, and what they will show."""
