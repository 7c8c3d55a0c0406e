"""Whole ways through the page, by a person who has a real server and a simulated mill."""
