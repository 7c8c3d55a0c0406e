"""The surface that a program really leaves: every groove of the ball, as facets for tracing light."""
