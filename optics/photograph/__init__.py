"""A photograph of light on a wall: where the predicted light lies in it, and what it shows of the set-up."""

from optics.photograph.registering import Registration, register

__all__ = ["Registration", "register"]
