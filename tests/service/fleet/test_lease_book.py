"""Control of a mill as a state machine: whatever people do and however time passes, at most one of them has it."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from service.fleet import lease_book
from service.fleet.lease_book import LEASE_S, HeldError, LeaseBook
from service.jobs.database import connect
from service.jobs.tables import metadata

MACHINE = "mill"
PEOPLE = st.sampled_from(["Ada", "Bob", "Eve"])


class Leases(RuleBasedStateMachine):
    """Beside the book: who should have control, until when at least, and until when at most."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = TemporaryDirectory()
        self.database = connect(f"sqlite:///{Path(self.folder.name) / 'leases.sqlite'}")
        metadata.create_all(self.database)
        self.now_s = 1000.0
        self.patch = pytest.MonkeyPatch()
        self.patch.setattr(lease_book, "clock", lambda _connection: self.now_s)
        self.book = LeaseBook(self.database)
        self.secrets: dict[str, str] = {}
        self.holder = ""
        self.renewed_s = 0.0

    def teardown(self) -> None:
        self.patch.undo()
        self.database.dispose()
        self.folder.cleanup()

    @property
    def now_held_by(self) -> str:
        """Nobody's any more once nothing was heard for a lease."""
        return self.holder if self.now_s < self.renewed_s + LEASE_S else ""

    @rule(person=PEOPLE, take_over=st.booleans())
    def takes(self, person: str, take_over: bool) -> None:
        before = self.now_held_by
        try:
            secret, lease, new = self.book.take(
                MACHINE, person, "token", self.secrets.get(person, ""), take_over=take_over
            )
        except HeldError as error:
            assert before not in ("", person) and not take_over and error.lease.operator == before
            return
        assert before in ("", person) or take_over
        assert new == (before != person) and lease.operator == person
        if new:
            assert secret not in self.secrets.values()
        self.secrets[person], self.holder, self.renewed_s = secret, person, self.now_s

    @rule(person=PEOPLE)
    def orders(self, person: str) -> None:
        kept = self.book.keep(MACHINE, self.secrets.get(person, ""))
        assert kept == (self.now_held_by == person)
        if kept and self.now_s >= self.renewed_s + lease_book._RENEWED_EVERY_S:
            self.renewed_s = self.now_s

    @rule(person=PEOPLE)
    def gives_back(self, person: str) -> None:
        given = self.book.release(MACHINE, self.secrets.get(person, ""))
        assert given == (self.now_held_by == person)
        if given:
            self.holder = ""

    @rule(seconds=st.sampled_from([1.0, 4.9, 5.0, 30.0, 59.9, 60.0, 200.0]))
    def waits(self, seconds: float) -> None:
        self.now_s += seconds

    @invariant()
    def one_at_most(self) -> None:
        lease = self.book.holder(MACHINE)
        assert (lease.operator if lease else "") == self.now_held_by
        assert self.book.holder("another") is None


TestLeases = Leases.TestCase
TestLeases.settings = settings(max_examples=30, stateful_step_count=25, deadline=None, derandomize=True)
