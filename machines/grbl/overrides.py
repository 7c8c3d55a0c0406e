"""Overrides by realtime bytes: one step of each size per report, because the firmware merges equal bytes."""

from __future__ import annotations

# what -> (place in Ov:, back to 100 %, +10, -10, +1, -1)
_STEPS = {
    "feed": (0, 0x90, 0x91, 0x92, 0x93, 0x94),
    "spindle": (2, 0x99, 0x9A, 0x9B, 0x9C, 0x9D),
}
_RAPID = {100: 0x95, 50: 0x96, 25: 0x97}
PATIENCE_REPORTS = 6  # reports without any change after which a step is sent again
GIVE_UP_S = 15.0


def refusal(what: str, percent: int) -> str:
    """Why this override cannot be set; "" if it can."""
    if what == "rapid":
        return "" if percent in _RAPID else f"rapid override {percent} %: only 25, 50 and 100 exist"
    if what not in _STEPS:
        return f"override '{what}': known are feed, rapid and spindle"
    return "" if 10 <= percent <= 200 else f"{what} override {percent} %: from 10 to 200"


def value_in_report(what: str, overrides: tuple[int, int, int]) -> int:
    """This override in a report's Ov."""
    return overrides[1] if what == "rapid" else overrides[_STEPS[what][0]]


def next_bytes(what: str, now_percent: int, percent: int) -> bytes:
    """Realtime bytes that bring the override nearer: at most one coarse and one fine step. b"" when it is there."""
    if now_percent == percent:
        return b""
    if what == "rapid":
        return bytes([_RAPID[percent]])
    _, back, up10, down10, up1, down1 = _STEPS[what]
    if percent == 100:
        return bytes([back])
    away = percent - now_percent
    coarse, fine = divmod(abs(away), 10)
    out = bytearray()
    if coarse:
        out.append(up10 if away > 0 else down10)
    if fine:
        out.append(up1 if away > 0 else down1)
    return bytes(out)
