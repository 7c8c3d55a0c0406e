"""One stage in a process that can be killed, forked from a warm one."""
