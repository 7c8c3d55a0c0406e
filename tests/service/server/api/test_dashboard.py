"""The dashboard for Grafana asks for figures that the server exports, by labels that they have."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import promql_parser as promql
import pytest
from prometheus_client.parser import text_string_to_metric_families

from service.server.database.connection import begin_writing
from service.server.database.job_rows import Counter, add_to_counters
from service.server.database.records import JobState, StageState
from tests.service.server.api.server import ApiServer, api_server
from tests.service.server.api.test_health import beat

DASHBOARD = json.loads((Path(__file__).parents[4] / "docs" / "grafana.json").read_text(encoding="utf-8"))
PANELS = {panel["title"]: panel for panel in DASHBOARD["panels"]}


@pytest.fixture(scope="module")
def metrics(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, set[str]]]:
    """Labels of each metric of a server that has worked."""
    with api_server(tmp_path_factory.mktemp("data")) as server:
        beat(server)
        server.put_stage(server.submit()["id"], "image")
        with begin_writing(server.services.database) as connection:
            add_to_counters(connection, {Counter("stage_seconds", "image"): 2.0})
        yield _labels(server)


def _labels(server: ApiServer) -> dict[str, set[str]]:
    families = text_string_to_metric_families(server.client.get("/metrics").text)
    return {sample.name: set(sample.labels) for family in families for sample in family.samples}


@pytest.mark.parametrize("title", PANELS)
def test_a_panel_asks_for_what_there_is(metrics: dict[str, set[str]], title: str) -> None:
    for target in PANELS[title]["targets"]:
        query = promql.parse(target["expr"])
        asked = list(selectors(query))
        assert asked, target
        labels = set[str]()
        for one in asked:
            assert one.name in metrics, one.name
            labels |= metrics[one.name]
            for matcher in one.matchers.matchers:
                assert matcher.name in metrics[one.name], target
                assert matcher.name != "state" or matcher.value in (*StageState, *JobState), target
        named = set(re.findall(r"\{\{(\w+)\}\}", target["legendFormat"]))
        named |= {label for found in re.findall(r"by \(([^)]*)\)", target["expr"]) for label in found.split(", ")}
        assert named <= labels, target


def test_every_figure_of_the_server_has_a_panel(metrics: dict[str, set[str]]) -> None:
    """But those that only say how many results of stages are kept."""
    text = " ".join(target["expr"] for panel in PANELS.values() for target in panel["targets"])
    ours = {
        re.sub("_(bucket|count|sum|total|created)$", "", name) for name in metrics if name.startswith("causticmill")
    }
    assert {name for name in ours if name not in text} == {"causticmill_stage_results"}


def selectors(node: Any) -> Iterator[promql.VectorSelector]:
    """Every metric of a query, wherever it stands in it."""
    if isinstance(node, promql.VectorSelector):
        yield node
        return
    for name in ("expr", "lhs", "rhs", "param", "vector_selector"):
        if (below := getattr(node, name, None)) is not None:
            yield from selectors(below)
    for below in getattr(node, "args", ()) or ():
        yield from selectors(below)
