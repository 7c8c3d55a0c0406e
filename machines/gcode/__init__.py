"""Programs in G-code: their language line by line, whole programs at disk speed, refusals in words."""
