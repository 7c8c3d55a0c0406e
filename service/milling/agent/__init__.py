"""The machine agent: one process that owns one mill and lets itself be told over HTTP."""
