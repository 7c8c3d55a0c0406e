"""What the routes about pairing and tokens take and answer."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from service.http.schema import Body, Time
from service.milling.api import Person

ScopeWord = Literal["jobs:read", "jobs:write", "machine:run", "admin"]
Scopes = Annotated[list[ScopeWord], BeforeValidator(sorted)]


class WhoamiView(Body):
    name: str
    scopes: Scopes
    anonymous: Annotated[bool, Field(description="without a token, from this computer, where no token was ever made")]
    paired: Annotated[bool, Field(description="with a token that a page got for a code")]
    expires_at: Annotated[Time | None, Field(description="when the token ends; null: never")]


class PairingBody(Body):
    code: Annotated[str, Field(min_length=1, max_length=40, description="as printed", examples=["7K3D-0QXM-91TZ"])]
    name: Person


class PairingView(Body):
    token: Annotated[str, Field(description="shown this once; only its SHA-256 is kept")]
    name: Annotated[str, Field(description="of the token: the name given, or that and a number")]
    scopes: Scopes
    expires_at: Time


class NewTokenBody(Body):
    name: Annotated[str, Field(min_length=1, max_length=80, examples=["shop-floor"])]
    scopes: Annotated[list[ScopeWord], Field(min_length=1, max_length=4, examples=[["jobs:read", "jobs:write"]])]
    expires_in_s: Annotated[float | None, Field(gt=0, le=3.1e9, description="null: never", examples=[2592000])] = None


class TokenView(Body):
    id: str
    name: str
    scopes: Scopes
    created_at: Time
    expires_at: Time | None
    last_used_at: Time | None
    revoked_at: Time | None
    paired: Annotated[bool, Field(description="made by a page, for a code")]


class NewTokenView(TokenView):
    token: Annotated[str, Field(description="shown this once; only its SHA-256 is kept")]


class TokenList(Body):
    tokens: list[TokenView]
