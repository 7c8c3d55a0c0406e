"""Translatable sentences for people. Imports no other package."""
