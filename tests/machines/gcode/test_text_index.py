"""Index of programs that are no G-code: the same lines whatever the chunks and pieces, each piece verified."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.driver import ProgramLine
from machines.errors import ProgramChangedError, ProgramRefusedError
from machines.gcode.modal import ModalState
from machines.gcode.program import LONGEST_LINE, ProgramReader, TextIndex

LINES = st.lists(st.sampled_from(["V10;Z1,2,3;", "Z-5,0,0;", "", "  ", "\tW100; ", "!MC1;"]), max_size=60)
JOB = b"".join(b"Z%d,%d,-50;\r\n" % (n, 2 * n) for n in range(2000))


def indexed(text: bytes, chunk: int, piece: int) -> TextIndex:
    index = TextIndex("rml-1", piece_bytes=piece)
    assert b"".join(index.cut_into_pieces(text[at : at + chunk] for at in range(0, len(text), chunk))) == text
    return index


@settings(max_examples=60, deadline=None)
@given(
    lines=LINES, end=st.sampled_from(["\n", "\r\n"]), last=st.sampled_from(["", "\n", "\x1a", "\r\n\x1a\x00"]),
    chunk=st.integers(1, 70), piece=st.integers(20, 400), start=st.integers(1, 70),
)  # fmt: skip
def test_the_lines_do_not_depend_on_chunks_and_pieces(
    tmp_path_factory: pytest.TempPathFactory, lines: list[str], end: str, last: str, chunk: int, piece: int, start: int
) -> None:
    """Every block once, with its number and place in the file; marks at the end of a tape are no block."""
    text = (end.join(lines) + last).encode()
    path = tmp_path_factory.mktemp("index") / "p.rml"
    path.write_bytes(text)
    index = indexed(text, chunk, piece)
    found = list(ProgramReader(path, index.index).lines())
    assert [(line.number, line.text.decode()) for line in found] == [
        (n, line.strip()) for n, line in enumerate(lines, 1) if line.strip()
    ]
    assert all(text[line.offset :].lstrip().startswith(line.text) for line in found)
    assert (index.blocks, index.index.bytes) == (len(found), len(text))
    assert index.index.lines == len(text.removesuffix(b"\n").split(b"\n")) - (not text)
    assert list(ProgramReader(path, index.index).lines(start)) == [line for line in found if line.number >= start]


def test_a_changed_piece_is_not_handed_out_and_the_pieces_before_it_are(tmp_path: Path) -> None:
    path = tmp_path / "p.rml"
    path.write_bytes(JOB.replace(b"Z1500,", b"Z1501,"))
    index = indexed(JOB, 1 << 16, 4096).index
    assert len(index.entries) > 5
    reader, taken = ProgramReader(path, index), list[ProgramLine]()
    with pytest.raises(ProgramChangedError, match="changed on disk since pre-flight"):
        for line in reader.lines():
            taken.append(line)
    assert 1000 < len(taken) <= 1500
    assert b"".join(line.text + b"\r\n" for line in taken) == JOB[: sum(len(line.text) + 2 for line in taken)]
    assert reader.state_before(900) == ModalState()


@pytest.mark.parametrize("piece", [600, 1 << 18])
def test_a_line_too_long_to_be_fed_is_refused_with_its_number(piece: int) -> None:
    ok, long = b"V1;" * (LONGEST_LINE // 3), b"V1;" * (LONGEST_LINE // 3 + 1)
    assert indexed(b"V1;\n" + ok + b"\nV2;", 64, piece).blocks == 3
    with pytest.raises(ProgramRefusedError, match="more than 500 bytes; put a line end") as caught:
        indexed(b"V1;\n" + ok + b"\n" + long + b"\n", 64, piece)
    assert caught.value.line == 3
