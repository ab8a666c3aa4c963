"""Reads recordings with two implementations that are independent of this project, and prints one line of JSON for each file.

usage: read_recording.py {mcap|rosbags} FILE ...
"""

import json
import math
import sys
from pathlib import Path


def with_mcap(path):
    """Messages of the file, decoded by PyPI mcap and mcap-ros2-support with the schemas in the file."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with open(path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            yield channel.topic, message.log_time, decoded


def beside_messages(path):
    """Metadata records and attachments. Only PyPI mcap reads these, rosbags does not."""
    from mcap.reader import make_reader

    with open(path, "rb") as stream:
        records = list(make_reader(stream).iter_metadata())
    timing = [record for record in records if record.name == "ballbard.timing"]
    with open(path, "rb") as stream:
        attachments = {one.name: one.data.decode() for one in make_reader(stream, validate_crcs=True).iter_attachments()}
    return {
        # Deadline statistics of the loop. Only the last record is valid, because each one replaces the earlier ones.
        "timing": json.loads(timing[-1].metadata["json"]) if timing else None,
        "runs": [json.loads(record.metadata["json"]) for record in records if record.name == "ballbard.run"],
        "attachments": attachments,
    }


def with_rosbags(path):
    """Messages of the file, decoded by PyPI rosbags, an independent implementation that takes the types from the file."""
    from rosbags.highlevel import AnyReader

    with AnyReader([Path(path)]) as reader:
        for connection, log_time, raw in reader.messages():
            yield connection.topic, log_time, reader.deserialize(raw, connection.msgtype)


def content_of(path, reader):
    read = {"mcap": with_mcap, "rosbags": with_rosbags}[reader]
    result = {"cycles": [], "joint_states": [], "events": [], "log": [], "diagnostics": []}
    # A joint without a valid sample is NaN in the message. JSON has no NaN, so it becomes null.
    numbers = lambda values: [None if math.isnan(value) else float(value) for value in values]
    for topic, log_time, message in read(path):
        stamp = message.stamp if topic == "/ballbard/log" else message.header.stamp
        stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        if topic == "/ballbard/cycle":
            result["cycles"].append({
                "log_time_ns": log_time,
                "stamp_ns": stamp_ns,
                "cycle": message.cycle,
                "dc_time_ns": message.dc_time_ns,
                "working_counter": message.working_counter,
                "flags": message.flags,
                "origin": message.origin,
                "joints": [encoder.joint for encoder in message.encoders],
                "counts": [encoder.count for encoder in message.encoders],
                "valid": [bool(encoder.valid) for encoder in message.encoders],
            })
        elif topic == "/ballbard/joint_states":
            result["joint_states"].append({
                "stamp_ns": stamp_ns,
                "frame_id": message.header.frame_id,
                "name": list(message.name),
                "position": numbers(message.position),
                "velocity": numbers(message.velocity),
            })
        elif topic == "/ballbard/log":
            result["log"].append({"stamp_ns": stamp_ns, "level": int(message.level), "msg": message.msg})
        elif topic == "/diagnostics":
            result["diagnostics"].append({
                "stamp_ns": stamp_ns,
                "status": [
                    {
                        "level": status.level[0] if isinstance(status.level, bytes) else int(status.level),
                        "name": status.name,
                        "message": status.message,
                        "values": {one.key: one.value for one in status.values},
                    }
                    for status in message.status
                ],
            })
        else:
            result["events"].append({"stamp_ns": stamp_ns, "kind": message.kind, "text": message.text})
    if reader == "mcap":
        result |= beside_messages(path)
    return result


def main():
    reader, *paths = sys.argv[1:]
    for path in paths:
        print(json.dumps(content_of(path, reader), allow_nan=False))


if __name__ == "__main__":
    main()
