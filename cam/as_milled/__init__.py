"""The surface that a program really leaves: every groove of its ball, as facets that light can be sent through."""
