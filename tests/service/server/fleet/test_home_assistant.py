"""Home Assistant sees the mills through a real broker, moves none of them, and its absence delays nobody."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from paho.mqtt.client import Client, MQTTMessageInfo
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode

from service.server.fleet import home_assistant
from service.server.fleet.home_assistant import HomeAssistant, list_messages, open_client
from service.server.schemas.runs import MachineView
from tests.page.machine_states import MACHINE
from tests.service.mills import Bench
from tests.service.server.api.server import api_server
from tests.service.server.fleet.shop import shop
from tests.service.server.fleet.test_notifications import mill
from tests.waiting import until

MOSQUITTO = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
needs_broker = pytest.mark.skipif(MOSQUITTO is None, reason="no MQTT broker here: mosquitto is not installed")


@dataclass
class Broker:
    """Debian's mosquitto with nothing kept; its log names every packet."""

    folder: Path
    port: int
    process: subprocess.Popen[bytes] | None = None

    @property
    def url(self) -> str:
        return f"mqtt://127.0.0.1:{self.port}"

    @property
    def log(self) -> str:
        return (self.folder / "log").read_text()

    def start(self) -> None:
        assert MOSQUITTO is not None
        (self.folder / "conf").write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous true\npersistence false\nuser root\n"
            f"log_type all\nlog_dest file {self.folder}/log\n"
        )
        self.process = subprocess.Popen([MOSQUITTO, "-c", str(self.folder / "conf")])
        until(lambda: reachable(self.port), what="a broker")

    def stop(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()


@dataclass
class Listener:
    """All that a broker keeps and gets. heard: the last text by topic"""

    client: Client
    heard: dict[str, str] = field(default_factory=dict)


def reachable(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port)):
        return True
    return False


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    (tmp_path / "broker").mkdir()
    found = Broker(tmp_path / "broker", port)
    found.start()
    yield found
    found.stop()


@contextlib.contextmanager
def open_listener(broker: Broker) -> Iterator[Listener]:
    listener = Listener(Client(CallbackAPIVersion.VERSION2))
    client = listener.client
    client.on_connect = lambda *_: client.subscribe("#")
    client.on_message = lambda _client, _data, message: listener.heard.update({message.topic: message.payload.decode()})
    client.connect("127.0.0.1", broker.port)
    client.loop_start()
    yield listener
    client.disconnect()
    client.loop_stop()


@contextlib.contextmanager
def open_publisher(url: str) -> Iterator[HomeAssistant]:
    client = open_client(url)
    yield HomeAssistant(client)
    client.disconnect()
    client.loop_stop()


def shown_until(shown: HomeAssistant, machines: list[MachineView], listener: Listener) -> None:
    """As the server does: again and again, until the broker has it."""
    wanted = dict(list_messages(machines))
    until(lambda: (shown.show(machines), wanted.items() <= listener.heard.items())[1], what="every message")


@needs_broker
def test_a_later_listener_sees_each_mill_and_its_state_and_a_dead_server(broker: Broker) -> None:
    machines = [mill(state="run", run="r"), mill(reachable=False).model_copy(update={"name": "the 2nd/mill"})]
    with open_publisher(broker.url) as shown:
        with open_listener(broker) as listener:
            shown_until(shown, machines, listener)
        with open_listener(broker) as later:
            until(lambda: later.heard == listener.heard, what="what the broker keeps")
            shown._client.socket().shutdown(socket.SHUT_RDWR)  # type: ignore[union-attr]  # no goodbye: a server that died
            until(lambda: later.heard["causticmill/available"] == "offline")
            shown_until(shown, machines[:1], later)  # it is there again; a mill that is gone is taken away
            until(lambda: later.heard["causticmill/the_2nd_mill/state"] == "")
    assert json.loads(listener.heard[f"causticmill/{MACHINE['name']}/state"])["percent"] == 50.0


@needs_broker
def test_a_broker_that_has_lost_everything_gets_it_again(broker: Broker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(home_assistant, "_AGAIN_S", (1, 1))
    machines = [mill()]
    with open_publisher(broker.url) as shown:
        with open_listener(broker) as listener:
            shown_until(shown, machines, listener)
        broker.stop()
        for state in ("run", "held", "alarm") * 20:
            shown.show([mill(state=state)])
        broker.start()
        with open_listener(broker) as listener:
            shown_until(shown, machines, listener)


@needs_broker
@pytest.mark.thorough
def test_a_server_shows_its_mill_and_subscribes_to_nothing(tmp_path: Path, mill: Bench, broker: Broker) -> None:
    with shop(tmp_path / "data", mill, mqtt_url=broker.url) as floor, open_listener(broker) as listener:
        topic = "causticmill/shop/state"
        until(lambda: json.loads(listener.heard.get(topic, "{}")).get("state") == "idle", what="an idle mill")
        run = floor.park(floor.job((40,)))
        until(lambda: json.loads(listener.heard[topic])["program"] == run["program"]["name"])
    clients = set(re.findall(r"Received (PUBLISH|SUBSCRIBE) from (\S+)", broker.log))
    publishers = {name for packet, name in clients if packet == "PUBLISH"}
    assert publishers and publishers.isdisjoint(name for packet, name in clients if packet == "SUBSCRIBE")


@given(
    st.lists(
        st.tuples(st.booleans(), st.sampled_from(["idle", "run", "alarm"]), st.sampled_from([None, "r"])), max_size=4
    )
)
def test_what_home_assistant_is_told_fits_together(looks: list[tuple[bool, str, str | None]]) -> None:
    """Each entity has an identity of its own and a template of what is in the state that it names."""
    machines = [mill(*look).model_copy(update={"name": f"mill {number}"}) for number, look in enumerate(looks)]
    messages = dict(list_messages(machines))
    found = [json.loads(text) for topic, text in messages.items() if topic.endswith("/config")]
    assert len({one["unique_id"] for one in found}) == len(found) == 6 * len(machines)
    for one in found:
        key = re.fullmatch(r"\{\{ value_json\.(\w+) \}\}", one["value_template"])
        assert key is not None and key[1] in json.loads(messages[one["state_topic"]])
        assert messages[one["availability_topic"]] == "online"
        assert not any("command" in name for name in one)  # nothing to switch or press


class _Stuck:
    """A client whose broker takes a connection, and then `takes` of the messages; the link breaks as `lost` is sent."""

    def __init__(self, takes: int, lost: int) -> None:
        self.takes, self.lost, self.sent, self.queued = takes, lost, 0, 0

    def is_connected(self) -> bool:
        return True

    def publish(self, topic: str, _text: str, *, retain: bool) -> MQTTMessageInfo:
        assert retain
        info, self.sent = MQTTMessageInfo(self.sent), self.sent + 1
        info.rc = MQTTErrorCode.MQTT_ERR_NO_CONN if self.sent == self.lost else MQTTErrorCode.MQTT_ERR_SUCCESS
        self.queued += not info.rc
        if self.queued <= self.takes:
            info._set_as_published()
        return info


@given(
    takes=st.integers(0, 12),
    lost=st.integers(0, 12),
    states=st.lists(st.sampled_from(["idle", "run", "alarm"]), max_size=30),
)
def test_a_stuck_broker_has_one_state_of_the_mills_waiting_at_most(takes: int, lost: int, states: list[str]) -> None:
    client = _Stuck(takes, lost)
    shown = HomeAssistant(client)  # type: ignore[arg-type]
    for state in states:
        shown.show([mill(state=state)])
    assert client.queued <= takes + len(dict(list_messages([mill()])))


@pytest.mark.parametrize("kind", ["nobody", "silent", "deaf"])
def test_a_broker_that_is_away_or_stuck_stops_no_server(tmp_path: Path, kind: str) -> None:
    """nobody: the port is closed. silent: it accepts and says nothing. deaf: it greets, and reads no more."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port, held = listener.getsockname()[1], list[socket.socket]()
        if kind == "nobody":
            listener.close()
        else:
            threading.Thread(target=_hold, args=(listener, held, kind == "deaf"), daemon=True).start()
        with api_server(tmp_path / "data", mqtt_url=f"mqtt://127.0.0.1:{port}") as server:
            if kind != "nobody":
                until(lambda: held, what="a server that reaches for the broker")
            for _ in range(20):
                assert server.client.get("/livez").status_code == 200
                assert server.client.get("/v1/machines").status_code == 200
        for one in held:
            one.close()


def _hold(listener: socket.socket, held: list[socket.socket], greets: bool) -> None:
    with contextlib.suppress(OSError):
        while True:
            connection, _ = listener.accept()
            held.append(connection)
            if greets:
                connection.recv(1)
                connection.sendall(b"\x20\x02\x00\x00")  # CONNACK


def test_without_the_library_the_server_says_so_and_serves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "paho.mqtt.client", None)
    with api_server(tmp_path / "data", mqtt_url="mqtt://127.0.0.1:1") as server:
        assert server.client.get("/livez").status_code == 200
