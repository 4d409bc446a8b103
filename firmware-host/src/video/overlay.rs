//! What is drawn over a frame: box, score, state, sensor, and a line of scores below it.

use super::paint::{self, Colour, fill, outline, scaled, text, text_height, text_width};
use crate::picture::Picture;
use crate::track::Step;
use tsda_runtime::{BBox, FrameView, Modality, TrackState};

/// Colour of a sensor: blue for RGB, orange for thermal.
pub const fn sensor_colour(modality: Modality) -> Colour {
    match modality {
        Modality::Rgb => [58, 134, 255],
        Modality::Thermal => [255, 122, 26],
    }
}

/// Colour of a state, from green to red.
pub const fn state_colour(state: TrackState) -> Colour {
    match state {
        TrackState::Tracking => [57, 224, 110],
        TrackState::Uncertain => [255, 214, 64],
        TrackState::Searching => [255, 140, 40],
        TrackState::Lost => [255, 60, 60],
    }
}

/// Colour of known truth.
pub const TRUTH: Colour = [240, 240, 255];

/// Label of a sensor in pictures.
pub const fn sensor_label(modality: Modality) -> &'static str {
    match modality {
        Modality::Rgb => "RGB",
        Modality::Thermal => "THERMAL",
    }
}

/// Draws frames one after the other; remembers the scores for the line below.
#[derive(Debug)]
pub struct Overlay {
    width: Limits,
    total: Option<usize>,
    scores: Vec<(f32, Modality)>,
    picture: Picture,
    frame: Picture,
}

/// Smallest and largest width of the drawn picture.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Smaller frames are enlarged to at least this, so that the text can be read.
    pub min: usize,
    /// Larger frames are reduced to this.
    pub max: usize,
}

/// Height of the strip under the picture.
const FOOTER: usize = 26;

impl Overlay {
    /// For a clip of `total` frames, where known.
    pub fn new(width: Limits, total: Option<usize>) -> Self {
        Self {
            width,
            total,
            scores: Vec::new(),
            picture: Picture::default(),
            frame: Picture::default(),
        }
    }

    /// Draws the next frame.
    pub fn draw(&mut self, view: &FrameView<'_>, step: &Step, truth: Option<BBox>) -> &Picture {
        self.scores.push((step.score, step.modality));
        let width = view.width().clamp(self.width.min, self.width.max.max(self.width.min));
        let scale = scaled(view, width, &mut self.frame);
        draw_boxes(&mut self.frame, scale, step, truth);
        draw_labels(&mut self.frame, step);
        let (w, h) = (self.frame.width, self.frame.height);
        self.picture.reset(w, h + FOOTER, 3);
        self.picture.data[..w * h * 3].copy_from_slice(&self.frame.data);
        self.footer(h as i32);
        &self.picture
    }

    /// Scores so far over the length of the clip, on the colour of the sensor that was active.
    fn footer(&mut self, top: i32) {
        let w = self.picture.width;
        fill(&mut self.picture, 0, top, w as i32, FOOTER as i32, [16, 18, 24], 255);
        let shown = self.total.unwrap_or(0).max(self.scores.len()).max(2);
        let at = |i: usize| i as f32 * w as f32 / shown as f32;
        let y = |score: f32| {
            top as f32 + 2.0 + (FOOTER as f32 - 5.0) * (1.0 - score.clamp(0.0, 1.1) / 1.1)
        };
        for i in 0..self.scores.len() {
            let (score, modality) = self.scores[i];
            let x = at(i).floor() as i32;
            let wide = (at(i + 1).ceil() as i32 - x).max(1);
            let colour = sensor_colour(modality);
            fill(&mut self.picture, x, top, wide, FOOTER as i32, colour.map(|c| c / 4), 255);
            fill(&mut self.picture, x, top, wide, 2, colour, 255);
            if i > 0 {
                let (before, _) = self.scores[i - 1];
                let (a, b) = ((at(i - 1), y(before)), (at(i), y(score)));
                paint::line(&mut self.picture, a, b, [235, 235, 235]);
            }
        }
    }
}

/// The box in the colour of the state, known truth thin in white.
pub(super) fn draw_boxes(picture: &mut Picture, scale: f32, step: &Step, truth: Option<BBox>) {
    let on = |b: &BBox| BBox::new(b.x * scale, b.y * scale, b.w * scale, b.h * scale);
    if let Some(truth) = truth {
        outline(picture, &on(&truth), TRUTH, 1);
    }
    let colour = state_colour(step.state);
    let bbox = on(&step.bbox);
    outline(picture, &bbox, colour, 2);
    let label = format!("{:.2}", step.score);
    let (w, h) = (text_width(&label, 1) + 4, text_height(1) + 4);
    let x = (bbox.x as i32).clamp(0, (picture.width as i32 - w).max(0));
    let above = bbox.y as i32 - h - 1;
    let y = if above >= 0 { above } else { bbox.bottom() as i32 + 1 };
    fill(picture, x, y, w, h, [0, 0, 0], 170);
    text(picture, x + 2, y + 2, &label, colour, 1);
}

/// Sensor and frame in the top-left corner, state in the top-right one.
pub(super) fn draw_labels(picture: &mut Picture, step: &Step) {
    let size = if picture.width >= 400 { 2 } else { 1 };
    let pad = 3 * size;
    let high = text_height(size) + 2 * pad;
    let label = sensor_label(step.modality);
    let wide = text_width(label, size) + 2 * pad;
    fill(picture, 0, 0, wide, high, sensor_colour(step.modality), 230);
    text(picture, pad, pad, label, [255, 255, 255], size);
    let number = format!("#{}", step.frame);
    fill(picture, wide, 0, text_width(&number, size) + 2 * pad, high, [0, 0, 0], 150);
    text(picture, wide + pad, pad, &number, [220, 220, 220], size);
    let state = step.state.as_str();
    let wide = text_width(state, size) + 2 * pad;
    let x = picture.width as i32 - wide;
    fill(picture, x, 0, wide, high, [0, 0, 0], 170);
    text(picture, x + pad, pad, state, state_colour(step.state), size);
}
