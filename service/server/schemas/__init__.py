"""The models of requests and answers, which the OpenAPI document describes."""
