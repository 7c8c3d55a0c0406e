"""The stages of a job: pure work on one folder, each with what it reads, writes and depends on."""
