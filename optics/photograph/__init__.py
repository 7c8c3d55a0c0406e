"""Evaluates a photograph of light on a wall: registers it with the predicted light, and estimates the set-up."""

from optics.photograph.registering import Registration, register

__all__ = ["Registration", "register"]
