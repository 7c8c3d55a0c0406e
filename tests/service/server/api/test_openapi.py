"""The OpenAPI document: what it says is reviewed as a diff, and it says enough to work with."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

from tests.service.server.api.server import ApiServer

SNAPSHOT = Path(__file__).with_name("openapi.json")
REWRITE = "CAUSTICMILL_REWRITE_GOLDEN"
METHODS = {"get", "head", "post", "put", "patch", "delete"}


@pytest.fixture(scope="module")
def document(server: ApiServer) -> dict:
    return server.client.get("/openapi.json").json()


def operations(document: dict) -> list[tuple[str, str, dict]]:
    return [
        (method, path, operation)
        for path, item in document["paths"].items()
        for method, operation in item.items()
        if method in METHODS
    ]


def test_the_document_is_the_reviewed_one(document: dict) -> None:
    """Set CAUSTICMILL_REWRITE_GOLDEN=1 to write it anew, then read the diff."""
    document["info"]["version"] = "any"
    text = json.dumps(document, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
    if os.environ.get(REWRITE):
        SNAPSHOT.write_text(text, encoding="utf-8")
    assert SNAPSHOT.read_text(encoding="utf-8") == text


def test_every_operation_is_described_and_every_refusal_is_a_problem(document: dict) -> None:
    for method, path, operation in operations(document):
        name = f"{method} {path}"
        assert operation.get("summary") and operation.get("tags"), name
        assert {"400", "403", "404", "405", "422", "429", "503"} <= set(operation["responses"]), name
        for status, told in operation["responses"].items():
            answer = resolved(document, told)
            assert answer.get("description"), f"{name} {status}"
            if int(status) >= 400:
                (kind,) = answer["content"]
                assert kind == "application/problem+json", f"{name} {status}"


def resolved(document: dict, told: dict) -> dict:
    return document["components"]["responses"][told["$ref"].rpartition("/")[2]] if "$ref" in told else told


def test_every_json_answer_has_an_example(document: dict) -> None:
    for method, path, operation in operations(document):
        for status, answer in operation["responses"].items():
            content = answer.get("content", {}).get("application/json") if int(status) < 300 else None
            if content and content["schema"] and method != "head":  # a file of a job may be any JSON
                assert "example" in content or "examples" in content or has_example(document, content["schema"]), path


def test_every_example_is_as_its_schema_says(document: dict) -> None:
    for method, path, operation in operations(document):
        for status, answer in operation["responses"].items():
            content = answer.get("content", {}).get("application/json", {})
            if "example" in content and content["schema"]:
                whole = content["schema"] | {"components": document["components"]}
                wrong = list(Draft202012Validator(whole).iter_errors(content["example"]))
                assert not wrong, (method, path, status, wrong[0].message)


def has_example(document: dict, schema: dict) -> bool:
    name = schema.get("$ref", "").rpartition("/")[2]
    return "examples" in document["components"]["schemas"].get(name, {})


def test_the_document_needs_nothing_from_elsewhere(document: dict) -> None:
    assert "http://" not in json.dumps(document) and "https://" not in json.dumps(document)
