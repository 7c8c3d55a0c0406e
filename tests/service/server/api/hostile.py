"""Uploads that nobody should send, as the bytes of whole HTTP requests: the same ones for the same seed.

Pictures that cannot be used are in `test_pictures`, specs in `test_jobs` and `test_untrusted_cost`.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass

from PIL import Image

from tests.service.server.api.server import encoded

_BOUNDARY = "frontier"


@dataclass(frozen=True, slots=True)
class Attack:
    """`cut`: the client closes its side in the middle, so there may be nobody to answer."""

    name: str
    request: bytes
    cut: bool = False


def attacks(count: int, *, seed: int, max_upload: int) -> list[Attack]:
    """At least one of every kind; the rest at random."""
    rng = random.Random(seed)
    kinds: list[Callable[[random.Random, int], Attack]] = [
        truncated_form, broken_off, wrong_length, wrong_type, noise, flipped_form, odd_boundary, odd_part,
        too_many_parts, huge_headers, path_name, too_large, chunked_garbage, bad_framing, odd_http,
    ]  # fmt: skip
    return [kinds[number % len(kinds)](rng, max_upload) for number in range(count)]


def request(body: bytes, *headers: str, content_type: str | None = None, length: int | None = None) -> bytes:
    kind = f"multipart/form-data; boundary={_BOUNDARY}" if content_type is None else content_type
    lines = [
        "POST /v1/jobs HTTP/1.1",
        "Host: localhost",
        f"Content-Type: {kind}",
        f"Content-Length: {len(body) if length is None else length}",
        "Connection: close",
        *headers,
    ]
    return "\r\n".join(lines).encode("latin-1") + b"\r\n\r\n" + body


def part(content: bytes, name: str = "image", *, filename: str | None = "a.png", headers: bytes = b"") -> bytes:
    shown = "" if filename is None else f'; filename="{filename}"'
    disposition = f'Content-Disposition: form-data; name="{name}"{shown}\r\n'.encode(errors="surrogateescape")
    return f"--{_BOUNDARY}\r\n".encode() + disposition + headers + b"\r\n" + content + b"\r\n"


def form(*parts: bytes) -> bytes:
    return b"".join(parts) + f"--{_BOUNDARY}--\r\n".encode()


def picture(rng: random.Random, kind: str = "PNG") -> bytes:
    side = rng.randrange(20, 60)
    return encoded(Image.frombytes("L", (side, side), rng.randbytes(side * side)), kind)


def truncated_form(rng: random.Random, _: int) -> Attack:
    whole = form(part(picture(rng)))
    return Attack("truncated form", request(whole[: rng.randrange(len(whole) - 6)]))


def broken_off(rng: random.Random, _: int) -> Attack:
    whole = request(form(part(picture(rng))))
    return Attack("broken off", whole[: rng.randrange(1, len(whole) - 6)], cut=True)


def wrong_length(rng: random.Random, _: int) -> Attack:
    body = form(part(picture(rng)))
    length = rng.choice([len(body) - rng.randrange(8, 200), 0, 1, len(body) + rng.randrange(1, 10_000)])
    return Attack(f"wrong length {length - len(body)}", request(body, length=length), cut=length > len(body))


def wrong_type(rng: random.Random, _: int) -> Attack:
    contents = [
        b"",
        b"hello",
        b'{"a": 1}',
        b"<svg xmlns='http://www.w3.org/2000/svg'/>",
        b"\0" * 500,
        b"%!PS-Adobe-3.0\n",
    ]
    kind = rng.choice(
        [None, None, "application/json", "text/plain", "image/png", "application/x-www-form-urlencoded", ""]
    )
    return Attack(f"wrong type {kind}", request(form(part(rng.choice(contents))), content_type=kind))


def noise(rng: random.Random, _: int) -> Attack:
    return Attack("noise", request(form(part(rng.randbytes(rng.randrange(1, 5000))))))


def flipped_form(rng: random.Random, _: int) -> Attack:
    """Bytes of the frame changed: the picture's own part is no picture, so nothing may get through."""
    body = bytearray(form(part(b"no picture", filename="a.png"), part(b"{}", "spec", filename=None)))
    for _number in range(rng.randrange(1, 6)):
        body[rng.randrange(len(body))] = rng.randrange(256)
    return Attack("flipped form", request(bytes(body)))


def odd_boundary(rng: random.Random, _: int) -> Attack:
    kinds = [
        "multipart/form-data",
        "multipart/form-data; boundary=",
        "multipart/form-data; boundary=other",
        f"multipart/form-data; boundary={'b' * 300}",
        'multipart/form-data; boundary="',
        "multipart/mixed; boundary=frontier",
        "multipart/form-data; boundary*=utf-8''frontier",
        "multipart/form-data;;;=;=",
        "multipart/form-data; boundary=\xff\xfe",
    ]
    kind = rng.choice(kinds)
    return Attack(f"boundary {kind[:60]!r}", request(form(part(picture(rng))), content_type=kind))


def odd_part(rng: random.Random, _: int) -> Attack:
    good = picture(rng)
    bodies = [
        form(part(good), part(good)),
        form(part(good), part(b"x", "other")),
        form(part(good, name="")),
        form(part(b"{}", "spec", filename=None)),
        form(part(good, headers=b"Content-Transfer-Encoding: base64\r\n")),
        form(f"--{_BOUNDARY}\r\n\r\n".encode() + good + b"\r\n"),
        form(f"--{_BOUNDARY}\r\nContent-Disposition: attachment; name=image\r\n\r\n".encode() + good + b"\r\n"),
        form(part(good), part(b"now", "priority", filename=None)),
        form(part(good), part(b"x" * 1_100_000, "spec", filename=None)),
        form(part(good, name="image\0")),
        form(part(form(part(good)), headers=b"Content-Type: multipart/mixed; boundary=frontier\r\n")),
        form(),
        b"",
        b"\r\n" * 1000,
        b"--" * 5000,
    ]
    number = rng.randrange(len(bodies))
    return Attack(f"odd part {number}", request(bodies[number]))


def too_many_parts(rng: random.Random, _: int) -> Attack:
    parts = [
        part(b"", rng.choice(["image", "spec", f"p{number}"]), filename=None)
        for number in range(rng.randrange(9, 3000))
    ]
    return Attack("too many parts", request(form(*parts)))


def huge_headers(rng: random.Random, _: int) -> Attack:
    body = form(part(picture(rng)))
    long = rng.choice([9_000, 40_000, 200_000])
    choices = [
        request(body, *[f"X-{number}: {'v' * 50}" for number in range(150)]),
        request(body, f"X-Long: {'v' * max(long, 40_000)}"),
        request(form(part(picture(rng), filename="n" * long))),
        request(form(part(picture(rng), headers=b"X: " + b"v" * long + b"\r\n"))),
        request(form(part(picture(rng), headers=b"".join(b"X%d: v\r\n" % number for number in range(200))))),
        request(body, f"Idempotency-Key: {'k' * 201}"),
        request(body, "Idempotency-Key: a", "Idempotency-Key: b"),
        request(body, "Host: evil.example"),
    ]
    number = rng.randrange(len(choices))
    return Attack(f"huge headers {number}", choices[number])


def path_name(rng: random.Random, _: int) -> Attack:
    """Names that would be somewhere else; the content is no picture, so they must leave nothing anywhere."""
    names = [
        "../../../etc/passwd", "..\\..\\windows\\win.ini", "/etc/shadow", "C:\\a.png", "a\0b.png", "\u202egnp.exe",
        "con.png", ".", "..", "~root/.ssh/id", "%2e%2e%2fx", "a" * 1500, "$(id).png", "`id`", "-rf", "\x1b[2J.png",
    ]  # fmt: skip
    return Attack("path name", request(form(part(b"no picture", filename=rng.choice(names)))))


def too_large(rng: random.Random, max_upload: int) -> Attack:
    content = bytes(max_upload + rng.choice([1, 1000, 1_500_000]))
    if rng.random() < 0.3:
        return Attack("declared too large", request(b"", length=10 ** rng.randrange(8, 30)))
    return Attack("too large", request(form(part(content))))


def chunked(*pieces: bytes) -> bytes:
    head = "\r\n".join(
        [
            "POST /v1/jobs HTTP/1.1",
            "Host: localhost",
            f"Content-Type: multipart/form-data; boundary={_BOUNDARY}",
            "Transfer-Encoding: chunked",
            "Connection: close",
        ]
    )
    return head.encode() + b"\r\n\r\n" + b"".join(pieces)


def piece(data: bytes) -> bytes:
    return b"%x\r\n" % len(data) + data + b"\r\n"


def chunked_garbage(rng: random.Random, max_upload: int) -> Attack:
    body = form(part(picture(rng)))
    choices = [
        (chunked(b"zz\r\n" + body), False),
        (chunked(b"ffffffffffffffffffffff\r\n" + body), True),
        (chunked(b"-5\r\n" + body + b"\r\n0\r\n\r\n"), False),
        (chunked(piece(body[:100]), b"0\r\n\r\n"), False),
        (chunked(piece(body[:200])), True),
        (chunked(piece(body)[:-2] + b"XX"), True),
        (chunked(*[piece(body[:50] + bytes(60_000)) for _ in range(max_upload // 60_000 + 40)], b"0\r\n\r\n"), False),
        (chunked(piece(rng.randbytes(300)), b"0\r\n\r\n"), False),
    ]
    number = rng.randrange(len(choices))
    return Attack(f"chunked {number}", *choices[number])


def bad_framing(rng: random.Random, _: int) -> Attack:
    """Lengths that two servers could read differently."""
    body = form(part(picture(rng)))
    plain = request(body)
    choices = [
        plain.replace(b"Content-Length:", b"Transfer-Encoding: chunked\r\nContent-Length:"),
        plain.replace(b"Content-Length:", b"Content-Length: 5\r\nContent-Length:"),
        plain.replace(b"Content-Length: ", b"Content-Length: -"),
        plain.replace(b"Content-Length: ", b"Content-Length: +"),
        plain.replace(b"Content-Length: ", b"Content-Length: 0x"),
        plain.replace(b"Content-Length:", b"Transfer-Encoding: gzip\r\nX:"),
        plain.replace(b"Content-Length:", b"Content-Length : 3\r\nX:"),
        plain.replace(b"Connection: close", b" folded\r\nConnection: close"),
    ]
    number = rng.randrange(len(choices))
    return Attack(f"framing {number}", choices[number])


def odd_http(rng: random.Random, _: int) -> Attack:
    choices = [
        b"POST /v1/jobs\r\n\r\n",
        b"POST /v1/jobs HTTP/9.9\r\nHost: localhost\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + rng.randbytes(200) + b"\r\n\r\n",
        b"POST /v1/jobs HTTP/1.1\r\n\r\n",
        b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\nContent-Length: 0\r\n\r\n",
        b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nBad Header: 1\r\n\r\n",
        b"P\xffST /v1/jobs HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"POST /v1/jobs\0 HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        b"POST /" + b"a" * 100_000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
    ]
    number = rng.randrange(len(choices))
    return Attack(f"odd http {number}", choices[number])
