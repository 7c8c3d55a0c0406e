"""What a job is made of: its data libraries and the steps that are taken by hand."""
