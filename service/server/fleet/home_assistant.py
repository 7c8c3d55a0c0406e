"""Shows the mills in Home Assistant by MQTT discovery, read-only. Needs the extra `mqtt`.

Only retained messages go out and nothing is subscribed to, so that no message can move a mill. paho's own thread talks
to the broker; the event loop hands it at most one state of the mills, and no other before the broker has taken it: a
broker that is away, slow or stuck delays nothing. The server sends nothing when it ends: the broker then publishes its
will, "offline".
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

import structlog

from service.errors import InputError, printable
from service.server.fleet.fleet import Fleet
from service.server.fleet.notifications import LOOK_S, trouble_of
from service.server.schemas.runs import MachineView

if TYPE_CHECKING:
    from paho.mqtt.client import Client, MQTTMessageInfo

_DISCOVERY, _TOPIC = "homeassistant", "causticmill"
_AGAIN_S = (2, 120)  # least and most between tries to reach the broker
_ENTITIES: dict[str, tuple[str, dict[str, Any]]] = {
    "state": ("sensor", {"name": "State", "icon": "mdi:state-machine"}),
    "program": ("sensor", {"name": "Program", "icon": "mdi:file-document-outline"}),
    "percent": ("sensor", {"name": "Progress", "unit_of_measurement": "%", "icon": "mdi:progress-wrench"}),
    "left_min": ("sensor", {"name": "Time left", "unit_of_measurement": "min", "device_class": "duration"}),
    "hand": ("binary_sensor", {"name": "Needs a hand", "device_class": "problem"}),
    "connected": ("binary_sensor", {"name": "Connected", "device_class": "connectivity"}),
}
"""By the key of a mill's state: platform and discovery of the entity."""
_log = structlog.get_logger("api")


class HomeAssistant:
    """Publishes what has changed since the last state that the broker took. For one thread; nothing here waits."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._shown: dict[str, str | None] = {}  # by topic, also of mills that are gone; None: to be published again
        self._pending: list[MQTTMessageInfo] = []
        self._is_new = True
        client.on_connect = self._on_connect
        client.on_disconnect = lambda _client, _data, _flags, reason, _more: _log.warning(
            "the MQTT broker is gone", reason=printable(str(reason))[:200]
        )

    def _on_connect(self, _client: Client, _data: object, _flags: object, reason: Any, _more: object) -> None:
        """Called by paho's thread: everything is published once more, as the broker may have lost it."""
        if reason.is_failure:
            _log.warning("the MQTT broker refuses the server", reason=printable(str(reason))[:200])
        self._is_new = not reason.is_failure

    def show(self, machines: Iterable[MachineView]) -> None:
        """Publish the changes, unless the broker is away or has not taken the ones before."""
        if not self._client.is_connected():
            return
        if self._is_new:
            self._is_new, self._shown, self._pending = False, dict.fromkeys(self._shown), []
        if not all(one.is_published() for one in self._pending):
            return
        wanted = dict.fromkeys(self._shown, "") | dict(list_messages(machines))  # an empty message takes an entity away
        changed = [(topic, text) for topic, text in wanted.items() if self._shown.get(topic) != text]
        sent = [self._client.publish(topic, text, retain=True) for topic, text in changed]
        self._pending = [one for one in sent if not one.rc]  # the others met a link that had just broken: see _is_new
        self._shown = dict(wanted)


def list_messages(machines: Iterable[MachineView]) -> Iterator[tuple[str, str]]:
    """Yield topic and text of everything that Home Assistant should know: discovery first, then the states."""
    yield f"{_TOPIC}/available", "online"
    for machine in machines:
        name = re.sub(r"[^a-zA-Z0-9_-]", "_", machine.name)
        topic, profile = f"{_TOPIC}/{name}/state", machine.profile or {}
        device = {
            "identifiers": [f"{_TOPIC}_{name}"],
            "name": machine.name,
            "manufacturer": "causticmill",
            "model": str(profile.get("description") or "mill")[:100],
        }
        for key, (platform, look) in _ENTITIES.items():
            found = {
                "unique_id": f"{_TOPIC}_{name}_{key}",
                "state_topic": topic,
                "availability_topic": f"{_TOPIC}/available",
                "value_template": f"{{{{ value_json.{key} }}}}",
                "device": device,
            }
            yield f"{_DISCOVERY}/{platform}/{_TOPIC}_{name}/{key}/config", json.dumps(look | found)
        yield topic, json.dumps(_state_of(machine))


def _state_of(machine: MachineView) -> dict[str, Any]:
    """Return the values of the entities; None is shown as unknown."""
    run, mill = machine.run, machine.mill or {}
    left_s = None if run is None else run.time_left_s
    return {
        "state": str(mill.get("state") or "unreachable"),
        "program": "" if run is None else run.program if run.lift_mm is None else f"{run.program} (dry pass)",
        "percent": None if run is None else round(100 * run.share, 1),
        "left_min": None if left_s is None else round(left_s / 60),
        "hand": "ON" if trouble_of(machine) else "OFF",
        "connected": "ON" if machine.agent.reachable and mill.get("connected") else "OFF",
    }


def open_client(url: str) -> Client:
    """Return a client that connects to the broker in its own thread; InputError without the library.

    url : mqtt(s)://user:password@host:port
    """
    try:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion
    except ImportError:
        raise InputError("CAUSTICMILL_MQTT_URL needs the extra mqtt: pip install 'causticmill[mqtt]'") from None
    address = urlsplit(url)
    client = Client(CallbackAPIVersion.VERSION2)
    if address.username:
        client.username_pw_set(unquote(address.username), unquote(address.password or ""))
    if address.scheme == "mqtts":
        client.tls_set()
    client.will_set(f"{_TOPIC}/available", "offline", retain=True)
    client.reconnect_delay_set(*_AGAIN_S)
    client.connect_async(address.hostname or "localhost", address.port or (8883 if address.scheme == "mqtts" else 1883))
    client.loop_start()
    return client


async def show_mills(fleet: Fleet, url: str) -> None:
    """Publish the mills' states until the server ends. A failed query is skipped."""
    try:
        shown = HomeAssistant(open_client(url))
    except InputError as error:
        _log.error("no mills for Home Assistant", error=str(error))
        return
    while True:
        try:
            shown.show((await fleet.list_machines()).machines)
        except Exception as error:  # the database is away, or an agent sent invalid data
            _log.warning("mills were not shown", error=printable(str(error))[:200])
        if await fleet.await_end(LOOK_S):
            return
