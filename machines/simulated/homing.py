"""The homing cycle: Z up first, then X and Y together; seek, pull off, locate slowly, pull off."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

Triple = tuple[float, float, float]


def plan_homing(machine_mm: Triple, settings: Mapping[int, float]) -> Iterator[tuple[Triple, float]]:
    """Points of the cycle in true machine coordinates with the seconds to get there.

    $23: a bit for each axis that homes to its negative end; $24 locate feed, $25 seek feed, $26 debounce,
    $27 pull-off.
    """
    mask, locate, seek, pull = int(settings[23]), settings[24] / 60, settings[25] / 60, settings[27]
    debounce_s = settings[26] / 1000
    at = list(machine_mm)
    for axes in ((2,), (0, 1)):
        switch = {i: -settings[130 + i] if mask >> i & 1 else 0.0 for i in axes}
        rest = {i: s + pull if mask >> i & 1 else s - pull for i, s in switch.items()}
        for goal, speed in ((switch, seek), (rest, seek), (switch, locate), (rest, seek)):
            way = max(abs(goal[i] - at[i]) for i in axes)
            for i in axes:
                at[i] = goal[i]
            yield (at[0], at[1], at[2]), way / speed + debounce_s
