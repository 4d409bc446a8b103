//! The program `tsda-train` from outside, on a tiny network and a handful of generated pictures.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

/// A folder with generated pairs and a configuration that trains on them.
struct Bench {
    dir: tempfile::TempDir,
}

const CONFIG: &str = r#"
[model]
preset = "nano"
crop = 64
width = 16
heads = 2
feed_forward = 16
encoder_layers = 1
decoder_layers = 1
ltrb_hidden = 8
backbone = { res_net = { base_channels = 4, blocks = [1, 1, 1] } }

[[data]]
kind = "pairs"
path = "pairs"

[processing]
grayscale_p = 0.2
[processing.template]
scale = 0.1
centre = 0.5
[processing.search]
scale = 0.2
centre = 2.0
aspect = 0.1
[processing.thermal]
gamma = 0.3
invert_p = 0.3
noise_p = 0.5
noise_sigma = 5.0

[optim]
lr_head = 1e-3
lr_backbone = 1e-3
warmup_steps = 2
freeze = "none"
clip_norm = 1000.0
ema_decay = 0.9

[run]
steps = 6
batch = 2
workers = 2
out = "out"
checkpoint_every = 2
keep = 2
log_every = 1
validate_every = 3
validation_samples = 4
"#;

impl Bench {
    fn new() -> Self {
        let this = Self { dir: tempfile::tempdir().unwrap() };
        let mut pairs = Vec::new();
        for i in 0..4u32 {
            for (sensor, gain) in [("visible", 1), ("infrared", 2)] {
                let folder = this.path("pairs").join(sensor);
                std::fs::create_dir_all(&folder).unwrap();
                let picture = image::GrayImage::from_fn(96, 80, |x, y| {
                    image::Luma([((x / 4 * 37 + y / 4 * 61 + i * 17) * gain % 200) as u8])
                });
                picture.save(folder.join(format!("{i}.png"))).unwrap();
            }
            let split = if i == 3 { "val" } else { "train" };
            pairs.push(serde_json::json!({
                "id": format!("p{i}"), "split": split,
                "visible": format!("visible/{i}.png"), "infrared": format!("infrared/{i}.png"),
                "width": 96, "height": 80,
                "boxes": [{ "xywh": [30.0 + f64::from(i), 25.0, 20.0, 24.0], "cls": "thing" }],
            }));
        }
        let index = serde_json::json!({ "pairs": pairs });
        std::fs::write(this.path("pairs/index.json"), index.to_string()).unwrap();
        this.config("c.toml", CONFIG);
        this
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn config(&self, name: &str, text: &str) {
        std::fs::write(self.path(name), text).unwrap();
    }

    fn command(&self, config: &str, out: &str, more: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_tsda-train"));
        command
            .current_dir(self.dir.path())
            .args(["fit", "--config", config, "--out", out])
            .args(more)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        command
    }

    fn fit(&self, config: &str, out: &str, more: &[&str]) -> Output {
        self.command(config, out, more).output().unwrap()
    }

    /// Runs, expects success, returns the final weights.
    fn trained(&self, config: &str, out: &str, more: &[&str]) -> Vec<u8> {
        let output = self.fit(config, out, more);
        assert!(output.status.success(), "{}", text(&output));
        std::fs::read(self.path(out).join("model.safetensors")).unwrap()
    }

    /// Runs, expects exit code 2 and one line that contains all of `wanted`.
    fn refused(&self, config: &str, out: &str, more: &[&str], wanted: &[&str]) {
        let output = self.fit(config, out, more);
        let all = text(&output);
        assert_eq!(output.status.code(), Some(2), "{all}");
        assert_eq!(all.trim().lines().count(), 1, "{all}");
        for w in wanted {
            assert!(all.contains(w), "no '{w}' in: {all}");
        }
        assert!(!all.contains("panicked"), "{all}");
    }
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

fn log(out: &Path) -> Vec<serde_json::Value> {
    let text = std::fs::read_to_string(out.join("log.jsonl")).unwrap_or_default();
    text.lines().filter_map(|l| serde_json::from_str(l).ok()).collect()
}

fn wait_for(what: &str, mut ready: impl FnMut() -> bool) {
    let start = Instant::now();
    while !ready() {
        assert!(start.elapsed() < Duration::from_secs(60), "waited too long for {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_run_in_two_halves_ends_with_the_same_bits_whatever_the_workers() {
    let bench = Bench::new();
    let whole = bench.trained("c.toml", "whole", &[]);

    // Stopped between two checkpoints of the schedule, resumed with one worker.
    let stopped = bench.fit("c.toml", "halves", &["--stop-after", "3"]);
    assert!(stopped.status.success() && text(&stopped).contains("stopped after step 3"));
    assert!(!bench.path("halves/model.safetensors").exists());
    bench.config("one.toml", &CONFIG.replace("workers = 2", "workers = 1"));
    assert!(bench.trained("one.toml", "halves", &["--resume"]) == whole);

    // Another seed is another run, so the comparison above can fail.
    bench.config("seed.toml", &CONFIG.replace("[run]", "[run]\nseed = 2"));
    assert!(bench.trained("seed.toml", "seed", &[]) != whole);

    // What a run leaves behind.
    let out = bench.path("whole");
    let names: Vec<String> = ["checkpoint-000004", "checkpoint-000006", "config.resolved.toml"]
        .map(String::from)
        .to_vec();
    for name in &names {
        assert!(out.join(name).exists(), "{name} is missing");
    }
    assert!(!out.join("checkpoint-000002").exists(), "keep = 2");
    let entries = log(&out);
    let count = |event: &str| entries.iter().filter(|e| e["event"] == event).count();
    assert_eq!((count("start"), count("train"), count("validation")), (1, 6, 2));
    let validation = entries.iter().find(|e| e["event"] == "validation").unwrap();
    assert!(validation["cross"]["iou"].is_number() && validation["same"]["cls"].is_number());
    let events = std::fs::read_dir(&out)
        .unwrap()
        .map(|e| e.unwrap().path())
        .find(|p| p.to_string_lossy().contains("tfevents"))
        .unwrap();
    let scalars = tsda_trainer::logging::read_events(&events).unwrap();
    assert_eq!(scalars.iter().filter(|(_, tag, _)| tag == "train/loss").count(), 6);
    assert!(scalars.iter().any(|(step, tag, _)| *step == 6 && tag == "validation/cross/iou"));
    // The resolved configuration trains the same network.
    bench.config("again.toml", &std::fs::read_to_string(out.join("config.resolved.toml")).unwrap());
    assert!(bench.trained("again.toml", "again", &[]) == whole);
}

#[test]
fn a_run_with_several_batches_per_step_resumes_to_the_bit() {
    let bench = Bench::new();
    let three = CONFIG.replace("batch = 2", "batch = 2\naccumulate = 3");
    bench.config("three.toml", &(three + "[align]\npreset = \"joint\"\nstart_step = 1\n"));
    let whole = bench.trained("three.toml", "whole", &[]);
    let stopped = bench.fit("three.toml", "halves", &["--stop-after", "3"]);
    assert!(stopped.status.success(), "{}", text(&stopped));
    assert!(bench.trained("three.toml", "halves", &["--resume"]) == whole);
    let entries = log(&bench.path("whole"));
    assert_eq!(entries.iter().filter(|e| e["event"] == "train").count(), 6, "optimiser steps");
    assert_eq!((&entries[0]["batch"], &entries[0]["accumulate"]), (&2.into(), &3.into()));

    // The command line says the same as the file, and other numbers train other weights.
    bench
        .config("one.toml", &(CONFIG.to_owned() + "[align]\npreset = \"joint\"\nstart_step = 1\n"));
    assert!(bench.trained("one.toml", "flag", &["--accumulate", "3"]) == whole);
    assert!(bench.trained("one.toml", "one", &[]) != whole);

    bench.refused("one.toml", "o", &["--accumulate", "0"], &["run.accumulate = 0"]);
    bench.refused("one.toml", "o", &["--devices", "2"], &["--devices 2", "the CPU is one device"]);
    for device in ["wgpu", "cuda"].into_iter().filter(|d| !has(d)) {
        bench.refused("one.toml", "o", &["--device", device], &[device, "built without"]);
    }
}

/// Was the program built with this device?
fn has(device: &str) -> bool {
    (device == "wgpu" && cfg!(feature = "wgpu")) || (device == "cuda" && cfg!(feature = "cuda"))
}

#[cfg(feature = "wgpu")]
#[test]
fn a_run_on_a_graphics_device_stopped_and_resumed_goes_where_the_cpu_goes() {
    let bench = Bench::new();
    // Generators of random numbers differ, so one start for both, and no dropout.
    bench.trained("c.toml", "start", &["--steps", "1"]);
    let config = CONFIG.replace("[optim]", "[optim]\ndropout = 0.0\nattention_dropout = 0.0")
        + "[init]\nweights = \"start/model.safetensors\"\n";
    bench.config("same.toml", &config);
    bench.trained("same.toml", "cpu", &["--accumulate", "2"]);
    let flags = |last: &[&'static str]| [&["--device", "wgpu", "--accumulate", "2"], last].concat();
    let stopped = bench.fit("same.toml", "gpu", &flags(&["--stop-after", "3"]));
    let all = text(&stopped);
    if all.contains("no usable graphics device") && std::env::var_os("TSDA_REQUIRE_WGPU").is_none()
    {
        println!("skipped: {all}");
        return;
    }
    assert!(stopped.status.success(), "{all}");
    bench.trained("same.toml", "gpu", &flags(&["--resume"]));
    let figures = |out: &str| -> Vec<(String, f64)> {
        let entries = log(&bench.path(out));
        let trained = entries.iter().filter(|e| e["event"] == "train");
        let validated = entries.iter().filter(|e| e["event"] == "validation");
        let of = |what: &str, e: &serde_json::Value, value: &serde_json::Value| {
            (format!("{what} at step {}", e["step"]), value.as_f64().unwrap())
        };
        trained
            .map(|e| of("loss", e, &e["loss"]))
            .chain(validated.map(|e| of("validation", e, &e["all"]["giou"])))
            .collect()
    };
    let (cpu, gpu) = (figures("cpu"), figures("gpu"));
    assert_eq!((cpu.len(), gpu.len()), (8, 8));
    for ((what, cpu), (_, gpu)) in cpu.iter().zip(&gpu) {
        println!("{what}: {gpu:.6} against {cpu:.6} on the CPU");
        assert!((gpu - cpu).abs() <= 1e-2 * cpu, "{what}: {gpu} against {cpu}");
    }
}

#[test]
fn a_damaged_newest_checkpoint_and_leftovers_do_not_stop_a_resume() {
    let bench = Bench::new();
    let whole = bench.trained("c.toml", "whole", &[]);
    let out = bench.path("out");
    assert!(bench.fit("c.toml", "out", &["--stop-after", "4"]).status.success());
    std::fs::write(out.join("checkpoint-000004/optim.bpk"), b"half a file").unwrap();
    let partial = out.join(".checkpoint-000006.partial");
    std::fs::create_dir(&partial).unwrap();
    std::fs::write(partial.join("model.bpk"), b"half a file").unwrap();
    let output = bench.fit("c.toml", "out", &["--resume"]);
    let all = text(&output);
    assert!(output.status.success(), "{all}");
    assert!(all.contains("checkpoint-000004") && all.contains("damaged"), "{all}");
    assert!(all.contains("resumed from") && all.contains("checkpoint-000002"), "{all}");
    assert!(!partial.exists());
    assert!(std::fs::read(out.join("model.safetensors")).unwrap() == whole);
}

#[cfg(unix)]
#[test]
fn ctrl_c_saves_and_a_kill_keeps_the_last_checkpoint() {
    let bench = Bench::new();
    let config = CONFIG
        .replace("steps = 6", "steps = 100000")
        .replace("validate_every = 3", "validate_every = 0");
    bench.config("long.toml", &config);
    let out = bench.path("long");

    let child = bench.command("long.toml", "long", &[]).spawn().unwrap();
    wait_for("the third step", || log(&out).iter().any(|e| e["step"] == 3));
    let sent = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
    let output = child.wait_with_output().unwrap();
    let all = text(&output);
    assert_eq!(output.status.code(), Some(0), "{all}");
    assert!(all.contains("stopped after step"), "{all}");
    let step = log(&out).iter().filter_map(|e| e["step"].as_u64()).max().unwrap();
    assert!(out.join(format!("checkpoint-{step:06}/manifest.json")).exists(), "step {step}");

    // Resumed, then killed without warning while it writes a checkpoint every other step.
    let mut child = bench.command("long.toml", "long", &["--resume"]).spawn().unwrap();
    wait_for("more steps", || log(&out).iter().any(|e| e["step"].as_u64() > Some(step + 6)));
    child.kill().unwrap();
    child.wait().unwrap();
    let store = tsda_trainer::checkpoint::CheckpointStore::new(&out, 2);
    let latest = store.latest().unwrap().checkpoint.unwrap();
    assert!(latest.step >= step + 4, "{} {step}", latest.step);
    let stop = (latest.step + 1).to_string();
    let output = bench.fit("long.toml", "long", &["--resume", "--stop-after", &stop]);
    assert!(output.status.success(), "{}", text(&output));
    assert!(text(&output).contains(&format!("stopped after step {stop}")));
}

#[test]
fn bad_input_is_refused_in_one_line_and_leaves_nothing_behind() {
    let bench = Bench::new();
    let swap = |name: &str, from: &str, to: &str| {
        assert!(CONFIG.contains(from));
        bench.config(name, &CONFIG.replace(from, to));
    };
    bench.refused("none.toml", "o", &[], &["none.toml"]);
    swap("key.toml", "batch = 2", "batches = 2");
    bench.refused("key.toml", "o", &[], &["key.toml, line", "batches"]);
    swap("nan.toml", "lr_head = 1e-3", "lr_head = nan");
    bench.refused("nan.toml", "o", &[], &["nan.toml, line", "optim.lr_head"]);
    swap("inf.toml", "centre = 2.0", "centre = inf");
    bench.refused("inf.toml", "o", &[], &["processing.search.centre"]);
    bench.refused("c.toml", "o", &["--data", "nowhere"], &["nowhere"]);
    bench.refused("c.toml", "o", &["--steps", "0", "--data", "nowhere"], &["nowhere"]);
    let scratch =
        ["missing.safetensors", "init.backbone", "scratch", "fetch_efficientnet_lite0.py"];
    bench.refused("c.toml", "o", &["--backbone", "missing.safetensors"], &scratch);
    std::fs::write(bench.path("broken.safetensors"), b"not weights").unwrap();
    bench.refused("c.toml", "o", &["--backbone", "broken.safetensors"], &["broken.safetensors"]);
    swap("split.toml", "path = \"pairs\"", "path = \"pairs\"\nsplit = \"trian\"");
    bench.refused("split.toml", "o", &[], &["data.0.split", "trian"]);
    assert!(!bench.path("o").exists(), "a refused run wrote something");

    // A picture that cannot be decoded, met while training.
    for i in 0..3 {
        std::fs::write(bench.path(&format!("pairs/visible/{i}.png")), b"no picture").unwrap();
    }
    let output = bench.fit("c.toml", "o", &[]);
    assert_eq!(output.status.code(), Some(2));
    assert!(
        text(&output).contains("visible/") && text(&output).contains("decode"),
        "{}",
        text(&output)
    );
}

#[test]
fn an_existing_run_is_not_trained_over_and_another_network_not_resumed() {
    let bench = Bench::new();
    bench.trained("c.toml", "out", &["--steps", "2"]);
    bench.refused("c.toml", "out", &[], &["--resume", "already holds checkpoints"]);
    bench.config("wide.toml", &CONFIG.replace("width = 16", "width = 32"));
    bench.refused("wide.toml", "out", &["--resume"], &["checkpoint-000002", "[model]"]);
    // Resuming a finished run is no error, and other settings are pointed out.
    let output = bench.fit("c.toml", "out", &["--resume"]);
    assert!(output.status.success() && text(&output).contains("warning: run.steps differs"));
}

#[test]
fn a_diverged_run_stops_and_names_its_samples() {
    let bench = Bench::new();
    let wild = CONFIG
        .replace("lr_head = 1e-3", "lr_head = 1.0")
        .replace("[optim]", "[loss]\ncls = 1e6\nreg = 1e6\n[optim]")
        .replace("steps = 6", "steps = 400");
    bench.config("wild.toml", &wild);
    let output = bench.fit("wild.toml", "out", &[]);
    let all = text(&output);
    assert_eq!(output.status.code(), Some(2), "{all}");
    let entries = log(&bench.path("out"));
    let bad = entries.iter().find(|e| e["event"] == "not_finite").unwrap();
    assert_eq!(bad["ids"].as_array().unwrap().len(), 2);
    assert!(all.contains("the last checkpoint is intact") && all.contains("p"), "{all}");
}

#[test]
fn the_sample_sheet_is_a_picture() {
    let bench = Bench::new();
    let run = |config: &str| {
        Command::new(env!("CARGO_BIN_EXE_tsda-train"))
            .current_dir(bench.dir.path())
            .args(["sample-sheet", "--config", config, "--out", "s.png", "--samples", "3"])
            .output()
            .unwrap()
    };
    let output = run("c.toml");
    assert!(output.status.success(), "{}", text(&output));
    let sheet = image::open(bench.path("s.png")).unwrap();
    assert_eq!((sheet.width(), sheet.height()), (3 * 68 + 4, 3 * 68 + 4));
    assert_eq!(run("none.toml").status.code(), Some(2));
}

/// The configuration with alignment in force from step 4 of 20.
fn aligned() -> String {
    let config = CONFIG
        .replace("steps = 6", "steps = 20")
        .replace("validate_every = 3", "validate_every = 10");
    config + "[align]\npreset = \"joint\"\nstart_step = 4\nramp_steps = 5\nlr = 2e-3\n"
}

#[test]
fn a_run_with_alignment_resumes_to_the_bit_and_leaves_nothing_in_its_weights() {
    let bench = Bench::new();
    bench.config("joint.toml", &aligned());
    let whole = bench.trained("joint.toml", "whole", &[]);
    let stopped = bench.fit("joint.toml", "halves", &["--stop-after", "10"]);
    assert!(stopped.status.success(), "{}", text(&stopped));
    assert!(bench.trained("joint.toml", "halves", &["--resume"]) == whole);
    // The branches too, and their optimiser: one more look at the files they are kept in.
    for file in ["model.bpk", "ema.bpk", "align.bpk", "align_optim.bpk", "model.safetensors"] {
        assert!(bench.path("whole/checkpoint-000020").join(file).exists(), "{file}");
    }
    let tail = |out: &str| -> Vec<String> {
        let entries = log(&bench.path(out));
        let trained = entries.iter().filter(|e| e["event"] == "train" && e["step"] == 20);
        trained.flat_map(|e| ALIGN_FIGURES.map(|n| e[n].to_string())).collect()
    };
    assert_eq!(tail("whole"), tail("halves"));

    // Figures are there from the first step with alignment on, in both logs and on the page.
    let entries = log(&bench.path("whole"));
    for e in entries.iter().filter(|e| e["event"] == "train") {
        let on = e["step"].as_u64() > Some(4);
        assert!(ALIGN_FIGURES.iter().all(|n| e[n].is_number() == on), "{e}");
    }
    let events = std::fs::read_dir(bench.path("whole"))
        .unwrap()
        .map(|e| e.unwrap().path())
        .find(|p| p.to_string_lossy().contains("tfevents"))
        .unwrap();
    let scalars = tsda_trainer::logging::read_events(&events).unwrap();
    for name in ALIGN_FIGURES {
        let tag = format!("train/{name}");
        assert_eq!(scalars.iter().filter(|(_, t, _)| *t == tag).count(), 16, "{name}");
    }
    let page = std::fs::read_to_string(bench.path("whole/training.html")).unwrap();
    assert!(page.contains("Discriminator accuracy") && page.contains("joint from step 4"));

    // A row without alignment has the same start, other weights, and tensors of the same names.
    let cm = bench.trained("joint.toml", "cm", &["--align-preset", "cm"]);
    let losses = |out: &str| -> Vec<String> {
        let entries = log(&bench.path(out));
        entries.iter().filter(|e| e["event"] == "train").map(|e| e["loss"].to_string()).collect()
    };
    assert_eq!(losses("cm")[..4], losses("whole")[..4]);
    assert!(cm != whole);
    let shapes = |bytes: &[u8]| -> Vec<(String, Vec<usize>)> {
        let tensors = safetensors::SafeTensors::deserialize(bytes).unwrap();
        let mut all: Vec<_> =
            tensors.tensors().into_iter().map(|(n, t)| (n, t.shape().to_vec())).collect();
        all.sort();
        all
    };
    assert_eq!(shapes(&cm), shapes(&whole));
    // Bytes as well: no metadata either.
    assert_eq!(cm.len(), whole.len());

    // Alignment can be added to a checkpoint without; other branches cannot take its place.
    let output = bench.fit("joint.toml", "cm", &["--resume"]);
    let all = text(&output);
    assert!(output.status.success(), "{all}");
    assert!(all.contains("the branches start fresh") && all.contains("align differs"), "{all}");
    bench.config("other.toml", &(aligned() + "[align.adversarial]\nhidden = [5]\n"));
    bench.refused("other.toml", "whole", &["--resume"], &["checkpoint-000020", "[align]"]);
}

const ALIGN_FIGURES: [&str; 7] = [
    "adversarial",
    "adversarial_pull",
    "contrastive",
    "contrastive_pull",
    "discriminator_accuracy",
    "discriminator_grad_norm",
    "projection_grad_norm",
];

#[test]
fn every_row_of_the_ablation_trains_from_the_command_line() {
    let bench = Bench::new();
    let config = CONFIG
        .replace("validate_every = 3", "validate_every = 4")
        .replace("validation_samples = 4", "validation_samples = 16");
    bench.config("rows.toml", &config);
    let mut seen = std::collections::BTreeSet::new();
    for row in ["baseline", "cm", "pre-afa", "pre-cfa", "enc-afa", "enc-cfa", "joint"] {
        let more = ["--align-preset", row, "--align-start", "1", "--steps", "4", "--seed", "3"];
        let weights = bench.trained("rows.toml", row, &more);
        assert!(seen.insert(weights), "{row} trains like another row");
        let entries = log(&bench.path(row));
        // Every row is validated on the same samples, those across sensors included.
        let validation = entries.iter().find(|e| e["event"] == "validation").unwrap();
        let counts = ["same", "cross"].map(|g| validation[g]["samples"].as_u64().unwrap());
        assert!(counts[0] > 0 && counts[1] > 0, "{row}: {counts:?}");
        let last = entries.iter().rfind(|e| e["event"] == "train").unwrap();
        let has = |name: &str| last[name].is_number();
        assert_eq!(has("adversarial"), row.contains("afa") || row == "joint", "{row}");
        assert_eq!(has("contrastive"), row.contains("cfa") || row == "joint", "{row}");
    }
    bench.refused("rows.toml", "o", &["--align-preset", "joint"], &["align.start_epoch", "step"]);
}
