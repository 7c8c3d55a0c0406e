"""One table of phases."""

from __future__ import annotations

from machines.grbl.states import FROM_EVERYWHERE, MOVES, Phase, may_move


def test_every_phase_is_in_the_table_and_can_be_left_and_reached() -> None:
    assert set(MOVES) == set(Phase)
    reached = set().union(*MOVES.values()) | FROM_EVERYWHERE
    assert reached == set(Phase)


def test_a_program_starts_only_from_ready_and_a_stop_ends_in_a_reset_or_a_new_epoch() -> None:
    assert [phase for phase in Phase if may_move(phase, Phase.STREAMING)] == [Phase.READY]
    assert MOVES[Phase.STOPPING] == {Phase.CLEARING}
