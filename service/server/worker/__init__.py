"""One claimed job through its stages: leases, monitoring, repair, retention."""
