"""The served OpenAPI document against the server: no 5xx, no answer that the document does not tell of."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from schemathesis import checks
from schemathesis.schemas import APIOperation

from service.server.database.tokens import TokenScope
from tests.service.mills import bench
from tests.service.server.api.server import png
from tests.service.server.api.test_health import beat
from tests.service.server.fleet.shop import MACHINE, Shop, kill_agents, own_folders, shop, write_profile
from tests.waiting import PATIENCE_S

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


@dataclass
class Fuzzed:
    """A shop, a token for everything, two jobs that have something to show, and a run that is over."""

    floor: Shop
    headers: dict[str, str]
    ended: list[str]
    over: str
    turns: Iterator[int] = field(default_factory=itertools.count)

    def placed(self, case: schemathesis.Case) -> None:
        """Most of the time ask for something that is there: to look at, or new, to be changed."""
        turn = next(self.turns)
        if case.path == "/v1/machines/{machine}/events":  # of a machine that is there it has no end
            case.path_parameters["machine"] = "nowhere"
            return
        if turn % 4 == 3:
            return
        looks = case.method.upper() in ("GET", "HEAD")
        if "/jobs/{id}" in case.path:
            case.path_parameters["id"] = self.ended[turn % 2] if looks else self._new_job()
        elif "/runs/{id}" in case.path:
            case.path_parameters["id"] = self.over if case.path.endswith("/events") else self._open_run()
        elif "{machine}" in case.path:
            case.path_parameters["machine"] = MACHINE
            if isinstance(case.body, dict) and "job" in case.body:
                case.body["job"] = self.ended[0]
            if turn % 3 and case.headers is not None and case.path.startswith("/v1/machines/{machine}/control/"):
                case.headers["Causticmill-Control"] = self._control()

    def _new_job(self) -> str:
        posted = self.floor.server.client.post("/v1/jobs", files={"image": png()}, headers=self.headers)
        return str(posted.json()["id"])

    def _control(self) -> str:
        path, body = f"/v1/machines/{MACHINE}/control", {"operator": "Fuzz", "take_over": True}
        return str(self.floor.server.client.post(path, json=body, headers=self.headers).json()["control"])

    def _open_run(self) -> str:
        taken = self.floor.get(f"/v1/machines/{MACHINE}")["run"]
        self.floor.operator.headers["Causticmill-Control"] = self._control()
        return str(taken["id"] if taken else self.floor.park(self.ended[0], program=1)["id"])


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fuzzed]:
    folder: Path = tmp_path_factory.mktemp("fuzz")
    with pytest.MonkeyPatch.context() as patch, bench(8.0) as mill:
        own_folders(patch, folder)
        write_profile(mill.url)
        try:
            with shop(folder / "data", mill, max_upload_mb=1) as floor:
                beat(floor.server, ago_s=-3600)
                ended = [floor.job((6, 4)) for _ in range(2)]
                for job_id in ended:
                    floor.server.put_artifact(job_id, "report.json", b"{}", stage="report")
                    floor.server.put_event(job_id, "ended", state="succeeded")
                over = floor.park(ended[0])["id"]
                floor.post(f"/v1/runs/{over}:abort", 202)
                yield Fuzzed(floor, {"Authorization": f"Bearer {floor.token(*TokenScope)}"}, ended, over)
        finally:
            kill_agents(folder)


@pytest.mark.thorough
def test_the_server_keeps_to_its_document(fuzzed: Fuzzed) -> None:
    address = fuzzed.floor.server.address
    schema = schemathesis.openapi.from_url(f"{address}/openapi.json", headers=fuzzed.headers)
    told: list[str] = []
    for found in schema.get_all_operations():
        operation = found.ok()
        try:
            _tried(operation, fuzzed)
        except Exception as error:  # each operation is tried, and all that fail are told of
            told.append(f"{operation.label}: {error}")
    assert not told, "\n\n".join(told)
    assert fuzzed.floor.server.client.get("/livez").status_code == 200


def _tried(operation: APIOperation, fuzzed: Fuzzed) -> None:
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
        fuzzed.placed(case)
        address = fuzzed.floor.server.address
        case.call_and_validate(base_url=address, headers=fuzzed.headers, checks=CHECKS, timeout=PATIENCE_S)

    tried()
