"""Sentences for people, in a form that can be translated into every language; imports no other package."""
