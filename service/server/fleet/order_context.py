"""The origin of an order or a stop, for its mill's agent."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import quote

from service.http.problems import BY, CONTROL, FROM, GRANT

AT_THE_SERVER = "somebody at the server's computer"  # a caller there without a token


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderContext:
    """Who gives an order, from where, and what it rests on. arrived_s: by `suspend_aware_clock_s`."""

    name: str
    origin: str
    control: str = ""
    grant: str = ""
    arrived_s: float = 0.0

    def headers(self) -> dict[str, str]:
        values = {BY: quote(self.name), FROM: quote(self.origin), CONTROL: self.control, GRANT: self.grant}
        return {name: value for name, value in values.items() if value}
