"""Writes a robot log with implementations that are independent of this project.

usage: write_robot_log.py {mcap|db3|egm|egm-utc|rtde|rsi|table} FILE
       write_robot_log.py {bar-mcap|bar-db3} FILE RECORDING
       write_robot_log.py {force-mcap|force-db3|force-rtde} FILE TABLE

The first form writes 40 s at 125 Hz: joint j (from 0) at row k is 0.4 sin(0.01 k + j) rad, its speed 0.5 cos(0.01 k + j)
rad/s. The second form copies the joint states of one of our recordings into a bag; PyPI rosbags reads and writes them. The
third form writes the rows of TABLE: stamp in ns, six joints in rad, then six torques in Nm, or x, y, z of a force in N.
"""

import csv
import math
import sys
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

JOINT_STATE = "sensor_msgs/msg/JointState"
ROWS = 5000
START_NS = 1_795_000_000_123_456_789
PERIOD_NS = 8_000_000


def angle(row, joint):
    return 0.4 * math.sin(0.01 * row + joint)


@contextmanager
def joint_states(path, storage):
    """Opens a bag of PyPI rosbags, which becomes one file when it is closed. Yields a function that writes a message."""
    import numpy
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_JAZZY)
    message, header, time = (types.types[name] for name in (JOINT_STATE, "std_msgs/msg/Header", "builtin_interfaces/msg/Time"))
    directory = path.with_suffix(f".{storage}-bag")
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    topics = {}
    with Writer(directory, version=9, storage_plugin=plugin) as writer:
        def write(topic, received, stamp, names, position, velocity=(), effort=()):
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, JOINT_STATE, typestore=types)
            at = header(stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="base")
            position, velocity, effort = (numpy.array(values, dtype=float) for values in (position, velocity, effort))
            state = message(header=at, name=names, position=position, velocity=velocity, effort=effort)
            writer.write(topics[topic], received, types.serialize_cdr(state, JOINT_STATE))

        yield write
    (written,) = [file for file in directory.iterdir() if file.suffix == f".{storage}"]
    written.rename(path)


def bag(path, storage):
    """Writes a bag with two topics. One has other joints. That of the robot has an extra joint and another order."""
    order = [5, 0, 3, 1, 4, 2]
    names = ["gripper"] + [f"left_joint_{j + 1}" for j in order]
    with joint_states(path, storage) as write:
        for row in range(ROWS):
            stamp = START_NS + row * PERIOD_NS
            position = [0.01] + [angle(row, j) for j in order]
            velocity = [0.0] + [0.5 * math.cos(0.01 * row + j) for j in order]
            if row == 100:
                position[3] = math.nan
            # Messages are received late, and at uneven intervals.
            received = stamp + 1_000_000 + (row * 7919) % 700_000
            write("/left/joint_states", received, stamp, names, position, velocity)
            write("/gripper/joint_states", received, stamp, ["gripper"], position[:1])


def bag_of_bar(path, storage, recording):
    """Copies our recording with PyPI rosbags into a bag that has the joints in reverse order."""
    from rosbags.highlevel import AnyReader

    with AnyReader([recording]) as reader, joint_states(path, storage) as write:
        connections = [one for one in reader.connections if one.msgtype == JOINT_STATE]
        for connection, received, data in reader.messages(connections):
            read = reader.deserialize(data, connection.msgtype)
            stamp = read.header.stamp.sec * 10**9 + read.header.stamp.nanosec
            names = [f"lab_{name}" for name in reversed(read.name)]
            write("/ball_bar/joint_states", received, stamp, names, read.position[::-1])


def rows_of(table):
    """Rows of the table: stamp [ns], six joints [rad], and the forces or torques measured with them."""
    with open(table, newline="") as source:
        for row in csv.reader(source):
            yield int(row[0]), [float(cell) for cell in row[1:7]], [float(cell) for cell in row[7:]]


def bag_with_efforts(path, storage, table):
    """Writes six torques [Nm] as efforts, after an effort of another joint and in another order than that of the robot."""
    order = [2, 0, 5, 1, 4, 3]
    names = ["rail"] + [f"arm_joint_{j + 1}" for j in order]
    with joint_states(path, storage) as write:
        for stamp, joints, torques in rows_of(table):
            write("/joint_states", stamp + 900_000, stamp, names, [0.5] + [joints[j] for j in order],
                  effort=[-333.0] + [torques[j] for j in order])


def rtde_with_force(path, table):
    """Writes a log like the recorder of Universal Robots' RTDE client: outputs as in its guide, numbers as in Python."""
    vectors = ["target_q", "target_qd", "target_qdd", "target_current", "target_moment", "actual_q", "actual_qd",
               "actual_current", "joint_control_output", "actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force"]
    with open(path, "w", newline="") as sink:
        writer = csv.writer(sink, delimiter=" ")
        writer.writerow(["timestamp"] + [f"{name}_{i}" for name in vectors for i in range(6)] + ["robot_mode"])
        for stamp, joints, force in rows_of(table):
            # The moments at the TCP follow its force.
            known = {"target_q": [q + 0.01 for q in joints], "actual_q": joints, "actual_TCP_force": force + [7.0, -8.0, 9.0]}
            cells = [value for name in vectors for value in known.get(name, [0.0] * 6)]
            writer.writerow([stamp * 1e-9] + cells + [7])


def egm_messages():
    """Message types of Google's protobuf, made from the public definition of EGM."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    field = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="egm.proto", package="abb.egm", syntax="proto2")

    def define(name, *fields):
        message = file.message_type.add(name=name)
        for number, label, kind, title in fields:
            entry = message.field.add(name=title, number=number, label=label)
            if isinstance(kind, str):
                entry.type, entry.type_name = field.TYPE_MESSAGE, f".abb.egm.{kind}"
            else:
                entry.type = kind

    optional, required, repeated = field.LABEL_OPTIONAL, field.LABEL_REQUIRED, field.LABEL_REPEATED
    define("EgmHeader", (1, optional, field.TYPE_UINT32, "seqno"), (2, optional, field.TYPE_UINT32, "tm"),
           (3, optional, field.TYPE_INT32, "mtype"))
    define("EgmCartesian", *((n, required, field.TYPE_DOUBLE, "xyz"[n - 1]) for n in (1, 2, 3)))
    define("EgmPose", (1, optional, "EgmCartesian", "pos"))
    define("EgmClock", (1, required, field.TYPE_UINT64, "sec"), (2, required, field.TYPE_UINT64, "usec"))
    define("EgmJoints", (1, repeated, field.TYPE_DOUBLE, "joints"))
    for name in ("EgmFeedBack", "EgmPlanned"):
        define(name, (1, optional, "EgmJoints", "joints"), (2, optional, "EgmPose", "cartesian"),
               (3, optional, "EgmJoints", "externalJoints"), (4, optional, "EgmClock", "time"))
    define("EgmRobot", (1, optional, "EgmHeader", "header"), (2, optional, "EgmFeedBack", "feedBack"),
           (3, optional, "EgmPlanned", "planned"), (6, optional, field.TYPE_BOOL, "mciConvergenceMet"),
           (9, optional, "EgmJoints", "measuredForce"), (10, optional, field.TYPE_DOUBLE, "utilizationRate"))
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("abb.egm.EgmRobot"))


def egm(path, utc):
    from google.protobuf.internal.encoder import _VarintBytes

    robot = egm_messages()
    with open(path, "wb") as sink:
        for row in range(ROWS):
            message = robot()
            message.header.seqno = row
            # The controller's counter of milliseconds wraps in the middle of the log.
            message.header.tm = (2**32 - 20_000 + row * PERIOD_NS // 1_000_000) % 2**32
            message.header.mtype = 2
            message.feedBack.joints.joints.extend(math.degrees(angle(row, j)) for j in range(6))
            message.feedBack.cartesian.pos.x = message.feedBack.cartesian.pos.y = message.feedBack.cartesian.pos.z = 1.0
            message.planned.joints.joints.extend(math.degrees(angle(row, j)) + 1.0 for j in range(6))
            message.utilizationRate = 12.5
            if utc:
                stamp = START_NS + row * PERIOD_NS
                message.feedBack.time.sec, message.feedBack.time.usec = stamp // 10**9, stamp % 10**9 // 1000
            # A reader that polls too early gets the same message twice.
            for _ in range(2 if row == 77 else 1):
                sink.write(_VarintBytes(message.ByteSize()) + message.SerializeToString())


def rtde(path):
    """Writes a log like the CSV writer of Universal Robots' RTDE client: blanks between cells, outputs in any order."""
    with open(path, "w", newline="") as sink:
        writer = csv.writer(sink, delimiter=" ")
        joints = range(6)
        writer.writerow(["timestamp"] + [f"target_q_{j}" for j in joints] + [f"actual_q_{j}" for j in joints]
                        + [f"actual_qd_{j}" for j in joints] + ["robot_mode", "payload"])
        for row in range(ROWS):
            writer.writerow([250.0 + row * PERIOD_NS * 1e-9] + [angle(row, j) + 0.01 for j in joints]
                            + [angle(row, j) for j in joints]
                            + [0.5 * math.cos(0.01 * row + j) for j in joints] + [7, 12.5])


def rsi(path):
    """Writes telegrams with Python's ElementTree, one after the other as a socket delivers them."""
    with open(path, "wb") as sink:
        for row in range(ROWS):
            telegram = ElementTree.Element("Rob", Type="KUKA")
            ElementTree.SubElement(telegram, "RIst", X="1.0", Y="2.0", Z="3.0", A="0.0", B="0.0", C="0.0")
            for name, off in (("AIPos", 0.0), ("ASPos", 1.0)):
                axes = {f"A{j + 1}": repr(math.degrees(angle(row, j)) + off) for j in range(6)}
                ElementTree.SubElement(telegram, name, axes)
            ElementTree.SubElement(telegram, "Delay", D="0")
            ElementTree.SubElement(telegram, "IPOC").text = str(4_208_163_000 + row * PERIOD_NS // 1_000_000)
            sink.write(ElementTree.tostring(telegram))


def table(path):
    """Writes a spreadsheet export with decimal commas: a title line, UTF-8 with BOM, CRLF, cells quoted, angles in degrees."""
    with open(path, "w", newline="", encoding="utf-8-sig") as sink:
        writer = csv.writer(sink, delimiter=";", quoting=csv.QUOTE_ALL)
        writer.writerow(["Prüfstand 3; Lauf 7"])
        writer.writerow(["Kommentar"] + [f"Achse {j}" for j in (3, 1, 2, 6, 5, 4)] + ["Zeit"])
        writer.writerow([""] + ["[°]"] * 6 + ["[ms]"])
        for row in range(ROWS):
            numbers = [math.degrees(angle(row, j - 1)) for j in (3, 1, 2, 6, 5, 4)] + [row * PERIOD_NS / 1e6]
            writer.writerow(["läuft"] + [repr(number).replace(".", ",") for number in numbers])


def main():
    kind, path = sys.argv[1], Path(sys.argv[2])
    if kind in ("mcap", "db3"):
        bag(path, kind)
    elif kind.startswith("bar-"):
        bag_of_bar(path, kind.removeprefix("bar-"), Path(sys.argv[3]))
    elif kind == "force-rtde":
        rtde_with_force(path, Path(sys.argv[3]))
    elif kind.startswith("force-"):
        bag_with_efforts(path, kind.removeprefix("force-"), Path(sys.argv[3]))
    elif kind in ("egm", "egm-utc"):
        egm(path, utc=kind == "egm-utc")
    else:
        {"rtde": rtde, "rsi": rsi, "table": table}[kind](path)


if __name__ == "__main__":
    main()
