"""The command `causticmill`: one file for each group of commands."""
