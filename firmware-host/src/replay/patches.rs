//! Crops with their pixels, without a tracker: a list of objects with `pixels_at`.

use super::error::ReplayError;
use super::fields::Fields;
use super::report::{Comparer, Report, RunReport};
use super::{GREY_TOLERANCE, POSITION_TOLERANCE};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use tsda_runtime::crop::{self, Border, CropError, Window};
use tsda_runtime::{FrameView, ModelSpec, Yx, probe};

/// Known fields that are not compared: the window's inside, which the pixels give away.
const INSIDE: [&str; 4] =
    ["downsampled_src_hw", "pad_left_right_top_bottom", "patch_hw", "resized"];

/// Whether a file is such a list.
pub(super) fn is_list(value: &Value) -> bool {
    let first = value.as_array().and_then(|list| list.first());
    first.is_some_and(|case| case.get("pixels_at").is_some())
}

/// Cuts every crop and compares it.
pub(super) fn replay(value: &Value, path: &Path) -> Result<Report, ReplayError> {
    let mut report = Report { not_compared: INSIDE.into(), ..Report::default() };
    let mut run = RunReport { name: "crops".into(), ..RunReport::default() };
    let mut pictures: BTreeMap<(usize, usize), Vec<u8>> = BTreeMap::new();
    for (i, case) in value.as_array().into_iter().flatten().enumerate() {
        let mut f = Fields::new(case, path, format!("case {i}"))?;
        let mut compare = Comparer { run: &mut run, frame: i as u64 };
        one(&mut f, &mut compare, &mut pictures)?;
        f.ignore(&INSIDE);
        f.ignore(&["note"]);
        let mut left = BTreeSet::new();
        f.finish(&mut left);
        report.unknown.extend(left);
        run.frames += 1;
    }
    report.runs.push(run);
    Ok(report)
}

fn one(
    f: &mut Fields<'_>,
    compare: &mut Comparer<'_>,
    pictures: &mut BTreeMap<(usize, usize), Vec<u8>>,
) -> Result<(), ReplayError> {
    let size = f.array::<2>("image_hw")?;
    let [h, w] = f.need("image_hw", size)?.map(|v| v as usize);
    if !(1..=16_384).contains(&h) || !(1..=16_384).contains(&w) {
        return Err(f.wrong("image_hw", format!("{h} x {w} is no picture")));
    }
    let pos = f.array::<2>("pos_yx")?;
    let [y, x] = f.need("pos_yx", pos)?.map(|v| v as f32);
    let sample = f.numbers("sample_sz")?;
    let sample = f.need("sample_sz", sample.and_then(|s| s.first().copied()))? as f32;
    let side = f.whole("output_sz")?;
    let side = f.need("output_sz", side)?;
    let crop = u16::try_from(side).ok().filter(|s| (2..=4096).contains(s));
    let crop = crop.ok_or_else(|| f.wrong("output_sz", format!("{side} is no crop")))?;
    let max_scale_change = f.number("max_scale_change")?.unwrap_or(1.0) as f32;
    let mode = f.text("mode")?;
    let border = match f.need("mode", mode)? {
        "replicate" => Border::Replicate,
        "inside" => Border::Inside { max_scale_change },
        "inside_major" => Border::InsideMajor { max_scale_change },
        other => {
            let detail = format!("{other:?} is none of replicate, inside, inside_major");
            return Err(f.wrong("mode", detail));
        }
    };
    let picture = pictures.entry((h, w)).or_insert_with(|| {
        let mut bytes = vec![0; 3 * h * w];
        probe::recipe_image(0, w, h, &mut bytes);
        bytes
    });
    // Grey levels as they are.
    let spec =
        ModelSpec { crop, input_mean: [0.0; 3], input_std: [1.0 / 255.0; 3], ..ModelSpec::TOMP101 };
    let view = FrameView::rgb(picture, w, h)
        .map_err(|source| ReplayError::Picture { run: "crops".into(), source })?;
    let side = usize::from(crop);
    let mut out = vec![0.0; 3 * side * side];
    let cut = |out: &mut [f32]| -> Result<Window, CropError> {
        let window = Window::new(&view, Yx::new(y, x), sample, side, border)?;
        crop::reference(&view, &window, &spec, out)?;
        Ok(window)
    };
    let window = cut(&mut out).map_err(|e| f.wrong("", e.to_string()))?;
    let p = window.patch();
    let want = f.numbers("patch_coord_y1x1y2x2")?;
    let corners = [p.tl.y, p.tl.x, p.br.y, p.br.x];
    let quantity = "position (px)";
    compare.numbers(
        quantity,
        "patch_coord_y1x1y2x2",
        &corners,
        want.as_deref(),
        POSITION_TOLERANCE,
    );
    let mut got = Vec::new();
    for at in f.list("pixels_at")?.into_iter().flatten() {
        let place: Option<Vec<usize>> =
            at.as_array().and_then(|a| a.iter().map(|n| n.as_u64().map(|n| n as usize)).collect());
        let index = match place.as_deref() {
            Some(&[c, row, col]) if c < 3 && row < side && col < side => {
                (c * side + row) * side + col
            }
            _ => return Err(f.wrong("pixels_at", format!("{at} is no [channel, row, column]"))),
        };
        got.push(out[index]);
    }
    let want = f.numbers("pixel_values")?;
    compare.numbers("crop (grey)", "pixel_values", &got, want.as_deref(), GREY_TOLERANCE);
    let sum: f64 = out.iter().map(|v| f64::from(*v)).sum();
    let mean = (sum / out.len() as f64) as f32;
    let want = f.number("patch_mean")?;
    let want = want.as_ref().map(std::slice::from_ref);
    compare.numbers("crop (grey)", "patch_mean", &[mean], want, GREY_TOLERANCE);
    Ok(())
}
