"""What a mill says and refuses, for programs: a closed list, beside `Refusal`, `Stop` and `FaultCause`.

A code comes with values and with words. The words are for terminals and for people who read the interface by hand; a
program that speaks to people in its own words has a sentence for each code. A code that is gone stays readable by its
words.
"""

from __future__ import annotations

from enum import StrEnum


class MillCode(StrEnum):
    # Why an order was refused, or what became of it is not known.
    OWNER_ENDED = "owner_ended"  # reason
    OWNER_SILENT = "owner_silent"  # seconds, taken_back
    NO_BLOCK = "no_block"  # text
    MILL_STATE = "mill_state"  # state
    RUN_STATE = "run_state"  # state
    RUN_LIVE = "run_live"
    RUN_UNSTARTED = "run_unstarted"
    TRAVEL = "travel"  # detail: a line for each way in which the program leaves it

    # Why a run is as it is, beside FaultCause (detail, alarm).
    OWNER_LOST = "owner_lost"  # state
    ABORTED = "aborted"
    TAKEN_BACK = "taken_back"

    # Why a mill is as it is.
    LOCKED = "locked"  # alarm
    LOCKED_UNTIL_RESET = "locked_until_reset"  # alarm
    SILENT = "silent"

    # What a person has to do first.
    CONNECT = "connect"  # state
    WAIT = "wait"  # state
    STAND_STILL = "stand still"  # state
    UNLOCK = "unlock"  # alarm
    POSITION = "position"  # doubt
    ZERO = "zero"

    # What has happened.
    ORDER_TAKEN = "order_taken"  # order
    ORDER_REFUSED = "order_refused"  # order, and code, values and words of the refusal
    SETTINGS_READ = "settings_read"
    RUN_PARKED = "run_parked"  # name
    RUN_LEFT = "run_left"  # name, state
    OWNER_FAILED = "owner_failed"  # reason
