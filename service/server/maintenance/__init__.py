"""Backup, restore, verification and systemd units."""
