"""Receives a run as a client of Foxglove's WebSocket protocol, and compares the received data with the recording.

usage: foxglove.py PORT

Uses websocket-client for WebSocket and mcap-ros2-support for messages. Neither of them shares code with the service.
"""

import io
import json
import struct
import sys
import time
import urllib.request

import websocket
from mcap.reader import make_reader
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

port = sys.argv[1]
MESSAGES = 600


def ask(path, body=None):
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(f"http://127.0.0.1:{port}/api/{path}", data, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=60) as answer:
        return answer.read()


def connect(protocol):
    socket = websocket.create_connection(
        f"ws://127.0.0.1:{port}/foxglove", subprotocols=[protocol], suppress_origin=True, timeout=20)
    assert socket.getsubprotocol() == protocol, socket.getsubprotocol()
    # The connection must remain open during the run.
    assert socket.headers["connection"].lower() == "upgrade", socket.headers
    info = json.loads(socket.recv())
    assert (info["op"], info["name"], info["capabilities"]) == ("serverInfo", "ballbard", []), info
    advertised = json.loads(socket.recv())
    assert advertised["op"] == "advertise", advertised
    channels = {channel["topic"]: channel for channel in advertised["channels"]}
    assert all((channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg") for channel in channels.values())
    return socket, channels


def messages(socket, count):
    """The next `count` messages: subscription, log time and bytes of each."""
    for _ in range(count):
        opcode, data = socket.recv_data()
        assert opcode == websocket.ABNF.OPCODE_BINARY and data[0] == 1, (opcode, data[:80])
        yield *struct.unpack_from("<IQ", data, 1), data[13:]


def record(protocol):
    socket, channels = connect(protocol)
    subscribed = {40: "/ballbard/joint_states", 41: "/ballbard/cycle", 42: "/ballbard/event", 43: "/diagnostics"}
    # Most subscriptions are made before the run, one during it.
    of = lambda ids: [{"id": one, "channelId": channels[subscribed[one]]["id"]} for one in ids]
    socket.send(json.dumps({"op": "subscribe", "subscriptions": of([40, 41, 42])}))
    name = protocol.replace(".", "-")
    ask("start", {"name": name, "reason": "a test"})
    shown = list(messages(socket, 20))
    socket.send(json.dumps({"op": "subscribe", "subscriptions": of([43])}))
    ask("mark", {"text": "seen live"})
    shown += messages(socket, MESSAGES)
    socket.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [40, 41, 42, 43]}))
    ask("stop", {"cause": "enough"})
    socket.close()
    # The received bytes must be the same, in the same order, as those of the file. They begin at its start and have no gaps.
    recorded = {}
    reader = make_reader(io.BytesIO(ask(f"runs/{name}/mcap")))
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        recorded.setdefault(channel.topic, []).append((message.log_time, message.data))
        if channel.topic in channels:
            assert schema.data.decode() == channels[channel.topic]["schema"] and schema.name == channels[channel.topic]["schemaName"]
    for one, topic in subscribed.items():
        live = [(log_time, data) for subscription, log_time, data in shown if subscription == one]
        assert live, f"nothing of {topic}"
        first = recorded[topic].index(live[0])
        assert first == 0 or one == 43, f"{topic} begins with number {first}"
        assert recorded[topic][first:first + len(live)] == live, f"{topic} is not what is recorded"
    # Messages are decoded with only the advertised schemas.
    decoded = {}
    for one, topic in subscribed.items():
        channel = channels[topic]
        decode = DecoderFactory().decoder_for(
            "cdr", Schema(id=1, name=channel["schemaName"], encoding="ros2msg", data=channel["schema"].encode()))
        decoded[topic] = [decode(data) for subscription, _, data in shown if subscription == one]
    cycles = [message.cycle for message in decoded["/ballbard/cycle"]]
    assert cycles == list(range(len(cycles))) and len(cycles) > 200, cycles
    joints = decoded["/ballbard/joint_states"]
    assert list(joints[0].name) == [f"bar_joint_{joint}" for joint in range(1, 6)]
    assert joints[0].position[0] != joints[-1].position[0]
    assert any(event.text == "seen live" for event in decoded["/ballbard/event"])
    return len(shown)


counts = [record(protocol) for protocol in ["foxglove.websocket.v1", "foxglove.sdk.v1"]]

# Requests that are invalid, duplicate or not permitted are answered, and the connection remains open.
socket, channels = connect("foxglove.sdk.v1")
for asked, told in [
    ("nonsense", "invalid request"),
    (json.dumps({"op": "advertise", "channels": []}), "nothing else"),
    (json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 0}, {"id": 1, "channelId": 1}]}), "subscription 1"),
]:
    socket.send(asked)
    said = json.loads(socket.recv())
    assert (said["op"], said["level"]) == ("status", 2) and told in said["message"], said
socket.close()

# The number of clients is limited. When a client leaves, another client can connect.
open_ones = [connect("foxglove.sdk.v1")[0] for _ in range(8)]
try:
    connect("foxglove.sdk.v1")
    raise SystemExit("a ninth client was let in")
except websocket.WebSocketBadStatusException as refused:
    assert refused.status_code == 503, refused
for one in open_ones:
    one.close()
for wait in range(50):
    try:
        connect("foxglove.sdk.v1")[0].close()
        break
    except websocket.WebSocketBadStatusException:
        time.sleep(0.1)
else:
    raise SystemExit("no place is free again")
print(f"{counts} messages shown as recorded")
