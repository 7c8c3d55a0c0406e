"""Which tools, pitches and passes: all plans at a guess, then the choice."""
