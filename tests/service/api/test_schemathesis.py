"""The served OpenAPI document against the server: no 5xx, no answer that the document does not tell of."""

from __future__ import annotations

import itertools
import os
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from schemathesis import checks
from schemathesis.schemas import APIOperation

from service.jobs.tokens import TokenScope
from tests.service.api.server import ApiServer, api_server, png
from tests.service.api.test_health import beat

EXAMPLES = int(os.environ.get("CAUSTICMILL_FUZZ_EXAMPLES", "12"))  # of each operation
CHECKS = [
    checks.not_a_server_error,
    checks.status_code_conformance,
    checks.content_type_conformance,
    checks.response_headers_conformance,
    checks.response_schema_conformance,
    checks.unsupported_method,
    checks.allow_header_conformance,
    checks.negative_data_rejection,
    checks.ignored_auth,
]


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[ApiServer, dict[str, str], list[str]]]:
    """A server, a token for everything, and two jobs that have something to show."""
    data: Path = tmp_path_factory.mktemp("fuzz") / "data"
    with api_server(data, max_upload_mb=1) as server:
        beat(server, ago_s=-3600)
        ended = [server.submit()["id"] for _ in range(2)]
        for job_id in ended:
            server.put_artifact(job_id, "report.json", b"{}", stage="report")
            server.put_artifact(job_id, "pass-1-rough.nc", b"M2\n", stage="pass-1")
            server.put_stage(job_id, "check")
            server.put_state(job_id, "succeeded", ended_at=1.0)
            server.put_event(job_id, "ended", state="succeeded")
        secret = server.services.tokens.create("fuzz", list(TokenScope))[1]
        yield server, {"Authorization": f"Bearer {secret}"}, ended


def test_the_server_keeps_to_its_document(fuzzed: tuple[ApiServer, dict[str, str], list[str]]) -> None:
    server, headers, ended = fuzzed
    schema = schemathesis.openapi.from_url(f"{server.address}/openapi.json", headers=headers)
    told: list[str] = []
    for found in schema.get_all_operations():
        operation = found.ok()
        try:
            _tried(operation, server, headers, ended)
        except Exception as error:  # each operation is tried, and all that fail are told of
            told.append(f"{operation.label}: {error}")
    assert not told, "\n\n".join(told)
    assert server.client.get("/livez").status_code == 200


def _tried(operation: APIOperation, server: ApiServer, headers: dict[str, str], ended: list[str]) -> None:
    turns = itertools.count()

    @given(operation.as_strategy())
    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate],
    )
    def tried(case: schemathesis.Case) -> None:
        if "/jobs/{id}" in case.path:
            case.path_parameters["id"] = _job_for(next(turns), case, server, headers, ended)
        case.call_and_validate(base_url=server.address, headers=headers, checks=CHECKS, timeout=20)

    tried()


def _job_for(turn: int, case: schemathesis.Case, server: ApiServer, headers: dict[str, str], ended: list[str]) -> str:
    """A job that is there, most of the time: one to look at, or a new one to be changed."""
    if turn % 4 == 3:
        return str(uuid.uuid4())
    if case.method.upper() in ("GET", "HEAD"):
        return ended[turn % 2]
    answer = server.client.post("/v1/jobs", files={"image": png()}, headers=headers)
    return str(answer.json()["id"])
