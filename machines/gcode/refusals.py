"""Reasons for refusing a line of a program: one sentence each, with the remedy, by number for the compiled kernel."""

from __future__ import annotations

from phrases.phrase import Phrase

CODES = range(1, 53)
(
    NO_LETTER,
    NO_NUMBER,
    OPEN_COMMENT,
    PERCENT,
    DOLLAR,
    BLOCK_DELETE,
    LONG,
    WRONG_G,
    WRONG_M,
    WRONG_LETTER,
    REPEATED,
    GROUP_TWICE,
    AFTER_END,
    BAD_FEED,
    NO_FEED,
    BAD_SPEED,
    BAD_TOOL,
    BAD_N,
    BAD_DWELL,
    DWELL_MOVES,
    NO_MOTION,
    TWO_AXIS_COMMANDS,
    NO_AXES,
    UNUSED_WORD,
    G10_WORDS,
    G43_AXES,
    G53_MOTION,
    ARC_BLIND,
    ARC_NO_PLANE_AXIS,
    ARC_NO_CENTRE,
    ARC_TOO_FAR,
    ARC_RADII_DIFFER,
    ARC_R_WITH_CENTRE,
    ARC_SAME_POINT,
    ARC_HUGE,
    TOOL_CHANGE,
    CYCLE,
    COMPENSATION,
    LENGTH_TABLE,
    ABSOLUTE_ARCS,
    SUBPROGRAM,
    TWO_DIGITS,
    NEEDS_POINT,
    DECIMALS,
    SPINDLE_FIRST,
    G53_RELATIVE,
    OUT_OF_RANGE,
    MISPLACED_PERCENT,
    BAD_NAME,
    OSP_OFFSETS,
    NOT_HERE,
    ARC_BY_R,
) = CODES


def make_reasons(
    *, dialect: str, limit: int, n_limit: int, decimals: int, name_rule: Phrase, dwell_rule: Phrase
) -> dict[int, Phrase]:
    """Return all sentences, by code, for programs of one dialect."""
    return {
        NO_LETTER: Phrase("a word starts with a letter; only G-code words, comments in ( ) and after ; are understood"),
        NO_NUMBER: Phrase("a letter must be followed by a plain decimal number of at most 17 digits"),
        OPEN_COMMENT: Phrase("a comment that opens with ( must close with ) on the same line"),
        PERCENT: Phrase("no % marks in this dialect (GRBL answers error:1); delete the line"),
        DOLLAR: Phrase(
            "no $ lines in a program: settings are commands to an idle mill, file names are set at the control"
        ),
        BLOCK_DELETE: Phrase("block delete (/) would be ignored and the line cut; delete the / or the line"),
        LONG: Phrase(
            "the controller holds at most {limit} characters of code in a line (comments and blanks aside); split it",
            limit=limit,
        ),
        WRONG_G: Phrase("a G word this dialect does not know; delete or translate it"),
        WRONG_M: Phrase("an M word this dialect does not know; delete or translate it"),
        WRONG_LETTER: Phrase("a word whose letter this dialect does not know; delete or translate it"),
        REPEATED: Phrase("the same word is on the line twice"),
        GROUP_TWICE: Phrase("two words of one modal group on the line (such as G0 and G1)"),
        AFTER_END: Phrase("nothing may follow M2, M30 or the closing %"),
        BAD_FEED: Phrase("a feed must be above 0"),
        NO_FEED: Phrase("a cutting move needs a feed: give F above 0 on this line or before (in G93: on this line)"),
        BAD_SPEED: Phrase("a spindle speed must be 0 or more"),
        BAD_TOOL: Phrase("a tool number is a whole number from 0 to 255"),
        BAD_N: Phrase("a line number (N) is a whole number from 0 to {n_limit}", n_limit=n_limit),
        BAD_DWELL: Phrase("G4 needs {dwell_rule}, 0 or more", dwell_rule=dwell_rule),
        DWELL_MOVES: Phrase("G4 must stand alone, without a motion"),
        NO_MOTION: Phrase("coordinates need G0, G1, G2 or G3 on this line or before"),
        TWO_AXIS_COMMANDS: Phrase("two commands on the line claim the coordinates (such as G0 and G92); split it"),
        NO_AXES: Phrase("this command needs coordinates"),
        UNUSED_WORD: Phrase("a word on the line that no command there uses"),
        G10_WORDS: Phrase("G10 needs L2 or L20, a whole P from 0 to 6 and coordinates, without R"),
        G43_AXES: Phrase("G43.1 takes Z and no other coordinate"),
        G53_MOTION: Phrase("G53 needs G0 or G1"),
        ARC_BLIND: Phrase("an arc needs a known start: first go to a point with X, Y and Z in G90"),
        ARC_NO_PLANE_AXIS: Phrase("an arc needs a coordinate in its plane (G17: X Y, G18: Z X, G19: Y Z)"),
        ARC_NO_CENTRE: Phrase("an arc needs I, J, K offsets in its plane, or R"),
        ARC_TOO_FAR: Phrase("the arc's end is farther from its start than 2 R"),
        ARC_RADII_DIFFER: Phrase("start and end are not equally far from the arc's centre (error:33)"),
        ARC_R_WITH_CENTRE: Phrase("an arc takes either R or I, J, K"),
        ARC_SAME_POINT: Phrase("an arc with R must end elsewhere than it starts"),
        ARC_HUGE: Phrase("an arc of more than 50 000 chords (0.002 mm tolerance) is not a real one"),
        TOOL_CHANGE: Phrase("{dialect} has no tool changes here; split the program at this line", dialect=dialect),
        CYCLE: Phrase("{dialect} has no canned cycles here; let the post write single moves", dialect=dialect),
        COMPENSATION: Phrase("no cutter compensation (G41, G42) here; let the post compensate"),
        LENGTH_TABLE: Phrase("{dialect} has no tool table; use G43.1 Z with the length, or none", dialect=dialect),
        ABSOLUTE_ARCS: Phrase("arc centres are relative to the start (G91.1) only"),
        SUBPROGRAM: Phrase("no subprograms or variables here; let the post write single moves"),
        TWO_DIGITS: Phrase("{dialect} takes G and M words with two digits only (G01, not G1)", dialect=dialect),
        NEEDS_POINT: Phrase(
            "{dialect} takes coordinates and feeds with a decimal point only (X8.0, not X8)", dialect=dialect
        ),
        DECIMALS: Phrase("{dialect} takes at most {decimals} decimals", dialect=dialect, decimals=decimals),
        SPINDLE_FIRST: Phrase("{dialect} needs S and M03 before the first cutting move, or it faults", dialect=dialect),
        G53_RELATIVE: Phrase("G53 works in G90 only here"),
        OUT_OF_RANGE: Phrase("the numbers lead to a place more than 100 000 mm away"),
        MISPLACED_PERCENT: Phrase(
            "% must stand alone, on the first and the last line: the control reads nothing after the second one"
        ),
        BAD_NAME: Phrase("a program's name must be {name_rule} here, first on its line", name_rule=name_rule),
        OSP_OFFSETS: Phrase(
            "{dialect} sets the work offset with G15 H, the tool length with G56 H; delete or translate the word",
            dialect=dialect,
        ),
        NOT_HERE: Phrase(
            "{dialect} does not have this word, or means something else by it; delete or translate it", dialect=dialect
        ),
        ARC_BY_R: Phrase("{dialect} takes arcs by I and J only, not by R", dialect=dialect),
    }
