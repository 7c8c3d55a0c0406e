"""A job with its spec and the figures of mill, tools and finishing processes that it was submitted with.

They are looked up once, when a job is submitted, and stored with it: the computer that works on it later may have other
files under the same names, or a later version of them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, cast

from pydantic import TypeAdapter, ValidationError

from cam.posts.dialects import find_unsupported
from cam.posts.post import Coolant, HighPrecision, ProgramSetup
from cam.tools import Tool
from machines.profile import MachineProfile, ProfileError, UnknownProfileError, load_profile
from phrases.phrase import Phrase
from service.errors import FailedError, SpecError
from service.job.spec.finish import find_processes
from service.job.spec.finish_library import Process
from service.job.spec.machine import MachineSpec
from service.job.spec.model import JobSpec
from service.job.spec.section import unknown_name
from service.job.spec.tools import load_tools

LoadProfile = Callable[[str], MachineProfile]
_PROFILE_KEYS = MachineSpec.model_fields.keys() - {"profile"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """Contents of the files that a spec names.

    profile   : of the mill
    tools     : of the shop, if the passes are planned; otherwise none
    processes : finishing processes that the job may use, by name
    """

    profile: MachineProfile
    tools: tuple[Tool, ...] = ()
    processes: Mapping[str, Process]

    def to_text(self) -> str:
        """Return JSON, with Infinity for infinite figures."""
        return json.dumps(asdict(self), separators=(",", ":"))

    @classmethod
    def from_text(cls, text: str) -> Figures:
        """Parse the text; FailedError if another version wrote it."""
        try:
            return _FIGURES.validate_python(json.loads(text))
        except ValidationError as error:
            place = ".".join(map(str, error.errors()[0]["loc"]))
            raise FailedError(
                Phrase("the figures kept with this job are of another version ({place}): submit it again", place=place)
            ) from None


_FIGURES = TypeAdapter(Figures)


@dataclass(frozen=True, kw_only=True)
class ResolvedJob:
    """A spec without gaps, and the figures behind the names in it."""

    spec: JobSpec
    figures: Figures

    @cached_property
    def machine(self) -> MachineProfile:
        """The mill's profile with the job's own figures; SpecError if its control does not support them."""
        spec, own = self.spec, dict[str, Any]()
        for key in _PROFILE_KEYS:
            value = getattr(spec.machine, key)
            if value is not None:
                own[key] = tuple(value) if isinstance(value, list) else value
        if spec.finish.finishes and spec.machine.whole_steps is None:
            own["whole_steps"] = True  # a finish takes off errors that alternate from row to row, not the control's
        machine = replace(self.figures.profile, **own)
        unsupported = find_unsupported(machine.dialect, setup_of(machine))
        if problems := [
            (f"machine.{key}", Phrase("{value} is not allowed; allowed: {allowed}", value=value, allowed=allowed))
            for key, value, allowed in unsupported
        ]:
            raise SpecError(problems)
        return machine

    def with_spec(self, spec: JobSpec) -> ResolvedJob:
        """Return the same figures for another spec that names the same mill, tools and processes."""
        return replace(self, spec=spec)


def look_up(spec: JobSpec, load: LoadProfile = load_profile) -> ResolvedJob:
    """Return the job of a spec with the present figures of this computer's files.

    load : reads a mill's profile
    SpecError: the spec names something that does not exist. InputError: a file of tools or processes has a fault.
    """
    try:
        profile = load(spec.machine.profile)
    except UnknownProfileError as error:
        raise SpecError([("machine.profile", unknown_name(error.name, error.known))]) from None
    except ProfileError as error:
        words = Phrase("'{name}' cannot be used: {cause}", name=spec.machine.profile, cause=str(error))
        raise SpecError([("machine.profile", words)]) from None
    tools = load_tools() if spec.to_be_planned else ()
    return ResolvedJob(
        spec=spec, figures=Figures(profile=profile, tools=tools, processes=find_processes(spec.finish.process))
    )


def setup_of(machine: MachineProfile) -> ProgramSetup:
    """Return what programs for this mill switch on before they cut, and off afterwards."""
    return ProgramSetup(
        coolant=cast(Coolant, machine.coolant),
        work_offset=machine.work_offset,
        blend_tolerance_mm=machine.blend_tolerance_mm,
        high_precision=cast(HighPrecision, machine.high_precision),
        warm_up_s=machine.warm_up_s,
        slowest_rpm=machine.spindle_rpm[0],
        top_z_mm=machine.top_z_mm,
    )
