"""What the stub tells a page has the form of what a server tells, where the API's document leaves that open."""

from __future__ import annotations

from typing import Any

from tests.page import canned_job
from tests.page.canned_job import shape
from tests.page.machine_states import MACHINE
from tests.page.shop import Shop
from tests.service.job.page_data.paths import split_header


def test_the_canned_job_has_the_form_of_a_real_one(shop: Shop) -> None:
    job, files = shop.told()
    told = canned_job.job()
    for key in ("timings_s", "warnings", "warnings_by_part", "phrases"):  # of these there may be any
        job["report"].pop(key), told["report"].pop(key, None)
    assert shape(job["report"]) == shape(told["report"])
    assert shape(job["spec"]) == shape(told["spec"])
    assert [one["name"] for one in job["stages"]] == [one["name"] for one in told["stages"]]
    assert [kinds(one) for one in files] == [kinds(one) for one in canned_job.artifacts()]
    with shop.client() as client:
        for name in ("surface.bin", "pass-2.path"):
            content = client.get(f"/v1/jobs/{shop.job()}/artifacts/{name}").content
            assert shape(split_header(content)[0]) == shape(split_header(canned_job.files()[name])[0]), name


def test_the_canned_mill_has_the_form_of_a_real_one(shop: Shop) -> None:
    real = shop.machine()
    for part in ("mill", "profile"):
        assert set(MACHINE[part]) == set(real[part]), part


def kinds(file: dict[str, Any]) -> tuple[str, ...]:
    return file["name"], file["stage"], file["media_type"]
