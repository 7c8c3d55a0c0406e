"""What is known of one job, and what is asked about it afterwards."""
