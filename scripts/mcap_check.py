#!/usr/bin/env python3
"""Reads recordings of `tsda run` with other people's software.

    python3 -m venv venv
    venv/bin/pip install 'mcap>=1.6' jsonschema foxglove-schemas-protobuf pybag-sdk
    venv/bin/python scripts/mcap_check.py FILE.mcap...            recordings that were finished
    venv/bin/python scripts/mcap_check.py --cut FILE.mcap...      that were cut: kill -9, power
    venv/bin/python scripts/mcap_check.py --tsda target/release/tsda     records, kills, checks both

Of a finished file: magic and summary, statistics against the messages, every chunk's checksum and index,
the order of time within a topic, all messages by the index and by reading on from the start, and again
with pybag-sdk where it is installed. Of a cut one: everything up to the last whole chunk, and that it can
be written into a whole file again, which then passes as one.

Of the messages: every one is valid by the JSON Schema it is recorded with; the schemas named foxglove.*
have the fields, and only fields, that Foxglove's own definition of that name has, of the same kinds (taken
from its package foxglove-schemas-protobuf); pictures are whole JPEGs.

Exit code 0: all is well.
"""

import argparse
import base64
import importlib
import io
import json
import pathlib
import subprocess
import sys
import tempfile
import time

try:
    import jsonschema
    from google.protobuf.descriptor import FieldDescriptor as Field
    from mcap.exceptions import McapError
    from mcap.reader import SeekingReader
    from mcap.records import Channel, ChunkIndex, Message, Schema
    from mcap.stream_reader import StreamReader
    from mcap.writer import CompressionType, Writer
except ImportError as error:
    sys.exit(f"missing package ({error}): pip install mcap jsonschema foxglove-schemas-protobuf")

NUMBERS = {Field.TYPE_DOUBLE, Field.TYPE_FLOAT}
PLAIN = {Field.TYPE_STRING: "string", Field.TYPE_BYTES: "string", Field.TYPE_ENUM: "integer"}


def check(condition, what):
    if not condition:
        raise AssertionError(what)


def resolved(schema, root):
    """A schema with its reference followed."""
    reference = schema.get("$ref")
    if reference is None:
        return schema
    check(reference.startswith("#/"), f"reference {reference} leads elsewhere")
    for part in reference[2:].split("/"):
        root = root[part]
    return root


def compare(schema, root, message, at):
    """A JSON Schema against Foxglove's definition of the message. Answers the fields it has."""
    schema, names = resolved(schema, root), []
    check(schema["type"] == "object", f"{at}: no object")
    if message.full_name == "google.protobuf.Timestamp":
        # In JSON, times are { sec, nsec }.
        check(set(schema["properties"]) == {"sec", "nsec"}, f"{at}: no time")
        return [at]
    known = {field.name: field for field in message.fields}
    for name, value in schema["properties"].items():
        where = f"{at}.{name}"
        check(name in known, f"{where}: Foxglove knows no such field")
        field, value = known[name], resolved(value, root)
        repeated = getattr(field, "is_repeated", None)
        if repeated is None:
            repeated = field.label == Field.LABEL_REPEATED
        if repeated:
            check(value["type"] == "array", f"{where}: no array")
            value = resolved(value["items"], root)
        if field.type == Field.TYPE_MESSAGE:
            names += compare(value, root, field.message_type, where)
        else:
            want = "number" if field.type in NUMBERS else PLAIN.get(field.type)
            check(value["type"] == want, f"{where}: {value['type']}, not {want}")
        if field.type == Field.TYPE_ENUM:
            ours = {one["title"]: one["const"] for one in value["oneOf"]}
            theirs = {one.name: one.number for one in field.enum_type.values}
            check(ours == theirs, f"{where}: {ours} instead of {theirs}")
        if field.type == Field.TYPE_BYTES:
            check(value.get("contentEncoding") == "base64", f"{where}: not base64")
        names.append(where)
    missing = {n for n in known if n not in schema["properties"] and n != "metadata"}
    check(missing <= OPTIONAL.get(at, set()), f"{at}: {sorted(missing)} missing")
    return names


# Added to Foxglove's definitions in 2026 and optional there, as `metadata` is everywhere.
OPTIONAL = {"foxglove.ImageAnnotations": {"timestamp"}}


class Judge:
    """Decodes messages and checks them against their schema."""

    def __init__(self):
        self.validators, self.fields, self.counts, self.times, self.pictures = {}, 0, {}, {}, 0

    def schema(self, schema):
        text = json.loads(schema.data)
        jsonschema.Draft202012Validator.check_schema(text)
        if schema.name.startswith("foxglove."):
            name = schema.name.removeprefix("foxglove.")
            module = importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2")
            self.fields += len(compare(text, text, getattr(module, name).DESCRIPTOR, schema.name))
        self.validators[schema.id] = jsonschema.Draft202012Validator(text)

    def message(self, schema, channel, message):
        check(schema.encoding == "jsonschema" and channel.message_encoding == "json", channel.topic)
        if schema.id not in self.validators:
            self.schema(schema)
        content = json.loads(message.data)
        self.validators[schema.id].validate(content)
        check(message.log_time >= self.times.get(channel.topic, 0), f"{channel.topic}: back in time")
        self.times[channel.topic] = message.log_time
        count = self.counts.get(channel.topic, 0)
        check(message.sequence == count, f"{channel.topic}: number {message.sequence} after {count}")
        self.counts[channel.topic] = count + 1
        if schema.name == "foxglove.CompressedImage":
            jpeg = base64.b64decode(content["data"], validate=True)
            whole = jpeg[:2] == b"\xff\xd8" and jpeg[-2:] == b"\xff\xd9"
            check(whole and content["format"] == "jpeg", f"{channel.topic}: no JPEG")
            stamp = content["timestamp"]
            check(stamp["sec"] * 10**9 + stamp["nsec"] == message.log_time, f"{channel.topic}: other time")
            self.pictures += 1


def walk(data):
    """Messages in the order of the file, up to its end or to where it was cut."""
    schemas, channels, found, whole = {}, {}, [], False
    try:
        for record in StreamReader(io.BytesIO(data), validate_crcs=True).records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                found.append((schemas[channel.schema_id], channel, record))
            whole = type(record).__name__ == "Footer"
    except (McapError, EOFError) as error:
        check(not whole, f"after the end: {error!r}")
    return found, whole


def finished(data, name):
    """A whole file; answers what to say about it."""
    found, whole = walk(data)
    check(whole, f"{name}: not finished")
    judge = Judge()
    reader = SeekingReader(io.BytesIO(data), validate_crcs=True)
    summary = reader.get_summary()
    check(summary and summary.statistics, f"{name}: no summary")
    indexed = list(reader.iter_messages(log_time_order=False))
    for schema, channel, message in indexed:
        judge.message(schema, channel, message)
    key = lambda m: (m[1].topic, m[2].sequence, m[2].log_time, m[2].data)
    check([key(m) for m in indexed] == [key(m) for m in found], f"{name}: by index and in order differ")
    statistics = summary.statistics
    check(statistics.message_count == len(found), f"{name}: {statistics.message_count} messages counted")
    counted = {summary.channels[c].topic: n for c, n in statistics.channel_message_counts.items() if n}
    check(counted == judge.counts, f"{name}: counts per topic {counted} and {judge.counts}")
    times = [m.log_time for _, _, m in found]
    span = (statistics.message_start_time, statistics.message_end_time)
    check(span == (min(times), max(times)), f"{name}: span of time")
    check(statistics.chunk_count == len(summary.chunk_indexes), f"{name}: chunks")
    entries = 0
    for chunk in summary.chunk_indexes:
        check(isinstance(chunk, ChunkIndex) and chunk.message_index_length > 0, f"{name}: no message index")
        # The index of each topic stands right behind its chunk, at the offset that the summary tells.
        for channel, offset in chunk.message_index_offsets.items():
            check(data[offset] == 7, f"{name}: no message index at {offset}")
            check(int.from_bytes(data[offset + 9 : offset + 11], "little") == channel, f"{name}: index")
            entries += int.from_bytes(data[offset + 11 : offset + 15], "little") // 16
    check(entries == len(found), f"{name}: {entries} indexed of {len(found)}")
    # Part of the time, as a viewer that jumps asks for.
    middle = (span[0] + span[1]) // 2
    late = sum(1 for _ in reader.iter_messages(starting_at=middle))
    check(late == sum(t >= middle for t in times), f"{name}: messages from the middle on")
    return (f"{len(found)} messages, {judge.pictures} pictures, {statistics.chunk_count} chunks, "
            f"{judge.fields} fields of Foxglove's{again(data, found)}")


def again(data, found):
    """The same with a reader that shares nothing with the first."""
    try:
        from pybag.mcap_reader import McapFileReader
    except ImportError:
        return ""
    topics = {}
    for _, channel, message in found:
        topics.setdefault(channel.topic, []).append(message.log_time)
    with tempfile.NamedTemporaryFile(suffix=".mcap") as file:
        file.write(data)
        file.flush()
        with McapFileReader.from_file(file.name) as reader:
            check(set(reader.get_topics()) >= set(topics), "pybag: topics")
            for topic, times in topics.items():
                check(reader.get_message_count(topic) == len(times), f"pybag: {topic}")
                check((reader.start_time, reader.end_time)[0] <= times[0], f"pybag: {topic}: time")
    return ", counted alike by pybag"


def cut(data, name):
    """A file that ends anywhere: what is whole is read, and makes a finished file again."""
    found, whole = walk(data)
    check(not whole, f"{name}: finished")
    check(found, f"{name}: nothing to be read")
    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.NONE)
    writer.start()
    schemas, channels = {}, {}
    for schema, channel, message in found:
        if schema.id not in schemas:
            schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
        if channel.id not in channels:
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, schemas[schema.id])
        writer.add_message(channels[channel.id], message.log_time, message.data,
                           message.publish_time, message.sequence)
    writer.finish()
    return "recovered: " + finished(out.getvalue(), name)


CONFIG = """
[[source]]
name = "rgb"
sensor = "rgb"
render = { frames = 48, repeat = true }
[[source]]
name = "far infrared"
sensor = "thermal"
render = { size = [160, 120], frames = 48, raw16 = true, repeat = true }
[switch]
every_s = 1.0
[output.mcap]
dir = "recording"
file_mb = 1
flush_s = 0.3
"""


def record(tsda, folder):
    """One run that ends by itself, one that is killed; answers finished and cut files."""
    (folder / "host.toml").write_text(CONFIG)
    command = [tsda, "run", "--config", folder / "host.toml"]
    quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    files = lambda: sorted((folder / "recording").glob("*.mcap"))
    subprocess.run([*command, "--frames", "120"], check=True, timeout=300, **quiet)
    first = files()
    process = subprocess.Popen(command, **quiet)
    try:
        # In its second file, with chunks in it.
        end = time.monotonic() + 120
        while len(files()) < len(first) + 2 or files()[-1].stat().st_size < 200_000:
            check(process.poll() is None and time.monotonic() < end, "the recording does not get on")
            time.sleep(0.02)
    finally:
        process.kill()
        process.wait()
    later = [f for f in files() if f not in first]
    return first + later[:-1], later[-1:]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("files", nargs="*", type=pathlib.Path)
    parser.add_argument("--cut", action="store_true", help="the files were cut")
    parser.add_argument("--tsda", type=pathlib.Path, help="the program, to make recordings with")
    args = parser.parse_args()
    whole, torn = ([], args.files) if args.cut else (args.files, [])
    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        if args.tsda:
            made = record(args.tsda.resolve(), pathlib.Path(folder))
            whole, torn = whole + made[0], torn + made[1]
        for judge, files in ((finished, whole), (cut, torn)):
            for path in files:
                try:
                    print(f"{path.name}: {judge(path.read_bytes(), path.name)}")
                except (AssertionError, McapError, jsonschema.ValidationError, ValueError, KeyError) as error:
                    bad += 1
                    print(f"{path.name}: FAILED: {type(error).__name__}: {str(error)[:300]}")
    if not whole and not torn:
        parser.error("no files")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
