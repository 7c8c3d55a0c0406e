"""`causticmill stream` as a person meets it: in a process of its own, on terminal or pipe, with a simulated mill."""

from __future__ import annotations

import os
import pty
import resource
import select
import signal
import socket
import subprocess
import sys
import threading
import tty
from collections.abc import Callable
from pathlib import Path

import pytest

from service.cli.main import run
from tests.service.milling.agent.process import memory_mb
from tests.service.mills import Bench, bench, ends, program
from tests.service.terminal import ROOT, Terminal
from tests.waiting import PATIENCE_S, until

LONG = 2000  # lines: minutes at the slow factor, so that a run never ends before the keys come


@pytest.fixture(autouse=True)
def own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path / "config"))


def piped(*arguments: str, **settings: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "service.cli.main", "stream", *arguments],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **({"stdin": subprocess.DEVNULL} | settings),  # type: ignore[call-overload]
    )


def ended(process: subprocess.Popen[str]) -> tuple[int, list[str], list[str]]:
    out, errors = process.communicate(timeout=PATIENCE_S)
    return process.returncode, out.splitlines(), errors.splitlines()


def until_it_runs(process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    next(line for line in process.stdout if line.startswith("run"))


def abort(path: Path, mill: Bench) -> None:
    """A run that its person aborts."""
    with Terminal("stream", str(path), "--port", mill.url, "--yes") as person:
        person.sees("RUN")
        person.types("qa")
        assert person.ends() == 130


@pytest.mark.thorough
def test_without_a_terminal_yes_is_the_order_and_every_line_is_cut(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", 200)
    with bench(50.0) as mill:
        code, out, errors = ended(piped(str(path), "--port", mill.url, "--yes"))
        assert (code, errors) == (0, []), out
        assert mill.cut == ends(200)
    text = "\n".join(out)
    assert all(word in text for word in ("mill:", "position:", "protection:", "program:", "extents:", "finished")), text
    assert "\x1b" not in text


@pytest.mark.parametrize("silent", ["</dev/null", "| tee"])
@pytest.mark.parametrize("more", [[], ["--recover"], ["--recover", "--yes"], ["--recover", "--confirm-position"]])
def test_silence_confirms_nothing(tmp_path: Path, silent: str, more: list[str]) -> None:
    """Without a terminal on both sides nobody is asked, and nothing is sent, not even a question."""
    path = program(tmp_path / "p.nc", 20)
    far, near = pty.openpty()
    try:
        arguments = [str(path), "--port", os.ttyname(near), *more]
        process = piped(*arguments, **({"stdin": near} if silent == "| tee" else {}))
        code, out, (error,) = ended(process)
        assert (code, out) == (2, [])
        assert all(words in error for words in ("no terminal", "says in your name"))
        checks = ("tool is in", "zero is set", "stock is clamped", "in the way")
        assert all((words in error) is ("--yes" not in more) for words in checks), error
        assert ("position is right" in error) is (more == ["--recover"] or more == ["--recover", "--yes"]), error
        assert select.select([far], [], [], 0.0)[0] == [], "something was sent"
    finally:
        os.close(far)
        os.close(near)


@pytest.mark.parametrize("ignored", [(), (signal.SIGINT,), (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)])
def test_how_a_run_without_keys_is_stopped_comes_first_and_is_true(
    tmp_path: Path, ignored: tuple[signal.Signals, ...]
) -> None:
    """A shell ignores SIGINT for what it starts in the background."""
    path = program(tmp_path / "p.nc", 5)

    def ignore() -> None:
        for number in ignored:
            signal.signal(number, signal.SIG_IGN)

    with bench(50.0) as mill:
        process = piped(str(path), "--port", mill.url, "--yes", preexec_fn=ignore)
        code, out, errors = ended(process)
        assert (code, errors) == (0, [])
    first = out[0]
    assert first.startswith("to stop:")
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        assert (f"kill -{number.name[3:]} {process.pid}" in first) is (number not in ignored), first
    assert ("Ctrl-C" in first) is (signal.SIGINT not in ignored)
    assert "emergency stop" in out[1]


def test_a_person_confirms_each_check_before_anything_moves(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", 20)
    with bench(20.0) as mill:
        with Terminal("stream", str(path), "--port", mill.url) as person:
            person.sees("tool is in the spindle")
            person.types("y\n")
            person.sees("zero is set")
            person.types("\n")
            assert person.ends() == 2
            assert "not confirmed (zero)" in person.text
        assert mill.cut == []
        with Terminal("stream", str(path), "--port", mill.url) as person:
            for words in ("tool is in", "zero is set", "stock is clamped", "in the way"):
                person.sees(words)
                person.types("y\n")
            person.sees("finished")
            assert person.ends() == 0
        assert mill.cut == ends(20)


def test_a_frame_is_asked_for_and_cuts_nothing_before_the_questions_of_the_start(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", 20)
    with bench(20.0) as mill:
        with Terminal("stream", str(path), "--port", mill.url, "--frame") as person:
            person.sees("zero is set")
            person.types("y\n")
            person.sees("nothing is in the way")
            assert not mill.mill.recording.segments
            person.types("y\n")
            person.sees("Frame of p.nc: done")
            person.sees("tool is in the spindle")
            person.types("n\n")
            assert person.ends() == 2
        jogs = [one for one in mill.mill.recording.segments if one.kind == "jog"]
        assert mill.cut == [] and len(jogs) >= 4
        assert {round(one.end[2], 3) for one in jogs} == {5.0}


def test_a_dry_pass_is_the_program_in_the_air_with_the_spindle_off(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", 20)
    with bench(20.0) as mill:
        code, out, errors = ended(piped(str(path), "--port", mill.url, "--yes", "--dry-pass", "20"))
        assert (code, errors) == (0, [])
        assert not any("warning" in line and "spindle" in line for line in out)
        assert [(x, y, z - 20.0) for x, y, z in mill.cut] == ends(20)
        assert not any(one.spindle_on for one in mill.mill.recording.segments)


@pytest.mark.thorough
def test_keys_hold_resume_and_override(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", 400)
    with bench(4.0) as mill, Terminal("stream", str(path), "--port", mill.url, "--yes") as person:
        person.sees("RUN")
        person.types("h")
        person.sees("HELD")
        cut = len(mill.cut)
        assert mill.stands
        person.types("+++")
        person.sees("feed 130 %")
        assert len(mill.cut) == cut
        person.types("r")
        person.sees("RUN")
        person.types("ay")
        person.sees("aborted")
        assert person.ends() == 130
        assert "--recover" in person.text


def test_a_ctrl_c_held_down_leaves_the_mill_held_and_no_words_unsaid(tmp_path: Path) -> None:
    """The key repeats while the command holds, aborts and ends; how far apart counts: test_keys."""
    path = program(tmp_path / "p.nc", LONG)
    with bench(4.0) as mill, Terminal("stream", str(path), "--port", mill.url, "--yes") as person:
        person.sees("RUN")
        until(lambda: len(mill.cut) > 3)
        person.types("\x03\x03\x03")
        person.sees("HELD")
        assert "Aborting" not in person.text
        person.sees("Ctrl-C again: abort")
        until(lambda: person.is_gone_after("\x03", 0.033))
        assert person.ends() == 130
        said = " ".join(person.text.split())
        assert all(words in said for words in ("the mill is left", "spindle", "to go on:", "--recover")), said[-800:]


def test_ctrl_c_holds_asks_and_resumes(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", 100)
    with bench(10.0) as mill:
        with Terminal("stream", str(path), "--port", mill.url, "--yes") as person:
            person.sees("RUN")
            person.ctrl_c()
            person.sees("HELD")
            person.sees("resume   a abort")
            person.types("r")
            person.sees("finished")
            assert person.ends() == 0
        assert mill.cut == ends(100)


def test_ctrl_c_twice_aborts_from_hold_with_the_position_kept(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", LONG)
    with bench(4.0) as mill, Terminal("stream", str(path), "--port", mill.url, "--yes") as person:
        person.sees("RUN")
        person.ctrl_c()
        person.sees("Ctrl-C again: abort")
        person.ctrl_c()
        assert person.ends() == 130
        assert mill.stands
        assert not any(segment.kind == "slip" for segment in mill.mill.recording.segments)
        assert f"causticmill stream {path} --port {mill.url} --recover" in person.text.replace("\n", "")


@pytest.mark.thorough
def test_left_held_the_mill_stands_and_the_way_on_is_named(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", LONG)
    with bench(4.0) as mill, Terminal("stream", str(path), "--port", mill.url, "--yes") as person:
        person.sees("RUN")
        person.sees("spindle 1000")
        person.types("q")
        person.sees("HELD")
        person.types("l")
        assert person.ends() == 130
        assert mill.stands
        assert all(words in person.text for words in ("left", "held", "spindle ON", "--recover")), person.text


@pytest.mark.thorough
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_without_a_terminal_a_signal_holds_aborts_and_ends_with_130(tmp_path: Path, number: signal.Signals) -> None:
    path = program(tmp_path / "p.nc", LONG)
    with bench(4.0) as mill:
        process = piped(str(path), "--port", mill.url, "--yes")
        until_it_runs(process)
        process.send_signal(number)
        code, _, errors = ended(process)
        assert code == 130, "\n".join(errors[-12:])
        assert mill.stands
        assert not any(segment.kind == "slip" for segment in mill.mill.recording.segments)
        assert any("--recover" in line for line in errors), errors


def test_a_terminal_that_goes_away_stops_the_mill(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", LONG)
    with bench(4.0) as mill, Terminal("stream", str(path), "--port", mill.url, "--yes") as person:
        person.sees("RUN")
        person.hangs_up()
        assert person.process.wait(PATIENCE_S) != 0
        assert mill.stands


@pytest.mark.thorough
def test_an_aborted_run_goes_on_after_a_person_says_so_and_nothing_is_skipped(tmp_path: Path) -> None:
    path, lines = program(tmp_path / "p.nc", 60), 60
    with bench(4.0) as mill:
        abort(path, mill)
        before = len(mill.cut)
        code, _, errors = ended(piped(str(path), "--port", mill.url, "--recover", "--yes"))
        assert (code, len(errors)) == (2, 1)
        assert "--confirm-position" in errors[0]
        assert len(mill.cut) == before
        with Terminal("stream", str(path), "--port", mill.url, "--recover", "--yes") as person:
            person.sees("has not lost its count")  # reset from standstill, it stands where the other process left it
            person.sees("position is right")  # --yes has answered the others
            person.types("y\n")
            person.sees("finished")
            assert person.ends() == 0
            assert not any(asked in person.text for asked in ("tool is in", "t trust", "first:"))
        assert set(ends(lines)) <= set(mill.cut)
        assert mill.cut[-1] == ends(lines)[-1]


@pytest.mark.thorough
def test_a_dry_run_moves_nothing_and_finds_what_the_controller_refuses(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", 50)
    with bench(10.0) as mill:
        code, out, errors = ended(piped(str(path), "--port", mill.url, "--dry-run"))
        assert (code, errors) == (0, []), out
        assert mill.cut == []


@pytest.mark.thorough
def test_a_dry_run_that_is_interrupted_leaves_check_mode(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", 20_000)
    with bench(10.0) as mill:
        process = piped(str(path), "--port", mill.url, "--dry-run")
        until(lambda: mill.mill.firmware.state == "Check", what="check mode")
        process.send_signal(signal.SIGINT)
        assert ended(process)[0] != 0
        assert mill.mill.firmware.state == "Idle"
        assert mill.cut == []


def test_a_fault_ends_in_its_cause_the_line_the_state_and_the_next_command(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", LONG)
    with bench(4.0) as mill:
        process = piped(str(path), "--port", mill.url, "--yes")
        until_it_runs(process)
        mill.mill.press("reset")
        code, _, errors = ended(process)
        assert code == 1
        text = "\n".join(errors)
        assert all(words in text for words in ("line", "the mill is left", "--recover")), text
        assert "Traceback" not in text


# -- what cannot work: one clear line, the mill untouched ------------------------------------------------------------
def refused(code: int, *arguments: str) -> str:
    got, _, errors = ended(piped(*arguments))
    assert got == code, errors
    assert len(errors) == 1, errors
    return errors[0]


def refusal_here(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """In this process: what is refused before a mill is asked for."""
    assert run(["stream", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_a_port_that_is_not_there(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", 5)
    assert "/dev/nowhere" in refused(2, str(path), "--port", "/dev/nowhere", "--yes")


def test_a_tcp_port_where_nobody_listens(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", 5)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"socket://127.0.0.1:{free.getsockname()[1]}"
        assert url in refused(2, str(path), "--port", url, "--yes")


@pytest.mark.thorough
def test_a_port_that_another_process_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    short, long = program(tmp_path / "p.nc", 5), program(tmp_path / "long.nc", LONG)
    with bench(4.0) as mill, Terminal("stream", str(long), "--port", mill.url, "--yes") as person:
        person.sees("RUN")
        before = len(mill.cut)
        assert "owns this mill" in refused(2, str(short), "--port", mill.url, "--yes")
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other"))
        assert mill.url in refused(2, str(short), "--port", mill.url, "--yes")
        person.sees("RUN")
        assert len(mill.cut) >= before
        person.types("ay")
        assert person.ends() == 130


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        pytest.param(lambda data: b"", "nothing answers", id="silent"),
        *(
            pytest.param(*case, id=name, marks=pytest.mark.thorough)  # the words themselves: tests/machines/grbl
            for name, case in {
                "echo": (lambda data: data, "not a GRBL controller"),
                "printer": (lambda data: b"start\r\nMarlin 2.1.2\r\n", "Marlin"),
                "noise": (lambda data: bytes(0x80 | byte * 37 & 0x7F for byte in data * 5), "wrong baud"),
            }.items()
        ),
    ],
)
def test_what_is_behind_the_port_is_no_grbl(tmp_path: Path, answer: Callable[[bytes], bytes], words: str) -> None:
    """One line says which; nothing but the harmless '?' is sent to a machine that is not known."""
    path = program(tmp_path / "p.nc", 5)
    far, near = pty.openpty()
    tty.setraw(near)
    sent, ended_ = bytearray(), threading.Event()

    def behave() -> None:
        while not ended_.is_set():
            if select.select([far], [], [], 0.05)[0]:
                data = os.read(far, 4096)
                sent.extend(data)
                os.write(far, answer(data))

    behaving = threading.Thread(target=behave)
    behaving.start()
    try:
        for more in (["--yes"], ["--dry-run"]) if "GRBL" in words else (["--yes"],):  # each waits its six seconds
            line = refused(2, str(path), "--port", os.ttyname(near), *more)
            assert words in line
            assert line.count(os.ttyname(near)) == 1, line
        assert set(sent) == {ord("?")}
    finally:
        ended_.set()
        behaving.join()
        os.close(near)
        os.close(far)


@pytest.mark.thorough
def test_what_is_no_program_file_is_refused_before_anything_is_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(tmp_path / "pipe.nc")
    assert "pipe" in refusal_here(capsys, str(tmp_path / "pipe.nc"), "--port", "/dev/x")
    assert "folder" in refusal_here(capsys, str(tmp_path), "--port", "/dev/x")


@pytest.mark.thorough
@pytest.mark.parametrize("content", [b"", b"\n(only words)\n"])
def test_what_holds_nothing_to_send(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "p.nc"
    path.write_bytes(content)
    with bench(10.0) as mill:
        assert refused(2, str(path), "--port", mill.url, "--yes")
        assert mill.cut == []


@pytest.mark.thorough
def test_a_run_under_nohup_outlives_its_terminal(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", 60)
    with bench(4.0) as mill:
        process = piped(
            str(path), "--port", mill.url, "--yes", preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)
        )
        until_it_runs(process)
        process.send_signal(signal.SIGHUP)
        code, _, errors = ended(process)
        assert (code, errors) == (0, [])
        assert mill.cut == ends(60)


@pytest.mark.thorough
def test_something_that_is_not_a_controller(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", 5)
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"socket://127.0.0.1:{server.getsockname()[1]}"
        chatter = threading.Thread(target=_talks, args=(server,), daemon=True)
        chatter.start()
        assert url in refused(2, str(path), "--port", url, "--yes")


def _talks(server: socket.socket) -> None:
    connection, _ = server.accept()
    with connection:
        connection.sendall(b"SSH-2.0-OpenSSH_9.6\r\n")
        while connection.recv(4096):
            connection.sendall(b"Protocol mismatch.\r\n")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["/nowhere.nc", "--port", "/dev/x"], "/nowhere.nc"),
        (["p.nc"], "--port"),
        (["p.nc", "--port", "/dev/x", "--machine", "haas"], "haas"),
        (["p.nc", "--port", "/dev/x", "--recover", "--dry-run"], "--dry-run"),
        (["p.nc", "--port", "/dev/x", "--confirm-position"], "--recover"),
        (["p.nc", "--port", "/dev/x", "--recover"], "--confirm-position"),
        (["p.nc", "--port", "/dev/x", "--recover", "--confirm-position", "--yes", "--frame"], "--frame"),
        (["p.nc", "--port", "/dev/x", "--yes", "--dry-pass", "0"], "1 to 200"),
        (["p.nc", "--port", "/dev/x", "--recover", "--dry-pass", "9"], "--dry-pass"),
    ],
)
def test_options_that_cannot_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    path = program(tmp_path / "p.nc", 5)
    assert words in refusal_here(capsys, *(str(path) if word == "p.nc" else word for word in arguments))


@pytest.mark.thorough
def test_a_program_that_the_mill_must_not_be_sent(tmp_path: Path) -> None:
    path = tmp_path / "bad.nc"
    path.write_text("G21 G90\nG1 X1 F100\nT1 M6\nM2\n")
    with bench(10.0) as mill:
        assert "line 3" in refused(2, str(path), "--port", mill.url, "--yes")
        assert mill.cut == []


@pytest.mark.thorough
def test_no_recovery_of_a_program_that_has_changed_since(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", 60)
    with bench(4.0) as mill:
        abort(path, mill)
        program(path, 61)
        assert "as it is now" in refused(2, str(path), "--port", mill.url, "--recover", "--yes", "--confirm-position")


@pytest.mark.thorough
def test_a_disk_that_is_full_for_the_journal_holds_the_mill_and_says_so(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", LONG)
    with bench(4.0) as mill:
        process = piped(str(path), "--port", mill.url, "--yes")
        until_it_runs(process)
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (64, 64))  # no file may grow any more
        code, _, errors = ended(process)
        text = "\n".join(errors)
        assert code == 1, text
        assert mill.stands
        assert all(words in text for words in ("held because", "the mill is left", "--recover")), text
        assert "Traceback" not in text


@pytest.mark.thorough
def test_the_streaming_process_stays_small(tmp_path: Path) -> None:
    """No numpy, numba or matplotlib in it, and less than 60 MB (pydantic comes with typer)."""
    path = program(tmp_path / "p.nc", 1000, step_mm=0.05)
    script = (
        "import sys; from service.cli.main import run; code = run(sys.argv[1:]);"
        "heavy = {'numpy', 'numba', 'scipy', 'matplotlib'} & set(sys.modules);"
        "print('heavy:', sorted(heavy)); sys.exit(code)"
    )
    with bench(20.0) as mill:
        process = subprocess.Popen(
            [sys.executable, "-c", script, "stream", str(path), "--port", mill.url, "--yes"],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        most, said = 0.0, ""
        for line in process.stdout:
            most, said = max(most, memory_mb(process.pid)), said + line
        assert process.wait(PATIENCE_S) == 0, said
        assert "heavy: []" in said
        assert 10 < most < 60
