"""A job's mill in the form that time estimates use; a separate module, because planning stages needs no arrays."""

from __future__ import annotations

from cam.duration import Kinematics
from cam.posts.dialects import POSTS
from cam.posts.post import Digits
from machines.profile import MachineProfile


def kinematics_of(machine: MachineProfile) -> Kinematics:
    return Kinematics(
        max_rate_mm_per_min=machine.max_rate_mm_per_min,
        acceleration_mm_per_s2=machine.acceleration_mm_per_s2,
        junction_deviation_mm=machine.junction_deviation_mm,
        planner_blocks=machine.planner_blocks + 1,  # slots: the one that is always free is not reported
        lines_per_s=machine.lines_per_s,
    )


def digits_of(machine: MachineProfile) -> Digits:
    """Return the resolution of the mill's dialect, or whole steps if programs are to use them."""
    return POSTS[machine.dialect].digits.coarsen(machine.step_mm if machine.whole_steps else 0.0)
