"""Plans of a job: its passes, its finish, and the picture that they will show."""
