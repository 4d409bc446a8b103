"""Checks what the VOT toolkit wrote.

    python check.py WORKSPACE FRAMES TRACKER...

Every run of every experiment has to be complete, with the properties of every frame; figures must be
those of a tracker that follows its target; the two transports must give the same boxes. Prints the
figures; exit code 1 and the reason when something is not as it should be.
"""

import json
import pathlib
import sys

STATES = {"tracking", "uncertain", "searching", "lost"}
SENSORS = {"rgb", "thermal"}
# The shipped model reaches 0.63 to 0.70 on these clips; a box that stands still gets 0.10 to 0.14.
FLOOR = 0.5


def demand(condition, message):
    if not condition:
        sys.exit(f"  FAILED: {message}")


def runs_of(experiment, anchors):
    """Names of the runs of a sequence, with their numbers of frames."""
    if experiment != "baseline":
        return {"001": len(anchors)}
    runs = {}
    for frame, anchor in enumerate(anchors):
        if anchor:
            runs[f"{frame:08d}"] = len(anchors) - frame if anchor > 0 else frame + 1
    return runs


def check_run(folder, name, frames):
    boxes = (folder / f"{name}.txt").read_text().split()
    demand(len(boxes) == frames, f"{folder}/{name}.txt has {len(boxes)} of {frames} regions")
    # The first is the toolkit's mark of an initialisation, "1".
    demand(boxes[0] == "1", f"{folder}/{name}.txt begins with {boxes[0]}")
    demand(all(b.count(",") == 3 for b in boxes[1:]), f"{folder}/{name}.txt: not all are rectangles")

    def values(what):
        lines = (folder / f"{name}_{what}.value").read_text().splitlines()
        demand(len(lines) == frames, f"{folder}/{name}_{what}.value has {len(lines)} of {frames} lines")
        return [line for line in lines[1:] if line]

    confidence = values("confidence")
    demand(len(confidence) == frames - 1, f"{folder}/{name}: confidences are missing")
    demand(all(0 <= float(v) <= 1 for v in confidence), f"{folder}/{name}: a confidence is out of range")
    demand(set(values("state")) <= STATES, f"{folder}/{name}: unknown states")
    sensors = set(values("modality"))
    demand(sensors and sensors <= SENSORS, f"{folder}/{name}: unknown sensors")
    return sensors


def main():
    if len(sys.argv) < 4:
        sys.exit(__doc__)
    workspace, frames, trackers = pathlib.Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]
    sequences = (workspace / "sequences" / "list.txt").read_text().split()
    experiments = ["ope", "baseline", "realtime", "supervised"]
    count, sensors = 0, {}
    for tracker in trackers:
        for experiment in experiments:
            for sequence in sequences:
                anchors = (workspace / "sequences" / sequence / "anchor.value").read_text().split()
                folder = workspace / "results" / tracker / experiment / sequence
                for run, length in runs_of(experiment, [int(a) for a in anchors]).items():
                    demand(len(anchors) == frames, f"{sequence} has {len(anchors)} frames")
                    try:
                        seen = check_run(folder, f"{sequence}_{run}", length)
                    except OSError as error:
                        demand(False, f"a result is missing: {error}")
                    sensors[tracker, experiment, sequence] = seen
                    count += 1
    print(f"  {count} runs complete")

    demand(sensors["TsdaRgbt", "ope", "rgbt"] == SENSORS, "the policy did not leave the visible camera at night")
    demand(sensors["TsdaColor", "ope", "switch"] == SENSORS, "the sensors of the color channel are not told apart")
    for sequence in sequences:
        name = f"ope/{sequence}/{sequence}_001.txt"
        pair = [(workspace / "results" / t / name).read_text() for t in ("TsdaColor", "TsdaSocket")]
        demand(pair[0] == pair[1], f"{name} depends on the transport or the version")
    print("  pipes with version 4 and a socket with version 3 give the same boxes")

    results = json.loads((workspace / "analysis" / "figures.json").read_text())["results"]
    for experiment in experiments:
        figures = [v[0] for v in results[experiment]["results"][0]]
        demand(len(figures) == len(trackers), f"{experiment}: figures of {len(figures)} trackers")
        text = ", ".join(f"{t} {v:.3f}" for t, v in zip(trackers, figures))
        print(f"  {experiment} accuracy: {text}")
        # Real time depends on how busy this machine is.
        if experiment != "realtime":
            demand(min(figures) > FLOOR, f"{experiment}: an accuracy is not above {FLOOR}")


if __name__ == "__main__":
    main()
