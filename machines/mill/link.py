"""The link of a mill: opens it again at growing intervals, and keeps orders given while it was away.

Opening a link sends queries and, before them, a hold or an abort that was ordered meanwhile; never anything that can
start motion.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable
from dataclasses import dataclass

from machines.driver import Driver, MillState, MillStatus, StreamProgress
from machines.errors import MachineError
from machines.grbl.settings import ControllerSettings
from phrases.phrase import NO_WORDS, Phrase

BACK_OFF_S = (0.2, 0.5, 1.0, 2.0, 5.0)
AWAY = frozenset({MillState.DISCONNECTED, MillState.CONNECTING})
NO_MILL = MillStatus()


@dataclass(slots=True)
class Setup:
    """The mill's set-up as known since the link was opened.

    zeroed       : axes whose work zero was set, as far as the position is still trusted
    zeroed_anew  : those of them that were set since a program last started: not for a block before this one
    homed        : a homing cycle was carried out, and the position was not lost since
    parser_state : the controller's modes ($G) as last reported
    """

    zeroed: str = ""
    zeroed_anew: str = ""
    homed: bool = False
    parser_state: str | None = None

    def forget_place(self) -> None:
        self.zeroed, self.zeroed_anew, self.homed = "", "", False

    def digest(self, status: MillStatus, needs: tuple[Phrase, ...]) -> str:
        """Return a digest of the facts on which a start depends, to check that a person has seen the present ones."""
        offset = None if status.work_offset_mm is None else [round(one, 3) for one in status.work_offset_mm]
        rests_on = (offset, self.zeroed, self.homed, status.position_trusted, status.epoch, bool(needs))
        return hashlib.sha256(repr(rests_on).encode()).hexdigest()[:16]


class MillLink:
    """At most one driver. `latched` is "hold" or "abort" while that waits for the link, else ""."""

    def __init__(
        self,
        connect: Callable[[], Driver],
        clock: Callable[[], float],
        pause: Callable[[float], object] | None,
        say: Callable[[str, Phrase], None],
    ) -> None:
        self._connect = connect
        self._clock = clock
        self._pause = pause or self._wait
        self._say = say
        self._woken = threading.Event()
        self._tries = 0
        self._try_at_s = float("-inf")
        self.driver: Driver | None = None
        self.problem = NO_WORDS
        self.latched = ""
        self.setup = Setup()

    @property
    def status(self) -> MillStatus:
        return self.driver.status if self.driver is not None else NO_MILL

    @property
    def progress(self) -> StreamProgress:
        return self.driver.progress if self.driver is not None else StreamProgress()

    @property
    def away(self) -> bool:
        return self.status.state in AWAY

    def wake(self) -> None:
        """End a wait (from any thread)."""
        self._woken.set()
        driver = self.driver
        if driver is not None:
            driver.wake()

    def _wait(self, seconds: float) -> None:
        self._woken.wait(seconds)
        self._woken.clear()

    def open(self, timeout_s: float) -> bool:
        """Try to open the link, or wait for the next try; return whether there is a link now."""
        wait_s = self._try_at_s - self._clock()
        if wait_s > 0.0:
            self._pause(min(wait_s, timeout_s, BACK_OFF_S[-1]))
            return False
        driver: Driver | None = None
        try:
            driver = self._connect()
            driver.connect()
        except MachineError as error:
            if driver is not None:
                driver.close()
            self._fail(error.words)
            return False
        self.driver = driver
        if self.latched:
            self.order(self.latched)
        return True

    def order(self, what: str) -> None:
        """Hold or abort now; if the link is away or refuses, do so first when it is back."""
        driver = self.driver
        if driver is not None:
            try:
                if what == "abort":
                    driver.abort()
                else:
                    driver.hold()
            except MachineError:
                if not self.away:
                    raise
        if self.away:
            if not self.latched:
                self._say("command", Phrase("{what}: waits for the link", what=what))
            self.latched = "abort" if "abort" in (what, self.latched) else what

    def hold_unasked(self) -> None:
        """Hold on our own initiative; a refusal of the driver is logged, not raised."""
        try:
            self.order("hold")
        except MachineError as error:
            self._say("fault", Phrase("hold: {error}", error=error.words))

    def note_seen(self) -> None:
        """Note that the mill has answered: the latched order has been carried out."""
        self._tries, self.problem, self.latched = 0, NO_WORDS, ""

    def drop(self, words: Phrase) -> None:
        """Close the link, or note that it is lost."""
        self.setup = Setup()
        self.close()
        self._fail(words)

    def _fail(self, words: Phrase) -> None:
        if words != self.problem:
            self._say("link", words)
        self.problem = words
        self._try_at_s = self._clock() + BACK_OFF_S[min(self._tries, len(BACK_OFF_S) - 1)]
        self._tries += 1

    def close(self) -> None:
        driver, self.driver = self.driver, None
        if driver is not None:
            driver.close()


def get_settings(driver: Driver | None) -> ControllerSettings | None:
    """Return the settings that the controller has reported; None if the link cannot report them."""
    settings = getattr(driver, "settings", None)
    return settings if isinstance(settings, ControllerSettings) else None
