"""Plays sessions with `tsda trax` through libtrax, the protocol's own library.

    python client.py TSDA SEQUENCES

Every version, both transports, every kind of picture and region. Prints one line per session and
ends with "all sessions passed"; exit code 1 when one does not go as it should.
"""

import contextlib
import os
import pathlib
import socket
import subprocess
import sys

import numpy as np
from PIL import Image
from trax.client import Client
from trax.image import BufferImage, FileImage, MemoryImage
from trax.region import Mask, Polygon, Rectangle

FRAMES = 8


def overlap(a, b):
    width = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    height = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    common = max(width, 0) * max(height, 0)
    return common / (a[2] * a[3] + b[2] * b[3] - common)


def quiet(_):
    """This version of libtrax's bindings cannot do without a log function."""


@contextlib.contextmanager
def session(tsda, arguments, over_socket=False):
    """A running tracker and the client connected to it."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("TRAX")}
    environment["TRAX"] = "1"
    listener = None
    if over_socket:
        listener = socket.socket()
        listener.bind(("127.0.0.1", 0))
        listener.listen(1)
        environment["TRAX_SOCKET"] = str(listener.getsockname()[1])
    process = subprocess.Popen(
        [tsda, "trax", *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=environment,
        bufsize=0,
    )
    try:
        if over_socket:
            client = Client(stream=listener.fileno(), timeout=30, log=quiet)
        else:
            streams = (process.stdin.fileno(), process.stdout.fileno())
            client = Client(stream=streams, log=quiet)
        yield client
        client.quit()
        code = process.wait(timeout=10)
        assert code == 0, f"exit code {code}"
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()
        if listener:
            listener.close()


def picture(kind, path):
    if kind == "path":
        return FileImage.create(str(path))
    if kind == "buffer":
        return BufferImage.create(path.read_bytes())
    if kind == "png buffer":
        import io

        out = io.BytesIO()
        Image.open(path).save(out, "PNG")
        return BufferImage.create(out.getvalue())
    pixels = np.asarray(Image.open(path))
    if kind == "memory":
        return MemoryImage.create(pixels)
    if kind == "gray16":
        return MemoryImage.create(pixels.astype(np.uint16) * 37 + 9000)
    raise ValueError(kind)


def region(kind, box):
    x, y, w, h = box
    if kind == "rectangle":
        return Rectangle.create(x, y, w, h)
    if kind == "polygon":
        return Polygon.create([(x, y), (x + w, y), (x + w, y + h), (x, y + h)])
    mask = np.zeros((240, 320), dtype=np.uint8)
    mask[round(y) : round(y + h), round(x) : round(x + w)] = 1
    return Mask.create(mask)


# name, arguments, channels as (channel, kind of picture), region, over a socket
CASES = [
    ("version 4, path", [], [("color", "path")], "rectangle", False),
    ("version 4, socket", [], [("color", "path")], "rectangle", True),
    ("version 3, socket", ["--trax-version", "3"], [("color", "path")], "polygon", True),
    ("version 3", ["--trax-version", "3"], [("color", "path")], "rectangle", False),
    ("version 2", ["--trax-version", "2"], [("color", "path")], "rectangle", False),
    ("version 1", ["--trax-version", "1"], [("color", "path")], "rectangle", False),
    ("memory", [], [("color", "memory")], "rectangle", False),
    ("jpeg buffer", [], [("color", "buffer")], "mask", False),
    ("png buffer", [], [("color", "png buffer")], "polygon", False),
    ("ir alone", ["--channels", "ir"], [("ir", "memory")], "rectangle", False),
    ("ir, 16 bit", ["--channels", "ir"], [("ir", "gray16")], "rectangle", False),
    (
        "color and ir, auto",
        ["--channels", "color,ir"],
        [("color", "path"), ("ir", "buffer")],
        "rectangle",
        False,
    ),
    (
        "color and ir, switch, version 3",
        ["--channels", "ir,color", "--policy", "switch:3", "--trax-version", "3"],
        [("color", "path"), ("ir", "memory")],
        "rectangle",
        False,
    ),
]


def play(tsda, sequence, arguments, channels, kind, over_socket):
    lines = (sequence / "groundtruth.txt").read_text().split()
    truth = [[float(v) for v in line.split(",")] for line in lines]
    worst = 1.0

    def images(frame):
        return {c: picture(k, sequence / c / f"{frame + 1:08d}.jpg") for c, k in channels}

    with session(tsda, arguments, over_socket) as client:
        assert client.tracker_name == "TSDA-Track", client.tracker_name
        assert sorted(client.channels) == sorted(c for c, _ in channels), client.channels
        # Twice in one process: the second target must not suffer from the first.
        for start in (0, 3):
            first = region(kind, truth[start])
            states, _ = client.initialize(images(start), [(first, {})], {})
            for frame in range(start, FRAMES + start):
                if frame > start:
                    states, _ = client.frame(images(frame), {}, [])
                assert len(states) == 1, f"{len(states)} states"
                found, properties = states[0]
                found_box = found.bounds()
                properties = dict(properties)
                assert 0 <= float(properties["confidence"]) <= 1, properties
                assert properties["state"] in ("tracking", "uncertain", "searching", "lost")
                assert properties["modality"] in ("rgb", "thermal"), properties
                worst = min(worst, overlap(found_box, truth[frame]))
    assert worst > 0.3, f"worst overlap {worst:.3f}"
    return worst


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    tsda, sequences = sys.argv[1], pathlib.Path(sys.argv[2])
    failed = 0
    for name, arguments, channels, kind, over_socket in CASES:
        try:
            worst = play(tsda, sequences / "rgbt", arguments, channels, kind, over_socket)
            print(f"  {name}: passed, worst overlap {worst:.2f}", flush=True)
        except Exception as error:  # noqa: BLE001 - every session is to be reported
            failed += 1
            print(f"  {name}: FAILED: {type(error).__name__}: {error}", flush=True)
    print(f"{failed} sessions failed" if failed else "all sessions passed")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
