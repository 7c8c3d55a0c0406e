"""What every HTTP interface of ours shares."""
