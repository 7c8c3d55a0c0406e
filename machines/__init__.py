"""Mills: what each can do (profiles)."""
