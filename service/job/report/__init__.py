"""Parts of the setup sheet."""
