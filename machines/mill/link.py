"""The link of a mill: opened again with growing patience, and what was asked for while it was away.

Opening a link sends questions and, before them, a hold or an abort that somebody asked for in the meantime: never
anything that can start motion.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from machines.driver import Driver, MillState, MillStatus
from machines.errors import MachineError

BACK_OFF_S = (0.2, 0.5, 1.0, 2.0, 5.0)
AWAY = frozenset({MillState.DISCONNECTED, MillState.CONNECTING})
NO_MILL = MillStatus()


class MillLink:
    """At most one driver. `latched` is "hold" or "abort" while that waits for the link, else ""."""

    def __init__(
        self,
        connect: Callable[[], Driver],
        clock: Callable[[], float],
        pause: Callable[[float], object] | None,
        say: Callable[[str, str], None],
    ) -> None:
        self._connect = connect
        self._clock = clock
        self._pause = pause or self._wait
        self._say = say
        self._woken = threading.Event()
        self._tries = 0
        self._try_at_s = float("-inf")
        self.driver: Driver | None = None
        self.problem = ""
        self.latched = ""

    @property
    def status(self) -> MillStatus:
        return self.driver.status if self.driver is not None else NO_MILL

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
        """Try to open the link, or wait for the next try; whether there is one now."""
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
            self._fail(str(error))
            return False
        self.driver = driver
        if self.latched:
            self.order(self.latched)
        return True

    def order(self, what: str) -> None:
        """Hold or abort now; where the link is away, or refuses, as the first thing when it is back."""
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
                self._say("command", f"{what}: waits for the link")
            self.latched = "abort" if "abort" in (what, self.latched) else what

    def seen(self) -> None:
        """The mill was heard: what was latched has been carried out."""
        self._tries, self.problem, self.latched = 0, "", ""

    def drop(self, words: str) -> None:
        """The link is lost, or given up."""
        driver, self.driver = self.driver, None
        if driver is not None:
            driver.close()
        self._fail(words)

    def _fail(self, words: str) -> None:
        if words != self.problem:
            self._say("link", words)
        self.problem = words
        self._try_at_s = self._clock() + BACK_OFF_S[min(self._tries, len(BACK_OFF_S) - 1)]
        self._tries += 1

    def close(self) -> None:
        driver, self.driver = self.driver, None
        if driver is not None:
            driver.close()
