"""The soak test: see run.sh. Standard library only.

Asserted, from the second tenth of the run on (the first fills caches and buffers):
  memory    resident anonymous memory (heap, stacks) of no later sample is more than ALLOWANCE above
            the highest of the second tenth
  loop      its last allocation is in the first WARM frames
  drift     processor time of the loop's thread per frame, last tenth against second (wall time is
            reported too, but says more about what else the machine does)
  and: exit code 0, every frame accounted for, no line of the frames' output lost, threads and
  descriptors as many as before.
"""

import argparse
import array
import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request

RATE = 30
# Ten bytes a frame would be 2 MB in two hours.
ALLOWANCE = 512 * 1024
WARM = 1000
SAMPLES = 200

CONFIG = f"""
clock = "frames"
[[source]]
name = "rgb"
sensor = "rgb"
render = {{ frames = 48, repeat = true, rate = {RATE}.0 }}
[[source]]
name = "thermal"
sensor = "thermal"
profile = "lepton"
render = {{ size = [160, 120], frames = 48, raw16 = true, repeat = true, rate = {RATE}.0 }}
[switch]
every_s = 7.0
[[output.json]]
to = "stdout"
queue = 65536
[[output.json]]
to = "udp:127.0.0.1:9"
[output.preview]
bind = "127.0.0.1:0"
[output.metrics]
bind = "127.0.0.1:0"
[output.mavlink]
to = "udp:127.0.0.1:14550"
[output.mcap]
dir = "recording"
file_mb = 16
total_mb = 64
[process.temperature]
"""


class Frames(threading.Thread):
    """Reads the frames' lines."""

    LINE = re.compile(rb'"type":"frame","frame":(\d+),.*"latency_ms":([0-9.e+-]+),')

    def __init__(self, stream):
        super().__init__(daemon=True)
        self.stream = stream
        self.latency = array.array("f")
        self.tracking = 0

    def run(self):
        for line in self.stream:
            found = self.LINE.search(line)
            if found:
                self.latency.append(float(found[2]))
                self.tracking += b'"state":"tracking"' in line


class Log(threading.Thread):
    """Standard error: addresses, and the summary at the end."""

    def __init__(self, stream):
        super().__init__(daemon=True)
        self.stream, self.lines = stream, []

    def run(self):
        for line in self.stream:
            self.lines.append(line.decode(errors="replace").rstrip())

    def find(self, pattern):
        for line in list(self.lines):
            if found := re.search(pattern, line):
                return found[1]
        return None


def sample(pid, frames):
    fields = dict(
        line.split(":", 1) for line in pathlib.Path(f"/proc/{pid}/status").read_text().splitlines()
    )
    kb = lambda name: int(fields[name].split()[0]) * 1024
    # The loop runs in the process's first thread.
    stat = pathlib.Path(f"/proc/{pid}/task/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return {
        "frame": len(frames.latency),
        "anonymous": kb("RssAnon"),
        "file": kb("RssFile"),
        "data": kb("VmData"),
        "threads": int(fields["Threads"]),
        "files": len(os.listdir(f"/proc/{pid}/fd")),
        "cpu_s": (int(stat[11]) + int(stat[12])) / os.sysconf("SC_CLK_TCK"),
        "load": os.getloadavg()[0],
    }


def get(address):
    with urllib.request.urlopen(address, timeout=20) as answer:
        return answer.read()


def quantiles(values):
    values = sorted(values)
    at = lambda q: round(values[min(len(values) - 1, int(len(values) * q))], 3)
    return {"p50": at(0.5), "p95": at(0.95), "p99": at(0.99), "max": round(values[-1], 3)}


def watch(process, log, frames, total):
    """Samples until the program ends, and looks at the preview meanwhile."""
    while not (metrics := log.find(r"metrics at (http://\S+)")):
        if process.poll() is not None:
            return [], "", 0
        time.sleep(0.1)
    preview = log.find(r"preview at (http://[^/\s]+)")
    samples, text, pictures, step = [], "", 0, max(1, total // SAMPLES)
    while process.poll() is None:
        try:
            if len(frames.latency) >= step * len(samples):
                samples.append(sample(process.pid, frames))
                text = get(metrics).decode()
            pictures += get(f"{preview}/picture?source={pictures % 2}")[:2] == b"\xff\xd8"
        except (OSError, KeyError, IndexError):
            pass  # It is ending.
        time.sleep(0.5)
    return samples, text, pictures


def judge(total, samples, frames, log, code, drift_limit):
    """The report, and what is wrong."""
    bad, tenths, n = [], [], len(frames.latency)
    if code != 0:
        bad.append(f"exit code {code}")
    if n != total:
        bad.append(f"{n} of {total} frames came out")
    for i in range(10):
        low, high = total * i // 10, total * (i + 1) // 10
        mine = [s for s in samples if low <= s["frame"] < high]
        if n < high or len(mine) < 2:
            bad.append(f"tenth {i + 1}: too few samples")
            continue
        used = mine[-1]["frame"] - mine[0]["frame"]
        tenths.append({
            "latency_ms": quantiles(frames.latency[low:high]),
            "cpu_ms_per_frame": round(1e3 * (mine[-1]["cpu_s"] - mine[0]["cpu_s"]) / used, 3),
            "anonymous_bytes": max(s["anonymous"] for s in mine),
            "file_bytes": max(s["file"] for s in mine),
            "load": round(sum(s["load"] for s in mine) / len(mine), 1),
        })
    loop = log.find(r"loop: (.*)") or ""
    last = re.search(r"last in frame (\d+)", loop)
    report = {"frames": n, "tracking": frames.tracking, "loop": loop, "tenths": tenths}
    if not loop:
        bad.append("no summary")
    if last and int(last[1]) >= WARM:
        bad.append(f"the loop allocates: {loop}")
    if len(tenths) == 10:
        report["growth_bytes"] = max(t["anonymous_bytes"] for t in tenths[2:]) - tenths[1]["anonymous_bytes"]
        report["drift"] = round(tenths[9]["cpu_ms_per_frame"] / tenths[1]["cpu_ms_per_frame"] - 1, 4)
        report["drift_wall"] = round(
            tenths[9]["latency_ms"]["p50"] / tenths[1]["latency_ms"]["p50"] - 1, 4)
        report["latency_ms"] = quantiles(frames.latency)
        second = [s for s in samples if total // 10 <= s["frame"] < total // 5]
        for key in ("threads", "files"):
            # Connections come and go.
            if max(s[key] for s in samples[-20:]) > max(s[key] for s in second) + 1:
                bad.append(f"{key}: {second[0][key]} became {samples[-1][key]}")
        if report["growth_bytes"] > ALLOWANCE:
            bad.append(f"memory grew by {report['growth_bytes']} bytes")
        if report["drift"] > drift_limit:
            bad.append(f"frames take {report['drift']:.1%} more processor time than at first")
    return report, bad


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--program", required=True)
    parser.add_argument("--frames", type=int, default=2 * 3600 * RATE)
    parser.add_argument("--drift", type=float, default=0.15)
    parser.add_argument("--json", type=pathlib.Path)
    parser.add_argument("--dir", type=pathlib.Path, help="kept; a temporary folder without it")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.dir or pathlib.Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "host.toml").write_text(CONFIG)
        command = [args.program, "run", "--config", folder / "host.toml", "--frames", str(args.frames)]
        start = time.monotonic()
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        frames, log = Frames(process.stdout), Log(process.stderr)
        frames.start(), log.start()
        try:
            samples, text, pictures = watch(process, log, frames, args.frames)
        finally:
            process.terminate()
        code = process.wait()
        frames.join(), log.join()
    report, bad = judge(args.frames, samples, frames, log, code, args.drift)
    report["seconds"] = round(time.monotonic() - start)
    report["pictures"] = pictures
    report["dropped"] = {
        name: int(float(count))
        for name, count in re.findall(r'tsda_output_dropped_total\{output="([^"]*)"\} (\S+)', text)
    }
    if report["dropped"].get("json to stdout"):
        bad.append("lines of frames were lost")
    if args.json:
        args.json.write_text(json.dumps(report | {"samples": samples}, indent=1) + "\n")
    mb = lambda b: f"{b / 1e6:.2f} MB"
    for line in log.lines[-8:]:
        print(line)
    print(f"{report['frames']} frames in {report['seconds']} s, {pictures} pictures looked at, "
          f"lost by outputs: {report['dropped']}")
    for i, t in enumerate(report["tenths"]):
        l = t["latency_ms"]
        print(f"{i + 1:2}/10: latency p50 {l['p50']:.2f} p95 {l['p95']:.2f} p99 {l['p99']:.2f} ms, "
              f"loop {t['cpu_ms_per_frame']:.2f} ms processor time, anonymous {mb(t['anonymous_bytes'])}, "
              f"mapped files {mb(t['file_bytes'])}, load {t['load']}")
    if "drift" in report:
        print(f"loop: {report['loop']}; memory {report['growth_bytes'] / 1024:+.0f} KiB since the second "
              f"tenth; frame time {report['drift']:+.1%} (wall {report['drift_wall']:+.1%})")
    for reason in bad:
        print(f"FAILED: {reason}")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
