from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from machines.profile import load_profile
from service.job.planning.changes import changes_of
from service.job.spec.loading import resolve_job
from service.job.spec.resolve import ResolvedJob

specs = st.builds(
    lambda preset, width_mm, throw_mm, hours, profile: resolve_job(
        base={
            "preset": preset,
            "optics": {"width_mm": width_mm, "height_mm": width_mm, "throw_mm": throw_mm},
            "plan": {"hours": hours} if preset == "recommended" else {},
            "machine": {"profile": profile, **({"top_z_mm": 400.0} if profile == "okuma-osp" else {})},
        }
    ),
    st.sampled_from(["paper", "recommended", "draft"]),
    st.floats(10, 250),  # with their margin, wider ones do not fit on each of these mills, and are refused
    st.floats(20, 2000),
    st.none() | st.floats(0.5, 20),
    st.sampled_from(["grbl", "okuma-osp", "roland-mdx-40a"]),
)


@given(specs)
def test_each_change_is_a_job_with_those_values_and_is_not_offered_where_it_is_taken(job: ResolvedJob) -> None:
    for change in changes_of(job, 1.234):
        taken = change.apply_to(job)
        told = taken.spec.model_dump()
        for key, value in change.values.items():
            table, _, name = key.rpartition(".")
            assert (told[table] if table else told)[name] == value
        assert taken.spec != job.spec
        if set(change.values) & {"preset", "finish.process", "image.prepare"}:
            assert change.what not in [one.what for one in changes_of(taken, 1.234)]


def test_the_finer_mill_is_the_most_exact_one() -> None:
    offered = [one.values.get("machine.profile") for one in changes_of(resolve_job(), 1.0)]
    (finer,) = [name for name in offered if name]
    own, best = resolve_job().machine, load_profile(finer)
    assert best.z_noise_mm < own.z_noise_mm and best.step_mm < own.step_mm
    assert not [
        one for one in changes_of(resolve_job(base={"machine": {"profile": finer}}), 1.0) if "mill as" in one.what
    ]
