"""Machine profiles: each mill's abilities (travel, speeds, planner, spindle) and its link.

Built-in profiles are machines/profiles/*.toml. A person adds machines as files of the same format in a folder of
their own; such a file may say `extends = "grbl"` and give only what differs. File name and profile name are the same.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Annotated, Any

from machines.driver import Triple
from machines.errors import MachineError
from machines.profile_values import (
    COOLANTS,
    DIALECTS,
    DRIVERS,
    FLOWS,
    HIGH_PRECISION,
    SPINDLE,
    UNITS,
    BadValueError,
    Rules,
    UnreadableFileError,
    cylinders,
    flag,
    names,
    number,
    one_of,
    pair,
    read_data,
    sides,
    text,
    triple,
    whole,
)
from phrases.phrase import Phrase

_MOST_EXTENDS = 8
_BUILT_IN = Path(__file__).with_name("profiles")


class UnknownProfileError(LookupError):
    """No profile has this name; `known` lists those that exist."""

    def __init__(self, name: str, known: tuple[str, ...]) -> None:
        super().__init__(
            Phrase("no machine profile is called '{name}'; known: {known}", name=name, known=", ".join(known))
        )
        self.name = name
        self.known = known


class ProfileError(MachineError):
    """A profile file that cannot be used: the message names file, key, value, what is allowed. key: "" if several."""

    def __init__(self, file: str, text: Phrase, *, key: str = "") -> None:
        super().__init__(Phrase("{file}: {text}", file=file, text=text))
        self.file = file
        self.text = text
        self.key = key


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """How bytes get to the mill.

    driver   : "grbl" (counted characters, ok/error) | "roland-serial" | "roland-usb" | "drip" (XON/XOFF DNC) | "none"
               (programs are copied to the mill's own computer)
    flow     : handshake of the serial line: "none" | "rtscts" | "xonxoff"
    rx_bytes : receive buffer of the controller; None asks the controller ($I)
    port     : where the mill usually is ("/dev/serial/by-id/...", "socket://host:23"); None: given on the command line
    """

    driver: Annotated[str, one_of(*DRIVERS)] = "grbl"
    baud: Annotated[int, whole(300, 12_000_000)] = 115200
    bytesize: Annotated[int, one_of(7, 8)] = 8
    parity: Annotated[str, one_of("N", "E", "O")] = "N"
    stopbits: Annotated[float, one_of(1.0, 1.5, 2.0)] = 1.0
    flow: Annotated[str, one_of(*FLOWS)] = "none"
    rx_bytes: Annotated[int | None, whole(16, 1_000_000)] = None
    port: Annotated[str | None, text(400)] = None

    @property
    def bits_per_byte(self) -> float:
        """On the wire, with start bit, parity and stop bits: 10 for 8N1."""
        return 1 + self.bytesize + (self.parity != "N") + self.stopbits

    @property
    def wire_bytes_per_s(self) -> float:
        return self.baud / self.bits_per_byte


_ON_HOLD = {
    "turns": Phrase("the spindle keeps turning in a hold, however long it lasts, with the tool where it stands"),
    "stops": Phrase("the spindle stops in a hold and starts again before the program goes on"),
    "unknown": Phrase("what the spindle does in a hold is not known for this mill: look before you leave it held"),
}
_ON_LOST_LINK = {
    "turns": Phrase(
        "when this computer or its cable is gone, the mill carries out what it holds, then stands with the "
        "spindle turning until somebody comes (see docs/spindle.md for a watchdog)"
    ),
    "stops": Phrase(
        "when this computer or its cable is gone, something at the mill itself stops the spindle (as its profile "
        "says; try it without a tool)"
    ),
    "unknown": Phrase(
        "what the spindle does when this computer or its cable is gone is not known for this mill: do not leave "
        "it alone"
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SpindleSettings:
    """What the spindle does while nothing is cut; each value is one of SPINDLE. Nothing here stops or starts it.

    on_hold      : while a program is held
    on_lost_link : when the computer, or the cable to it, is gone in the middle of a program
    """

    on_hold: Annotated[str, one_of(*SPINDLE)] = "unknown"
    on_lost_link: Annotated[str, one_of(*SPINDLE)] = "unknown"

    @property
    def sentences(self) -> tuple[Phrase, Phrase]:
        """The same as sentences for a person: in a hold, without a link."""
        return _ON_HOLD[self.on_hold], _ON_LOST_LINK[self.on_lost_link]


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineProfile:
    """One mill. Triples are X, Y, Z.

    dialect                : language of its controller, one of DIALECTS
    travel_mm              : how far each axis goes
    max_rate_mm_per_min    : fastest rate of each axis
    acceleration_mm_per_s2 : acceleration of each axis
    step_mm                : smallest move of an axis
    z_noise_mm             : sigma of the height error from one row, or one entry, to the next
    screw_error_mm         : amplitude of an axis error that repeats with every turn of the screw; None: not known
    screw_lead_mm          : travel of each axis per turn of its screw
    junction_deviation_mm  : GRBL's $11, how far a corner may be rounded in the planner's model
    planner_blocks         : moves the planner looks ahead, as `$I` reports them (GRBL 1.1: 15 of its 16 slots)
    lines_per_s            : blocks the controller can take in a second
    spindle_rpm            : slowest and fastest speed
    safe_z_mm              : height above the stock top at which rapids travel
    collet_mm              : the thickest shank that the spindle takes; None: any
    spindle_w              : its power; None: no limit
    removal_cm3_per_min    : largest removal rate that the frame bears, in rows; None: any
    top_z_mm               : machine Z of the raised head, where programs begin and end; None: machine coordinates mean
                             nothing, and programs begin at safe_z_mm
    bed_to_collet_mm       : from the table to the collet's face, with the head at its top; None: not known
    table_mm               : width and depth of the table, along X and Y; None: not known
    gantry_mm              : from the table to the underside of the gantry; None: the mill has none, or it is not known
    nose_mm                : the turning parts above the tool, from the collet's face up, as cylinders (radius, length):
                             nut, holder; everything above the last is as wide as it
    guesses                : keys among these figures that nobody has confirmed: programs are written only for a
                             top_z_mm that the owner has stated, the setup sheet asks for the others to be measured
    whole_steps            : heights are written in whole steps, chosen so that the light suffers least
    most_program_mb        : a larger program is split; None: never
    most_program_hours     : a longer program is split; None: never
    coolant                : air or fluid while a program cuts, one of COOLANTS
    work_offset            : used by programs, 1 to 6: G54 to G59, Okuma's G15 H1 to H6
    blend_tolerance_mm     : how far the control may round corners; 0: exact stop; None: as programs usually have it
    high_precision         : mode of the control that programs switch on, one of HIGH_PRECISION
    tool_change            : programs change their tool (T, M6) and take its length from the control's table (G43 H)
    one_program            : a job's programs also come as one, which changes tools in between
    optional_stop          : programs stop before the spindle turns, where the control's switch for it is on (M1)
    units                  : of programs, one of UNITS
    number_every           : an N word on every n-th line; None: as the dialect has it
    warm_up_s              : time in which a job's first program brings the spindle up to speed in steps; 0: at once
    trace_outline          : a job's first program goes around block and lens in the air before it cuts
    spindle                : what the spindle does in a hold, and without a link
    homing                 : has switches and a homing cycle, so that a lost position can be found again
    description            : what it is, in words
    """

    name: Annotated[str, text(80)]
    dialect: Annotated[str, one_of(*DIALECTS)]
    travel_mm: Annotated[Triple, triple(1, 100_000, "mm")]
    max_rate_mm_per_min: Annotated[Triple, triple(1, 1_000_000, "mm/min")]
    acceleration_mm_per_s2: Annotated[Triple, triple(0.1, 100_000, "mm/s2")]
    step_mm: Annotated[float, number(1e-6, 1, "mm")]
    junction_deviation_mm: Annotated[float, number(1e-5, 10, "mm")]
    planner_blocks: Annotated[int, whole(2, 100_000)]
    lines_per_s: Annotated[float, number(0.1, 1_000_000)]
    spindle_rpm: Annotated[tuple[float, float], pair(0, 1_000_000, "rpm")]
    safe_z_mm: Annotated[float, number(0, 10_000, "mm")]
    link: LinkSettings = LinkSettings()
    spindle: SpindleSettings = SpindleSettings()
    homing: Annotated[bool, flag()] = False
    collet_mm: Annotated[float | None, number(0.1, 100, "mm")] = None
    spindle_w: Annotated[float | None, number(1, 100_000, "W")] = None
    removal_cm3_per_min: Annotated[float | None, number(0.01, 10_000, "cm3/min")] = None
    top_z_mm: Annotated[float | None, number(-10_000, 10_000, "mm")] = None
    bed_to_collet_mm: Annotated[float | None, number(1, 10_000, "mm")] = None
    table_mm: Annotated[tuple[float, float] | None, sides(1, 100_000, "mm")] = None
    gantry_mm: Annotated[float | None, number(1, 10_000, "mm")] = None
    nose_mm: Annotated[tuple[tuple[float, float], ...], cylinders(0.5, 1000, "mm")] = ()
    guesses: Annotated[tuple[str, ...], names("top_z_mm", "bed_to_collet_mm")] = ()
    z_noise_mm: Annotated[float, number(0, 0.1, "mm")] = 0.0005
    screw_error_mm: Annotated[Triple | None, triple(0, 0.1, "mm")] = None
    screw_lead_mm: Annotated[Triple, triple(0.1, 100, "mm")] = (2.0, 2.0, 2.0)
    whole_steps: Annotated[bool, flag()] = False
    most_program_mb: Annotated[float | None, number(0.1, 1_000_000, "MB")] = None
    most_program_hours: Annotated[float | None, number(0.05, 10_000, "hours")] = None
    coolant: Annotated[str, one_of(*COOLANTS)] = "none"
    work_offset: Annotated[int, whole(1, 6)] = 1
    blend_tolerance_mm: Annotated[float | None, number(0, 1, "mm")] = None
    high_precision: Annotated[str, one_of(*HIGH_PRECISION)] = "none"
    tool_change: Annotated[bool, flag()] = False
    one_program: Annotated[bool, flag()] = False
    optional_stop: Annotated[bool, flag()] = False
    units: Annotated[str, one_of(*UNITS)] = "mm"
    number_every: Annotated[int | None, whole(1, 1000)] = None
    warm_up_s: Annotated[float, number(0, 3600, "s")] = 0.0
    trace_outline: Annotated[bool, flag()] = False
    description: Annotated[str, text(300)] = ""


def replace_figures(figures: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return a profile's figures, overridden by the person's own. Figures that belong to another travel are dropped,
    and no figure of one's own is a guess.
    """
    (*sides_mm, z_mm), (*own_sides_mm, own_z_mm) = (
        one.get("travel_mm", (0.0,) * 3) for one in (figures, {**figures, **own})
    )
    lost = ("table_mm",) * (sides_mm != own_sides_mm) + ("bed_to_collet_mm", "gantry_mm") * (z_mm != own_z_mm)
    guesses = tuple(key for key in figures.get("guesses", ()) if key not in own and key not in lost)
    return {**figures, **dict.fromkeys(lost), "guesses": guesses, **own}


def user_folders(environment: Mapping[str, str] = os.environ) -> tuple[Path, ...]:
    """Return the folders of the person's own profiles: $CAUSTICMILL_CONFIG_DIR, $XDG_CONFIG_HOME/causticmill or
    ~/.config.
    """
    own, shared = environment.get("CAUSTICMILL_CONFIG_DIR"), environment.get("XDG_CONFIG_HOME")
    if own:
        return (Path(own) / "machines",)
    home = environment.get("HOME")
    base = Path(shared) if shared else Path(home) / ".config" if home else None
    return (base / "causticmill" / "machines",) if base else ()


def find_profiles(folders: Sequence[Path] | None = None) -> dict[str, str]:
    """Return the file of each profile by name, sorted; a person's own profile takes the place of a built-in of its
    name.
    """
    found = {path.stem: str(path) for path in _BUILT_IN.glob("*.toml")}
    for folder in reversed(user_folders() if folders is None else folders):
        if folder.is_dir():
            found |= {path.stem: str(path) for path in folder.glob("*.toml")}
    return dict(sorted(found.items()))


def find_own_profiles() -> dict[str, str]:
    """Return the file of each profile that the person has added, by name, sorted."""
    own = {str(folder) for folder in user_folders()}
    return {name: file for name, file in find_profiles().items() if str(Path(file).parent) in own}


def profile_names(folders: Sequence[Path] | None = None) -> tuple[str, ...]:
    """Return names of all profiles, sorted."""
    return tuple(find_profiles(folders))


def load_profile(name: str, folders: Sequence[Path] | None = None) -> MachineProfile:
    """Return the profile called `name`. UnknownProfileError lists the known; ProfileError says what is wrong in
    a file.
    """
    sources = find_profiles(folders)
    if name not in sources:
        raise UnknownProfileError(name, tuple(sources))
    file = sources[name]
    values = _read_values(name, sources, ())
    link, spindle = LinkSettings(**values.pop("link")), SpindleSettings(**values.pop("spindle"))
    required = {field.name for field in fields(MachineProfile) if field.default is MISSING}
    missing = sorted(required - set(values))
    if missing:
        words = Phrase('{keys}: missing; give them, or start from a profile: extends = "grbl"', keys=", ".join(missing))
        raise ProfileError(file, words)
    profile = MachineProfile(**values, link=link, spindle=spindle)
    if profile.safe_z_mm >= profile.travel_mm[2]:
        words = Phrase(
            "safe_z_mm = {safe_z_mm:g}: allowed: less than the travel in Z, {travel_mm:g} mm",
            safe_z_mm=profile.safe_z_mm,
            travel_mm=profile.travel_mm[2],
        )
        raise ProfileError(file, words, key="travel_mm.2")
    if profile.top_z_mm is not None and not profile.homing:
        words = Phrase("top_z_mm = {top_z_mm:g}: allowed: only with homing = true", top_z_mm=profile.top_z_mm)
        raise ProfileError(file, words, key="top_z_mm")
    return profile


def _read_values(name: str, sources: Mapping[str, str], trail: tuple[str, ...]) -> dict[str, Any]:
    """Return checked values of a profile, those of the profile it extends filled in."""
    file = sources[name]
    raw = _read(file)
    try:
        tables = {name: _check_table(name, raw.pop(name, {}), rules) for name, rules in _TABLES.items()}
        extends = raw.pop("extends", None)
        own = {key: _PROFILE.check(key, value, "") for key, value in raw.items()}
        if Path(file).parent == _BUILT_IN and "description" in own:
            own["description"] = Phrase.of_text(own["description"])
        if own.setdefault("name", name) != name:
            raise BadValueError("name", own["name"], Phrase("the name of the file, '{name}'", name=name))
        if extends is None:
            return own | tables
        _require_base(name, extends, sources, trail)
    except BadValueError as error:
        raise ProfileError(file, error.words, key=error.key) from None
    try:
        base = _read_values(extends, sources, (*trail, name))
    except ProfileError as error:
        words = Phrase("extends '{name}', which cannot be used: {why}", name=extends, why=error.words)
        raise ProfileError(file, words) from None
    return replace_figures(base, own) | {name: base[name] | table for name, table in tables.items()}


_PROFILE = Rules.of(MachineProfile)
_TABLES = {"link": Rules.of(LinkSettings), "spindle": Rules.of(SpindleSettings)}


def _check_table(name: str, values: object, rules: Rules) -> dict[str, Any]:
    if not isinstance(values, dict):
        allowed = Phrase("a table: [{name}] and below it {keys}", name=name, keys=", ".join(rules.keys))
        raise BadValueError(name, values, allowed)
    return {key: rules.check(key, value, f"{name}.") for key, value in values.items()}


def _require_base(name: str, extends: object, sources: Mapping[str, str], trail: tuple[str, ...]) -> None:
    """Raise BadValueError if `name` may not extend that profile."""
    chain = (*trail, name)
    others = ", ".join(f"'{other}'" for other in sources if other not in chain)
    if extends in chain:
        way = " -> ".join(f"'{link}'" for link in (*chain[chain.index(str(extends)) :], extends))
        allowed = Phrase("a profile that does not lead back to this one ({way}): {others}", way=way, others=others)
        raise BadValueError("extends", extends, allowed)
    if not isinstance(extends, str) or extends not in sources or len(trail) >= _MOST_EXTENDS:
        raise BadValueError("extends", extends, others)


def _read(file: str) -> dict[str, Any]:
    try:
        return read_data(Path(file))
    except UnreadableFileError as error:
        raise ProfileError(file, error.words) from None
