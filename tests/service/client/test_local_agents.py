"""A stop goes to the mill's agent on this computer where no server answers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.service.client.shop import run
from tests.service.server.fleet.rogue import as_json, rogue_agent

NOBODY = "http://127.0.0.1:9"


@pytest.mark.parametrize("verb", ["hold", "abort"])
def test_a_stop_finds_the_agent_where_there_is_no_server(tmp_path: Path, verb: str) -> None:
    """The one that has the run, of several; without any, a person is sent to the mill."""
    with rogue_agent("other") as other, rogue_agent("shop-mill") as agent:
        agent.answers = lambda _method, path: as_json({}, 202) if path == f"/v1/runs/abc:{verb}" else (404, {}, b"{}")
        for name, rogue in (("other", other), ("shop-mill", agent)):
            folder = tmp_path / "data" / "agents" / name
            folder.mkdir(parents=True)
            (folder / "token").write_text("x" * 40)
            (folder / "token").chmod(0o600)
            card = {"machine": name, "url": rogue.url, "pid": 1, "started_s": 0.0, "version": "0"}
            (folder / "agent.json").write_text(json.dumps(card | {"token_file": str(folder / "token")}))
        own = {"CAUSTICMILL_DATA": str(tmp_path / "data"), "XDG_STATE_HOME": str(tmp_path / "state")}
        done = run("runs", verb, "abc", server=NOBODY, **own)
        assert done.returncode == 0 and "accepted by the agent of shop-mill" in done.stdout, done.stderr
        assert ("POST", f"/v1/runs/abc:{verb}") in agent.asked
        done = run("runs", verb, "unknown", server=NOBODY, **own)
        assert done.returncode == 1 and "use the mill's own stop" in done.stderr
