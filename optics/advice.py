"""What a person should know about a lens, with what to change: a sentence, and the figures behind it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Advice:
    """figures : of this very lens; of a coarse one they are no more than a first guess, and its words are enough."""

    words: str
    figures: str = ""

    def __str__(self) -> str:
        return f"{self.words} ({self.figures})" if self.figures else self.words
