"""Writes the MCAP logs of the tests beside this script, with the reference library of the format and its writer of ROS 2.
Needs mcap and mcap-ros2-support: python make.py

All samples are quotients of whole numbers: tests/mcap.rs computes them again and compares to the bit.
"""

import json
import os

from mcap.writer import CompressionType
from mcap_ros2.writer import Writer

here = os.path.dirname(os.path.abspath(__file__))
START = 1_700_000_000_000_000_000  # ns
JOINTS = ["shoulder", "elbow", "wrist.roll"]

SEPARATOR = "=" * 80
TIME = f"{SEPARATOR}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
HEADER = f"{SEPARATOR}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{TIME}"
VECTOR = f"{SEPARATOR}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
QUATERNION = f"{SEPARATOR}\nMSG: geometry_msgs/Quaternion\nfloat64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n"
JOINT_STATE = "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n" + HEADER
IMU = (
    "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
    "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
    "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n" + HEADER + VECTOR + QUATERNION
)
TWIST = "# velocity in free space\ngeometry_msgs/Vector3  linear\ngeometry_msgs/Vector3  angular\n" + VECTOR
IMAGE = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n"
    + HEADER
)
SCAN = "std_msgs/Header header\nfloat32[] ranges\n" + HEADER
KINDS = f"""# every kind of field
int32 LIMIT=7
string NAME = "a # b"
bool on
int8 i8
byte raw
char letter
int16 i16
uint8 u8
float64 f64
uint16 u16
int32 i32
float32 f32 0.5
uint32 u32
string<=20 label "none"
int64 i64
bool last
uint64 u64
int16[3] fixed
float64[<=4] bounded
builtin_interfaces/Duration wait
Part[] parts
Part one
bool[2] flags
float64 end
{SEPARATOR}
MSG: test_msgs/Part
string[] names
uint8 n
float64[] x
{SEPARATOR}
MSG: builtin_interfaces/Duration
int32 sec
uint32 nanosec
"""


def value(k, i):
    return (k * 37 % 101) / 7.0 - i


def vector(k, i):
    return {"x": value(k, i), "y": value(k, i + 1), "z": value(k, i + 2)}


def header(ns):
    return {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": "base"}


class Log:
    def __init__(self, name, compression, chunk_size=4096):
        self.writer = Writer(os.path.join(here, name + ".mcap"), chunk_size=chunk_size, compression=compression)
        self.schemas = {}
        self.messages = []

    def schema(self, name, text):
        self.schemas[name] = self.writer.register_msgdef(name, text)

    def add(self, topic, schema, ns, message):
        self.messages.append((ns, topic, schema, message))

    def finish(self, others=()):
        for ns, topic, schema, message in sorted(self.messages, key=lambda m: m[0]):
            self.writer.write_message(topic, self.schemas[schema], message, ns, ns)
        below = self.writer._writer
        for topic, encoding, schema, messages in others:
            channel = below.register_channel(topic, encoding, schema(below))
            for ns, data in messages:
                below.add_message(channel, ns, data, ns)
        self.writer.finish()


def arm(name, compression):
    """A robot's arm: states at 100 Hz, commands at 20 Hz, an IMU at 50 Hz, and topics that are no series."""
    log = Log(name, compression)
    log.schema("sensor_msgs/msg/JointState", JOINT_STATE)
    log.schema("std_msgs/msg/Float64", "float64 data\n")
    log.schema("sensor_msgs/msg/Imu", IMU)
    log.schema("geometry_msgs/msg/Twist", TWIST)
    log.schema("sensor_msgs/msg/Image", IMAGE)
    log.schema("sensor_msgs/msg/LaserScan", SCAN)
    for k in range(120):
        ns = START + k * 10_000_000
        numbers = [value(k, i) for i in range(3)]
        # Logged 2 ms after the stamp.
        state = {"header": header(ns), "name": JOINTS, "position": numbers, "velocity": [2 * v for v in numbers], "effort": []}
        log.add("/joint_states", "sensor_msgs/msg/JointState", ns + 2_000_000, state)
    for k in range(24):
        log.add("/cmd", "std_msgs/msg/Float64", START + k * 50_000_000 + 1_000_000, {"data": value(k, 0)})
        log.add("/cmd_vel", "geometry_msgs/msg/Twist", START + k * 50_000_000, {"linear": vector(k, 0), "angular": vector(k, 3)})
    for k in range(60):
        ns = START + k * 20_000_000
        covariance = [0.25 * i for i in range(9)]
        imu = {"header": header(ns), "orientation_covariance": covariance, "angular_velocity": vector(k, 0),
               "linear_acceleration": vector(k, 3), "angular_velocity_covariance": covariance,
               "linear_acceleration_covariance": covariance, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
        log.add("/imu", "sensor_msgs/msg/Imu", ns + 3_000_000, imu)
    for k in range(2):
        ns = START + k * 500_000_000
        image = {"header": header(ns), "height": 20, "width": 20, "encoding": "mono8", "is_bigendian": 0, "step": 20,
                 "data": bytes(range(200)) * 2}
        log.add("/camera", "sensor_msgs/msg/Image", ns, image)
        log.add("/scan", "sensor_msgs/msg/LaserScan", ns, {"header": header(ns), "ranges": [1.0] * 90})
    status = [(START + k * 100_000_000, json.dumps({"load": value(k, 0), "on": k % 2 == 1, "pack": {"cells": [k, k + 1]}}).encode())
              for k in range(12)]
    log.finish([
        ("/status", "json", lambda w: w.register_schema("Status", "jsonschema", b'{"type": "object"}'), status),
        ("/proto", "protobuf", lambda w: w.register_schema("a.B", "protobuf", b"\n"), [(START, b"\x08\x01")]),
    ])


def kinds():
    """Every kind of field at every alignment, in a structure alone and in a list of them."""
    log = Log("kinds", CompressionType.NONE)
    log.schema("test_msgs/msg/Kinds", KINDS)
    for k in range(10):
        part = lambda n: {"names": [f"p{i}" for i in range(n)], "n": n, "x": [value(k, i) for i in range(n)]}
        message = {"on": k % 2 == 0, "i8": -k, "raw": 200 + k, "letter": 65 + k, "i16": -1000 * k, "u8": 2 * k, "f64": value(k, 0),
                   "u16": 60000 + k, "i32": -100000 * k, "f32": k / 4, "u32": 4000000000 + k, "label": "x" * k,
                   "i64": -(2**40) * k, "last": k % 3 == 0, "u64": 2**60 * k, "fixed": [k, -k, 3], "bounded": [value(k, 1)] * 2,
                   "wait": {"sec": k - 5, "nanosec": 250000000}, "parts": [part(1), part(3)], "one": part(2),
                   "flags": [True, False], "end": value(k, 2)}
        log.add("/kinds", "test_msgs/msg/Kinds", START + k * 10_000_000, message)
    log.finish()


def small():
    """A short log, to be cut off and changed at every byte."""
    log = Log("small", CompressionType.ZSTD, chunk_size=600)
    log.schema("sensor_msgs/msg/JointState", JOINT_STATE)
    log.schema("std_msgs/msg/Float64", "float64 data\n")
    for k in range(12):
        ns = START + k * 10_000_000
        log.add("/j", "sensor_msgs/msg/JointState", ns, {"header": header(ns), "name": ["a"], "position": [value(k, 0)], "velocity": [], "effort": []})
    for k in range(6):
        log.add("/c", "std_msgs/msg/Float64", START + k * 20_000_000, {"data": value(k, 1)})
    log.finish()


arm("arm_zstd", CompressionType.ZSTD)
arm("arm_lz4", CompressionType.LZ4)
arm("arm_none", CompressionType.NONE)
kinds()
small()
