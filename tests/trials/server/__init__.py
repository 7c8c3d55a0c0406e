"""Storms over the job server: processes killed, frozen and restarted at random while real jobs run."""
