"""The mill behind a real pty and a TCP port."""

from __future__ import annotations

import threading
import time

import pytest
import serial

from machines.simulated import GRBL_11, SimulatedMill, serve_pty, serve_tcp
from service.cli.simulator import run_sim_mill
from tests.waiting import PATIENCE_S, until


def ask(port, text: bytes, last: bytes) -> bytes:
    port.write(text)
    words, end = b"", time.monotonic() + PATIENCE_S
    while last not in words and time.monotonic() < end:
        words += port.read(max(1, port.in_waiting))
    return words


@pytest.mark.parametrize("serve", [serve_pty, serve_tcp])
def test_clients_come_and_go_and_the_mill_goes_on(serve):
    with serve(SimulatedMill(), time_factor=20.0) as endpoint:
        time.sleep(0.1)  # it starts: what is sent meanwhile is lost
        with serial.serial_for_url(endpoint.url, timeout=0.2) as port:
            assert b"ok" in ask(port, b"G1X5F3000\n", b"ok")
        with serial.serial_for_url(endpoint.url, timeout=0.2) as port:
            words = b""
            for _ in range(20):
                words = ask(port, b"?", b">")
                if b"Idle" in words:
                    break
            assert b"MPos:5.000" in words


def test_an_idle_mill_costs_no_cpu_and_a_link_names_it(tmp_path):
    link = tmp_path / "mill"
    with serve_pty(SimulatedMill(), link=link) as endpoint:
        assert endpoint.url == str(link) and link.is_symlink()
        time.sleep(0.7)
        before = time.process_time()
        time.sleep(0.5)
        assert time.process_time() - before < 0.1
    assert not link.exists()


def test_a_pulled_cable_takes_the_device_away_and_brings_it_back(tmp_path):
    link = tmp_path / "mill"
    mill = SimulatedMill()
    with serve_pty(mill, 20.0, link) as endpoint:
        for connected, change in ((False, mill.unplug), (True, mill.replug)):
            with endpoint.lock:
                change()
            until(lambda: link.exists() == connected)  # noqa: B023


def test_the_command_prints_where_to_connect_and_records_the_cut(tmp_path, capsys):
    link, record, stop = tmp_path / "mill", tmp_path / "cut.csv", threading.Event()

    def client():
        until(link.exists)
        with serial.serial_for_url(str(link), timeout=0.2) as port:
            time.sleep(0.2)
            ask(port, b"G1X1Y2Z-0.5F3000\nG4P0\n", b"ok\r\nok")
        stop.set()

    thread = threading.Thread(target=client)
    thread.start()
    run_sim_mill(
        listen="pty", firmware="grbl11", time_factor=20.0, link=link, record=record, faults=(), seed=1, stop=stop
    )
    thread.join()
    assert str(link) in capsys.readouterr().out
    rows = record.read_text().splitlines()
    assert rows[0].startswith("x0,") and rows[1].startswith(
        "0.000000,0.000000,0.000000,1.000000,2.000000,-0.500000,0,3000"
    )


@pytest.mark.parametrize(
    ("change", "word"),
    [({"firmware": "marlin"}, "firmware"), ({"listen": "com1"}, "understood"), ({"faults": ("melt@line=1",)}, "fault"),
     ({"time_factor": 0.0}, "time factor")],
)  # fmt: skip
def test_bad_options_are_one_clear_line(change, word):
    options = {
        "listen": None, "firmware": "grbl11", "time_factor": 1.0, "link": None, "record": None, "faults": (), "seed": 0,
    }  # fmt: skip
    with pytest.raises(ValueError, match=word):
        run_sim_mill(**{**options, **change})


def test_traits_reach_the_client():
    assert GRBL_11.baud == 115200
