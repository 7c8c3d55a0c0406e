"""Checks a program against the mill before it moves: extents, time, rules, entry points."""
