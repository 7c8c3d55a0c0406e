"""The command `machines`: list the known mills and their abilities; check their files and ports."""

from __future__ import annotations

import sys
from pathlib import Path

from machines.profile import (
    MachineProfile,
    ProfileError,
    UnknownProfileError,
    find_profiles,
    load_profile,
    profile_names,
    user_folders,
)
from service.errors import EXIT_FAILURE, InputError
from service.wording import align

_BUILT_IN = "built in"
_NOT_SERIAL = ("roland-usb", "none")


def run_machines(name: str | None = None, *, check: bool = False) -> int:
    """Print all machines, or one in full; print problems to stderr. Return 1 if there are problems, otherwise 0."""
    lines, problems = list_machines(check=check, name=name)
    for line in lines:
        print(line)
    for problem in problems:
        print(f"error: {problem}", file=sys.stderr)
    return EXIT_FAILURE if problems else 0


def list_machines(*, check: bool = False, name: str | None = None) -> tuple[list[str], list[str]]:
    """Return (lines to show, problems found). A file that cannot be used is a problem even without `check`."""
    sources = find_profiles()
    if name is not None and name not in sources:
        raise InputError(str(UnknownProfileError(name, tuple(sources))))
    profiles, problems = [], []
    for known in [name] if name else sources:
        try:
            profiles.append(load_profile(known))
        except ProfileError as error:
            problems.append(str(error))
    if check:
        problems += [problem for profile in profiles for problem in _find_port_problems(profile)]
    lines = (
        _describe_profile(profiles[0], sources[profiles[0].name]) if name and profiles else _table(profiles, sources)
    )
    if name is None:
        lines += ["", *_explain_own_machines()]
    if check and not problems:
        lines.append(f"no problem found in {len(profiles)} profile{'s' * (len(profiles) != 1)}")
    return lines, problems


def _table(profiles: list[MachineProfile], sources: dict[str, str]) -> list[str]:
    rows = [("NAME", "DIALECT", "TRAVEL X Y Z (mm)", "LINK", "FROM", "WHAT")]
    for profile in profiles:
        travel = " x ".join(f"{value:g}" for value in profile.travel_mm)
        source = _origin(sources[profile.name])
        if source != _BUILT_IN and profile.name in profile_names(()):
            source += " (in place of the built-in)"
        rows.append((profile.name, profile.dialect, travel, _link(profile), source, profile.description))
    return align(rows)


def _describe_profile(profile: MachineProfile, source: str) -> list[str]:
    link = profile.link
    rows = {
        "name": profile.name,
        "from": source if _origin(source) != _BUILT_IN else _BUILT_IN,
        "what": profile.description,
        "dialect": profile.dialect,
        "travel": _triple(profile.travel_mm, "mm"),
        "fastest": _triple(profile.max_rate_mm_per_min, "mm/min"),
        "acceleration": _triple(profile.acceleration_mm_per_s2, "mm/s2"),
        "smallest step": f"{profile.step_mm:g} mm",
        "planner": f"{profile.planner_blocks} blocks, junction deviation {profile.junction_deviation_mm:g} mm, "
        f"{profile.lines_per_s:g} lines/s",
        "spindle": f"{profile.spindle_rpm[0]:g} to {profile.spindle_rpm[1]:g} rpm",
        "in a hold": profile.spindle.sentences[0],
        "link lost": profile.spindle.sentences[1],
        "safe height": f"{profile.safe_z_mm:g} mm above the stock",
        "homing": "yes" if profile.homing else "no: after a lost position set the work zero again by hand",
        "link": _link(profile),
    }
    if link.driver not in _NOT_SERIAL:
        rows["link"] += f", {link.bytesize}{link.parity}{link.stopbits:g}, handshake {link.flow}"
        rows["buffer"] = f"{link.rx_bytes} bytes" if link.rx_bytes else "read from the controller"
        rows["port"] = link.port or "given with --port"
    return align(list(rows.items()))


def _explain_own_machines() -> list[str]:
    folders = [str(folder) for folder in user_folders()]
    if not folders:
        return ["your own machines: set CAUSTICMILL_CONFIG_DIR and put TOML files into its folder machines/"]
    return [
        f"your own machines: TOML files in {folders[0]}",
        '  e.g. bench.toml: extends = "grbl" / travel_mm = [280, 175, 40] / [link] port = "/dev/serial/by-id/..."',
    ]


def _link(profile: MachineProfile) -> str:
    driver = profile.link.driver
    return driver if driver in _NOT_SERIAL else f"{driver} {profile.link.baud}"


def _origin(source: str) -> str:
    built_in = Path(__file__).parents[2] / "machines" / "profiles"
    return _BUILT_IN if Path(source).parent.resolve() == built_in.resolve() else source


def _triple(values: tuple[float, float, float], unit: str) -> str:
    return " ".join(f"{axis} {value:g}" for axis, value in zip("XYZ", values, strict=True)) + f" {unit}"


def _find_port_problems(profile: MachineProfile) -> list[str]:
    """Return a sentence if the port of the profile does not exist. Ports behind a URL are not tried."""
    port = profile.link.port
    if port is None or "://" in port or profile.link.driver in _NOT_SERIAL or Path(port).exists():
        return []
    return [f"{profile.name}: port {port}: not there; {_list_ports()}"]


def _list_ports() -> str:
    from machines.port import port_names

    names = port_names()
    return f"there are: {', '.join(names)}" if names else "there is no serial port now"
