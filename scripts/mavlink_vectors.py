#!/usr/bin/env python3
"""Prints the MAVLink frames that firmware-host/src/host/mavlink/wire.rs is tested with.

    pip install pymavlink; python scripts/mavlink_vectors.py
"""
from math import nan

from pymavlink.dialects.v20 import common as m


def text(value, length):
    return list(value.encode().ljust(length, b"\0"))


camera = m.MAVLink(None, srcSystem=1, srcComponent=100)
camera.seq = 7
station = m.MAVLink(None, srcSystem=255, srcComponent=190)
station.seq = 200
for name, link, message in [
    ("HEART", camera, m.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3)),
    ("ACK", camera, m.MAVLink_command_ack_message(2005, 0, 0, 0, 255, 190)),
    ("INFORMATION", camera, m.MAVLink_camera_information_message(
        123456, text("TSDA", 32), text("TSDA-Track", 32), 0x00030201, nan, nan, nan, 640, 480, 0,
        512 | 1024, 0, b"")),
    ("STATUS", camera, m.MAVLink_camera_tracking_image_status_message(
        1, 2, 4, nan, nan, nan, 0.25, 0.5, 0.375, 0.75)),
    ("IDLE", camera, m.MAVLink_camera_tracking_image_status_message(
        0, 0, 0, nan, nan, nan, nan, nan, nan, nan)),
    ("COMMAND", station, m.MAVLink_command_long_message(
        1, 100, 2005, 0, 0.25, 0.5, 0.375, 0.75, 0, 0, 0)),
    ("COMMAND_AS_INT", station, m.MAVLink_command_int_message(
        1, 100, 0, 2004, 0, 0, 0.5, 0.25, 0.1, 0, 0, 0, 0)),
]:
    digits = bytes(message.pack(link)).hex()
    rows = [digits[i:i + 80] for i in range(0, len(digits), 80)]
    print(f'const {name}: &str = "' + " \\\n    ".join(rows) + '";')
