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


def test_every_json_answer_has_a_schema(document: dict) -> None:
    for method, path, operation in operations(document):
        for status, answer in operation["responses"].items():
            content = answer.get("content", {}).get("application/json") if int(status) < 300 else None
            is_file = path.endswith(("/artifacts/{name}", "/programs/{n}"))  # any JSON
            assert content is None or content["schema"] or is_file, (method, path, status)


def test_what_a_schema_leaves_open_is_described(document: dict) -> None:
    """An object of any keys says nothing by itself: a description says what it holds, or an example shows it."""
    for name, schema in document["components"]["schemas"].items():
        for key, field in schema.get("properties", {}).items():
            for part in filter(is_open, (field, *field.get("anyOf", []))):
                assert {"description", "examples"} & {*field, *part}, (name, key)


def is_open(schema: dict) -> bool:
    return schema.get("type") == "object" and schema.get("additionalProperties") is True


def test_every_example_is_as_its_schema_says(document: dict) -> None:
    found = 0
    for name, schema in document["components"]["schemas"].items():
        for key, field in {"": schema, **schema.get("properties", {})}.items():
            for example in field.get("examples", []):
                wrong = list(Draft202012Validator(field | {"components": document["components"]}).iter_errors(example))
                assert not wrong, (name, key, wrong[0].message)
                found += 1
    assert found > 5


def test_the_document_needs_nothing_from_elsewhere(document: dict) -> None:
    assert "http://" not in json.dumps(document) and "https://" not in json.dumps(document)
