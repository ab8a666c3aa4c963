"""Reads recordings with two implementations that are not ours, and prints what they decode, one line of JSON for each.

usage: read_recording.py {mcap|rosbags} FILE ...
"""

import json
import math
import sys
from pathlib import Path


def with_mcap(path):
    """PyPI mcap and mcap-ros2-support: decode by the schemas in the file."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with open(path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            yield channel.topic, message.log_time, decoded


def timing_of(path):
    """How well the loop kept its time: metadata records, which only the first of them reads; the last one counts."""
    from mcap.reader import make_reader

    with open(path, "rb") as stream:
        records = [record for record in make_reader(stream).iter_metadata() if record.name == "ballbard.timing"]
    return json.loads(records[-1].metadata["json"]) if records else None


def with_rosbags(path):
    """PyPI rosbags: an implementation of its own, types taken from the file."""
    from rosbags.highlevel import AnyReader

    with AnyReader([Path(path)]) as reader:
        for connection, log_time, raw in reader.messages():
            yield connection.topic, log_time, reader.deserialize(raw, connection.msgtype)


def content_of(path, reader):
    read = {"mcap": with_mcap, "rosbags": with_rosbags}[reader]
    result = {"cycles": [], "joint_states": [], "events": []}
    for topic, log_time, message in read(path):
        stamp = message.header.stamp
        stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        if topic == "/ballbard/cycle":
            result["cycles"].append({
                "log_time_ns": log_time,
                "stamp_ns": stamp_ns,
                "cycle": message.cycle,
                "dc_time_ns": message.dc_time_ns,
                "working_counter": message.working_counter,
                "flags": message.flags,
                "joints": [encoder.joint for encoder in message.encoders],
                "counts": [encoder.count for encoder in message.encoders],
                "valid": [bool(encoder.valid) for encoder in message.encoders],
            })
        elif topic == "/ballbard/joint_states":
            result["joint_states"].append({
                "stamp_ns": stamp_ns,
                "name": list(message.name),
                # JSON knows no NaN, which stands for a joint without a valid sample.
                "position": [None if math.isnan(value) else float(value) for value in message.position],
            })
        else:
            result["events"].append({"stamp_ns": stamp_ns, "kind": message.kind, "text": message.text})
    if reader == "mcap":
        result["timing"] = timing_of(path)
    return result


def main():
    reader, *paths = sys.argv[1:]
    for path in paths:
        print(json.dumps(content_of(path, reader), allow_nan=False))


if __name__ == "__main__":
    main()
