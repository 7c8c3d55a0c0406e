"""Who answers before the handshake: a controller, nobody, something else, or noise of the wrong baud rate."""

from __future__ import annotations

from machines.grbl.replies import Empty, Garbled, Reply

PLAIN = bytes(range(0x20, 0x7F)) + b"\t\r\n"
# Said where nothing answers any more, or not yet; a person then may send a reset.
SILENT = (
    "nothing answers '?'. After a limit alarm a controller hears nothing but a reset, and while it homes it does not "
    "answer either: look at the mill; where it stands, send a reset"
)
NOISE_SHARE = 0.25  # bytes that are not text: far more at a wrong baud rate, none from a text protocol


class Greeting:
    """Collects what came back to '?'."""

    def __init__(self, *, recognised: bool = False) -> None:
        self.recognised = recognised
        self.banner = False
        self._text = b""  # first bytes heard, for the message
        self._rest = b""
        self._bytes = self._noise = self._garbled = 0

    def heard(self, reply: Reply, line: bytes) -> None:
        self._bytes += len(line)
        self._noise += len(line.translate(None, PLAIN))
        if isinstance(reply, Garbled):
            self._garbled += 1
        if not isinstance(reply, Empty) and not self._text:
            self._text = line[:60]

    def count_unended(self, rest: bytes) -> None:
        """What came after the last line end."""
        self._rest = rest

    @property
    def speaks(self) -> bool:
        """Something has come that is no report: another device, another baud rate."""
        return bool(self._bytes or self._rest) and not self.recognised and not self.banner

    @property
    def words(self) -> str:
        if self.banner:
            return "the controller has started, asking for its state"
        return "asking '?'" if not self.recognised else "waiting for a report"

    def verdict(self) -> str:
        """Why this is not a controller, after patience has run out."""
        heard = self._bytes + len(self._rest)
        noise = self._noise + len(self._rest.translate(None, PLAIN))
        if not heard:
            return (
                "nothing answers '?': is the mill switched on, is this its port, and is the baud rate right "
                "(GRBL: 115200)? After a limit alarm (ALARM:1, ALARM:2) a controller hears nothing but a reset: look "
                "at the mill, then send one"
            )
        if noise > NOISE_SHARE * heard:
            return "answers with noise, not text: wrong baud rate? (GRBL: 115200)"
        shown = (self._text or self._rest[:60]).decode("ascii", "backslashreplace")
        return f"something answers ('{shown}'), but it is not a GRBL controller: is this the right port?"
