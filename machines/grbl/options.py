"""What a program needs that a controller may have been built without, by the letters of its [OPT:]."""

from __future__ import annotations

from machines.grbl.settings import ControllerSettings

MIST = "M"
# Both tell M where M7 is built in; of FluidNC that is not known.
_TELL_MIST = frozenset({"grbl", "grblhal"})


def find_missing_option(settings: ControllerSettings, *, mist_line: int) -> str:
    """Why this controller would refuse a block of the program in the middle of a cut; "" if it would not.

    mist_line : first line with M7, 0 for none. Nothing is said where the controller does not tell its options.
    """
    letters = settings.option_letters
    if not mist_line or letters is None or settings.firmware not in _TELL_MIST or MIST in letters:
        return ""
    return (
        f"line {mist_line}: M7 (mist) is error:20 on this controller: it is built without it ([OPT:{settings.options}] "
        "has no M); take M7 out of the program, or use M8"
    )
