#!/usr/bin/env python3
"""Trains and evaluates every row of the alignment ablation and writes the table.

    python3 trainer/scripts/ablation.py --config trainer/configs/ablation.toml \
        --pairs data/pairs --clips data/sequences --bin target/release --out out/ablation \
        [--rows cm,enc-cfa --seeds 1,2] [--data-root DIR] [--backbone FILE] [--jobs 2]

Runs `tsda-train fit`, `tsda-export build`, `tsda eval` (RGB->T, T->RGB, Switch) on the validation
split of the pairs as moving clips and of the clips, and `tsda-train align-report`, for each row and
seed. A finished step is not repeated, an interrupted training goes on from its checkpoint: call it
again. Rows are run in the order seed by seed, so that a stopped experiment has whole seeds.
Writes OUT/results.json and OUT/table.md after every run. The last table is the difference of every
row to CM on the same targets and seeds, with an interval by drawing pictures with replacement: targets
of one picture are not independent.
"""

import argparse
import json
import pathlib
import random
import statistics
import subprocess
import sys
import time

ROWS = ["baseline", "cm", "pre-afa", "pre-cfa", "enc-afa", "enc-cfa", "joint"]
PROTOCOLS = ["rgb2t", "t2rgb", "switch:20"]
KEYS = ["sr50", "pr20", "auc"]


def call(command, log):
    began = time.time()
    with open(log, "a") as out:
        out.write("$ " + " ".join(map(str, command)) + "\n")
        out.flush()
        code = subprocess.run([str(c) for c in command], stdout=out, stderr=out).returncode
    return code, time.time() - began


def require(command, log, accepted=(0,)):
    code, seconds = call(command, log)
    if code not in accepted:
        sys.exit(f"ablation: {command[0]} {command[1]} ended with {code}; see {log}")
    return seconds


def one(args, row, seed):
    out = args.out / f"{row}-s{seed}"
    done = out / "figures.json"
    if done.exists():
        return json.loads(done.read_text())
    out.mkdir(parents=True, exist_ok=True)
    log, run = out / "commands.log", out / "run"
    train, export, tsda = (args.bin / n for n in ("tsda-train", "tsda-export", "tsda"))
    if not (run / "model.safetensors").exists():
        command = [train, "fit", "--config", args.config, "--out", run]
        command += ["--align-preset", row, "--seed", seed, "--align-start", args.align_start]
        command += ["--data-root", args.data_root] if args.data_root else []
        command += ["--backbone", args.backbone] if args.backbone else []
        command += ["--resume"] if any(run.glob("checkpoint-*")) else []
        require(command, log)
    if not (run / "model.safetensors").exists():
        sys.exit(f"ablation: {row}, seed {seed} was stopped; call again to go on")
    bundle = out / f"{row}-s{seed}.tsda"
    resolved = run / "config.resolved.toml"
    require([export, "build", "--weights", run / "model.safetensors", "--config", resolved, "--out", bundle], log)
    figures = {"row": row, "seed": seed, "sets": {}}
    for name, dataset in (("pairs", f"pseudo:{args.pairs}@val"), ("clips", f"sequences:{args.clips}@val")):
        command = [tsda, "eval", "--bundle", bundle, "--dataset", dataset, "--out", out / name, "--jobs", args.jobs]
        for protocol in PROTOCOLS:
            command += ["--protocol", protocol]
        require(command, log)
        protocols = json.loads((out / name / "summary.json").read_text())["protocols"]
        figures["sets"][name] = {p: {k: protocols[p][k] for k in KEYS} for p in PROTOCOLS}
    command = [train, "align-report", "--config", resolved, "--weights", run / "model.safetensors"]
    require(command + ["--data", f"pairs:{args.pairs}@val", "--out", out / "align"], log)
    figures["align"] = json.loads((out / "align" / "align.json").read_text())
    done.write_text(json.dumps(figures, indent=1) + "\n")
    return figures


def find(tree, key):
    """First value under `key`, however deep."""
    if isinstance(tree, dict):
        if key in tree:
            return tree[key]
        tree = list(tree.values())
    if isinstance(tree, list):
        for item in tree:
            found = find(item, key)
            if found is not None:
                return found
    return None


def number(value):
    """A figure of align.json, which may stand with its interval."""
    if isinstance(value, dict):
        value = value.get("value", value.get("mean"))
    return value if isinstance(value, (int, float)) else None


def cell(values, factor=100.0, digits=1):
    values = [factor * v for v in values if v is not None]
    if not values:
        return "-"
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    return f"{statistics.mean(values):.{digits}f} ± {(max(values) - min(values)) / 2:.{digits}f}"


def table(results):
    lines = []
    for name, title in (("pairs", "Validation pairs as clips"), ("clips", "Real clips")):
        lines += [f"**{title}**", ""]
        heads = [f"{p} {h}" for p in PROTOCOLS for h in ("SR0.5", "PR20", "AUC")]
        lines += ["| row | seeds | " + " | ".join(heads) + " |", "|---|---:|" + "---:|" * len(heads)]
        for row in ROWS:
            runs = [r for r in results if r["row"] == row]
            if not runs:
                continue
            cells = [cell([r["sets"][name][p][k] for r in runs]) for p in PROTOCOLS for k in KEYS]
            lines.append(f"| {row} | {len(runs)} | " + " | ".join(cells) + " |")
        lines.append("")
    lines += ["**Alignment** (validation pairs)", "", "| row | R_pre | R_post |", "|---|---:|---:|"]
    for row in ROWS:
        runs = [r for r in results if r["row"] == row]
        if runs:
            cells = [cell([number(find(r["align"], k)) for r in runs], 1.0, 3) for k in ("r_pre", "r_post")]
            lines.append(f"| {row} | " + " | ".join(cells) + " |")
    spread = "Mean and half the range over the seeds; SR0.5, PR20 and AUC in per cent."
    return "\n".join(lines + ["", spread, ""])


def targets(out, row, seed, protocol):
    """SR0.5 of every validation target, or nothing if that run is not there."""
    summary = out / f"{row}-s{seed}" / "pairs" / "summary.json"
    if not summary.exists():
        return {}
    found = json.loads(summary.read_text())["protocols"][protocol]["targets"]
    return {name: figures["sr50"] for name, figures in found.items()}


def interval(differences, draws=10_000):
    """Mean of {target: difference} and its 95 % interval over pictures (`picture.number` are targets)."""
    pictures = {}
    for target, difference in differences.items():
        pictures.setdefault(target.rsplit(".", 1)[0], []).append(difference)
    sums = [(sum(d), len(d)) for d in pictures.values()]
    dice, means = random.Random(1), []
    for _ in range(draws):
        drawn = dice.choices(sums, k=len(sums))
        means.append(sum(s for s, _ in drawn) / sum(n for _, n in drawn))
    means.sort()
    mean = statistics.mean(differences.values())
    return mean, means[int(0.025 * draws)], means[int(0.975 * draws) - 1]


def against_cm(out, results):
    """Table of the differences to CM, seed by seed on the same targets."""
    seeds = {row: sorted(s for r, s in results if r == row) for row in ROWS}
    lines = ["**Against CM** (validation pairs, SR0.5 in points, 95 % interval over pictures)", ""]
    lines += ["| row | seeds | " + " | ".join(PROTOCOLS) + " | all three |", "|---|---:|" + "---:|" * 4]
    for row in ROWS:
        common = [s for s in seeds[row] if s in seeds["cm"]]
        if row == "cm" or not common:
            continue
        cells, every = [], {}
        for protocol in PROTOCOLS:
            gained = {}
            for seed in common:
                base = targets(out, "cm", seed, protocol)
                for name, value in targets(out, row, seed, protocol).items():
                    gained.setdefault(name, []).append(100.0 * (value - base[name]))
            gained = {name: statistics.mean(values) for name, values in gained.items()}
            for name, value in gained.items():
                every.setdefault(name, []).append(value)
            cells.append(gained)
        cells.append({name: statistics.mean(values) for name, values in every.items()})
        texts = ["{:+.1f} ({:+.1f}..{:+.1f})".format(*interval(c)) if c else "-" for c in cells]
        lines.append(f"| {row} | {len(common)} | " + " | ".join(texts) + " |")
    return "\n".join(lines + [""])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=pathlib.Path, required=True)
    parser.add_argument("--pairs", type=pathlib.Path, required=True)
    parser.add_argument("--clips", type=pathlib.Path, required=True)
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="folder of tsda, tsda-train, tsda-export")
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--rows", default=",".join(ROWS))
    parser.add_argument("--seeds", default="1")
    parser.add_argument("--align-start", type=int, default=300, help="step from which alignment acts")
    parser.add_argument("--data-root", type=pathlib.Path)
    parser.add_argument("--backbone", type=pathlib.Path)
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    rows = args.rows.split(",")
    if unknown := [r for r in rows if r not in ROWS]:
        sys.exit(f"ablation: no row {unknown[0]!r}; rows are {', '.join(ROWS)}")
    args.out.mkdir(parents=True, exist_ok=True)
    results = {}
    for path in sorted(args.out.glob("*/figures.json")):
        found = json.loads(path.read_text())
        results[found["row"], found["seed"]] = found
    for seed in map(int, args.seeds.split(",")):
        for row in rows:
            results[row, seed] = one(args, row, seed)
            print(f"{row} seed {seed}: " + json.dumps(results[row, seed]["sets"]), flush=True)
            ordered = list(results.values())
            (args.out / "results.json").write_text(json.dumps(ordered, indent=1) + "\n")
            text = table(ordered) + "\n" + against_cm(args.out, results)
            (args.out / "table.md").write_text(text)


if __name__ == "__main__":
    main()
