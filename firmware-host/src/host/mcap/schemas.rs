//! Messages that Foxglove shows, as JSON.

use super::writer::Schema;
use crate::host::output::{FrameRecord, TargetRecord};
use crate::trax::encode_base64_into;
use serde_json::{Value, json};
use tsda_runtime::TrackState;

const IMAGE: Schema = Schema {
    name: "foxglove.CompressedImage",
    text: r#"{"title":"foxglove.CompressedImage","type":"object","properties":{"timestamp":{"type":"object","title":"time","properties":{"sec":{"type":"integer","minimum":0},"nsec":{"type":"integer","minimum":0,"maximum":999999999}}},"frame_id":{"type":"string"},"data":{"type":"string","contentEncoding":"base64"},"format":{"type":"string"}}}"#,
};

const ANNOTATIONS: Schema = Schema {
    name: "foxglove.ImageAnnotations",
    text: r##"{"title":"foxglove.ImageAnnotations","type":"object","$defs":{"time":{"type":"object","title":"time","properties":{"sec":{"type":"integer","minimum":0},"nsec":{"type":"integer","minimum":0,"maximum":999999999}}},"point":{"type":"object","title":"foxglove.Point2","properties":{"x":{"type":"number"},"y":{"type":"number"}}},"color":{"type":"object","title":"foxglove.Color","properties":{"r":{"type":"number"},"g":{"type":"number"},"b":{"type":"number"},"a":{"type":"number"}}}},"properties":{"circles":{"type":"array","items":{"type":"object","title":"foxglove.CircleAnnotation","properties":{"timestamp":{"$ref":"#/$defs/time"},"position":{"$ref":"#/$defs/point"},"diameter":{"type":"number"},"thickness":{"type":"number"},"fill_color":{"$ref":"#/$defs/color"},"outline_color":{"$ref":"#/$defs/color"}}}},"points":{"type":"array","items":{"type":"object","title":"foxglove.PointsAnnotation","properties":{"timestamp":{"$ref":"#/$defs/time"},"type":{"type":"integer","title":"foxglove.PointsAnnotationType","oneOf":[{"title":"UNKNOWN","const":0},{"title":"POINTS","const":1},{"title":"LINE_LOOP","const":2},{"title":"LINE_STRIP","const":3},{"title":"LINE_LIST","const":4}]},"points":{"type":"array","items":{"$ref":"#/$defs/point"}},"outline_color":{"$ref":"#/$defs/color"},"outline_colors":{"type":"array","items":{"$ref":"#/$defs/color"}},"fill_color":{"$ref":"#/$defs/color"},"thickness":{"type":"number"}}}},"texts":{"type":"array","items":{"type":"object","title":"foxglove.TextAnnotation","properties":{"timestamp":{"$ref":"#/$defs/time"},"position":{"$ref":"#/$defs/point"},"text":{"type":"string"},"font_size":{"type":"number"},"text_color":{"$ref":"#/$defs/color"},"background_color":{"$ref":"#/$defs/color"}}}}}}"##,
};

const RECORD: Schema = Schema { name: "tsda.Record", text: r#"{"type":"object"}"# };
const EVENT: Schema = Schema { name: "tsda.Event", text: r#"{"type":"object"}"# };

/// All of them; the places are the constants below.
pub(super) const ALL: [Schema; 4] = [IMAGE, ANNOTATIONS, RECORD, EVENT];
pub(super) const IMAGE_AT: usize = 0;
pub(super) const ANNOTATIONS_AT: usize = 1;
pub(super) const RECORD_AT: usize = 2;
pub(super) const EVENT_AT: usize = 3;

fn stamp(nanos: u64) -> Value {
    json!({ "sec": nanos / 1_000_000_000, "nsec": nanos % 1_000_000_000 })
}

/// A picture as a message, in place of what `out` holds.
pub(super) fn image(time: u64, source: &str, jpeg: &[u8], out: &mut Vec<u8>) {
    let head =
        json!({ "timestamp": stamp(time), "frame_id": source, "format": "jpeg" }).to_string();
    out.clear();
    // The last member goes into the object that is open but for its brace.
    out.extend_from_slice(head.strip_suffix('}').unwrap_or(&head).as_bytes());
    out.extend_from_slice(br#","data":""#);
    encode_base64_into(jpeg, out);
    out.extend_from_slice(br#""}"#);
}

/// Box and figures of a record, in pixels of a picture thinned by `step`; nothing without a target.
pub(super) fn annotations(time: u64, record: Option<&FrameRecord>, step: usize) -> Vec<u8> {
    let (mut points, mut texts) = (Vec::new(), Vec::new());
    if let Some(target) = record.and_then(|r| r.target.as_ref()) {
        let (k, b) = (1.0 / step.max(1) as f32, target.bbox);
        let corner = |x: f32, y: f32| json!({ "x": x * k, "y": y * k });
        let (right, bottom) = (b.x + b.w, b.y + b.h);
        let colour = colour(target);
        points.push(json!({
            "timestamp": stamp(time), "type": 2, "thickness": 2.0,
            "points": [corner(b.x, b.y), corner(right, b.y), corner(right, bottom), corner(b.x, bottom)],
            "outline_color": colour, "outline_colors": [],
            "fill_color": { "r": 0.0, "g": 0.0, "b": 0.0, "a": 0.0 },
        }));
        let state = if target.predicted { "predicted" } else { TrackState::as_str(target.state) };
        texts.push(json!({
            "timestamp": stamp(time), "position": corner(b.x, b.y),
            "text": format!("{state} {:.2}", target.score), "font_size": 12.0, "text_color": colour,
            "background_color": { "r": 0.0, "g": 0.0, "b": 0.0, "a": 0.6 },
        }));
    }
    json!({ "circles": [], "points": points, "texts": texts }).to_string().into_bytes()
}

fn colour(target: &TargetRecord) -> Value {
    let (r, g, b) = match target.state {
        TrackState::Tracking => (0.3, 0.85, 0.5),
        TrackState::Uncertain => (0.95, 0.75, 0.3),
        TrackState::Searching => (0.95, 0.6, 0.3),
        TrackState::Lost => (1.0, 0.4, 0.4),
    };
    json!({ "r": r, "g": g, "b": b, "a": 1.0 })
}
