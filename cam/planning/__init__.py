"""Plans tools, pitches and passes: estimates all plans, then chooses one."""
