"""The machine agent: one process that owns one mill and is controlled over HTTP."""
