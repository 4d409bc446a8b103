//! Two recorded runs of the reference tracker with scripted maps, frame by frame.

use super::*;
use crate::testing::{ScriptedEngine, floats, golden_json, golden_tensors, recipe};
use serde_json::Value;

fn close(what: &str, found: &[f32], want: &Value, tolerance: f64) {
    let want = match want {
        Value::Array(_) => floats(want),
        number => vec![number.as_f64().unwrap()],
    };
    assert_eq!(found.len(), want.len(), "{what}");
    for (a, b) in found.iter().zip(&want) {
        assert!((f64::from(*a) - b).abs() <= tolerance, "{what}: {found:?} instead of {want:?}");
    }
}

fn yx(v: Yx) -> [f32; 2] {
    [v.y, v.x]
}

fn xywh(b: BBox) -> [f32; 4] {
    [b.x, b.y, b.w, b.h]
}

/// Mean of the crop in grey levels.
fn grey_mean(engine: &ScriptedEngine) -> f32 {
    let plane = engine.crop.len() / 3;
    let sum: f64 = engine
        .crop
        .iter()
        .enumerate()
        .map(|(i, v)| {
            let (mean, std) = (engine.spec.input_mean[i / plane], engine.spec.input_std[i / plane]);
            f64::from((v * std + mean) * 255.0)
        })
        .sum();
    (sum / engine.crop.len() as f64) as f32
}

fn label_figures(engine: &ScriptedEngine) -> (f32, usize) {
    let first = |(at, max), (i, &v): (usize, &f32)| if v > max { (i, v) } else { (at, max) };
    let (at, max) = engine.label.iter().enumerate().fold((0, f32::MIN), first);
    (max, at)
}

fn replay(run: &Value) -> usize {
    let tensors = golden_tensors("tracker_script.safetensors");
    let name = run["name"].as_str().unwrap();
    let hw = floats(&run["image_hw"]);
    let (h, w) = (hw[0] as usize, hw[1] as usize);
    let mut tracker =
        Tracker::new(ScriptedEngine::new(ModelSpec::TOMP101), TrackerParams::default()).unwrap();

    let init = &run["init"];
    let b = floats(&run["init_bbox_xywh"]);
    let bbox = BBox::new(b[0] as f32, b[1] as f32, b[2] as f32, b[3] as f32);
    let first = recipe(0, w, h);
    tracker.init(&FrameView::rgb(&first, w, h).unwrap(), bbox, Some(Modality::Rgb)).unwrap();
    let target = tracker.target().unwrap();
    close("pos", &yx(target.pos()), &init["pos_yx"], 1e-4);
    close("size", &yx(target.size()), &init["target_sz_hw"], 1e-4);
    close("scale", &[target.scale()], &init["target_scale"], 1e-6);
    close("base", &yx(target.base()), &init["base_target_sz_hw"], 1e-4);
    let template = tracker.memory().templates()[0];
    close("first box", &xywh(template.bbox), &init["target_box_xywh"], 1e-3);
    close("first crop", &[grey_mean(tracker.engine())], &init["patch_mean"], 1e-3);
    let (max, at) = label_figures(tracker.engine());
    close("first label", &[max], &init["label_max"], 1e-5);
    assert_eq!(at as u64, init["label_argmax"].as_u64().unwrap());

    let frames = run["frames"].as_array().unwrap();
    for f in frames {
        let number = f["frame"].as_u64().unwrap();
        let at = |what: &str| format!("{name}, frame {number}, {what}");
        let map = |kind: &str| tensors[&format!("{name}.f{number}.{kind}")].1.clone();
        tracker.engine_mut().answer = (map("scores"), map("ltrb"));
        let picture = recipe(number as usize, w, h);
        let filled = tracker.memory().filled();
        let track = tracker.update(&FrameView::rgb(&picture, w, h).unwrap(), None).unwrap();

        let search = tracker.last_search().unwrap();
        close(&at("centre"), &yx(search.centre), &f["search_center_yx"], 1e-3);
        close(&at("search scale"), &[search.scale], &f["search_scale"], 1e-5);
        let p = search.patch;
        let corners = [p.tl.y, p.tl.x, p.br.y, p.br.x];
        close(&at("patch"), &corners, &f["patch_coord_y1x1y2x2"], 0.0);
        close(&at("sample pos"), &yx(search.sample_pos), &f["sample_pos_yx"], 1e-4);
        close(&at("sample scale"), &[search.sample_scale], &f["sample_scale"], 1e-5);
        close(&at("crop"), &[grey_mean(tracker.engine())], &f["patch_mean"], 1e-3);
        assert_eq!(track.flag.as_str(), f["flag"].as_str().unwrap(), "{}", at("flag"));
        let cell = [search.located.cell.row as f32, search.located.cell.col as f32];
        close(&at("cell"), &cell, &f["max_disp_rc"], 0.0);
        close(&at("raw box"), &xywh(search.raw), &f["bbox_raw_xywh"], 1e-3);
        close(&at("clipped box"), &xywh(search.clipped), &f["bbox_clipped_xywh"], 1e-3);
        close(&at("score"), &[track.score], &f["object_presence_score"], 1e-6);

        let target = tracker.target().unwrap();
        close(&at("pos"), &yx(target.pos()), &f["pos_yx"], 1e-3);
        close(&at("size"), &yx(target.size()), &f["target_sz_hw"], 1e-3);
        close(&at("scale"), &[target.scale()], &f["target_scale"], 1e-5);
        close(&at("box"), &xywh(track.bbox), &f["output_bbox_xywh"], 1e-3);
        assert_eq!(u64::from(target.not_found()), f["not_found_counter"].as_u64().unwrap());

        let engine = tracker.engine();
        assert_eq!(engine.asked.last(), Some(&filled));
        let memory = &f["memory"];
        assert_eq!(track.wrote_memory, memory.is_object(), "{}", at("memory write"));
        if track.wrote_memory {
            let slot = memory["replaced_slot"].as_u64().unwrap() as usize;
            assert_eq!(engine.written.last(), Some(&slot), "{}", at("slot"));
            let template = tracker.memory().templates()[slot];
            close(&at("template"), &xywh(template.bbox), &memory["target_box_xywh"], 1e-3);
            let held: Vec<f32> =
                tracker.memory().templates().iter().map(|t| t.frame as f32).collect();
            close(&at("slots"), &held, &memory["slots_hold_frame"], 0.0);
            let (max, index) = label_figures(engine);
            close(&at("label"), &[max], &memory["label_max"], 1e-5);
            assert_eq!(index as u64, memory["label_argmax"].as_u64().unwrap());
            if let Some((_, want)) = tensors.get(&format!("{name}.f{number}.new_label")) {
                for (a, b) in engine.label.iter().zip(want) {
                    assert!((a - b).abs() < 2e-5, "{}: {a} {b}", at("new label"));
                }
            }
        }
    }
    frames.len()
}

#[test]
fn the_reference_runs_are_repeated_frame_by_frame() {
    let runs = golden_json("tracker_script.json");
    let frames: Vec<usize> = runs.as_array().unwrap().iter().map(replay).collect();
    assert_eq!(frames, [33, 5]);
}
