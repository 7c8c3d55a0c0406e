"""What is known of jobs: their states, their tables, and every change to them."""
