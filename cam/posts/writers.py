"""The writer of each family of dialects."""

from __future__ import annotations

from cam.posts.dialects import Dialect
from cam.posts.gcode_writer import ProgramWriter
from cam.posts.post import Post, RmlPost
from cam.posts.rml_writer import RmlWriter
from cam.posts.writer import Writer


def create_writer(dialect: Dialect) -> Writer:
    """Return the writer of one program in a dialect."""
    match dialect:
        case Post():
            return ProgramWriter(dialect)
        case RmlPost():
            return RmlWriter(dialect)
