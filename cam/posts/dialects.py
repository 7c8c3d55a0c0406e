"""Every dialect that programs can be written in, by the name that machine profiles give it."""

from __future__ import annotations

from cam.posts.grbl import FLUIDNC, GRBL, GRBLHAL
from cam.posts.iso import FANUC, LINUXCNC, OKUMA, ROLAND_NC
from cam.posts.rml import RML
from cam.posts.writer import Dialect

_ALL: tuple[Dialect, ...] = (GRBL, GRBLHAL, FLUIDNC, LINUXCNC, FANUC, OKUMA, ROLAND_NC, RML)
POSTS: dict[str, Dialect] = {post.name: post for post in _ALL}
