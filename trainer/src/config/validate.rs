//! Range checks of every field, each naming the field as it is written in the file.

use super::{
    AlignPreset, DataSource, Experiment, JitterConfig, OptimConfig, PhotometricConfig,
    ProcessingConfig, RunConfig, SamplerConfig, ScheduleConfig,
};
use tsda_eval::dataset::{KINDS, Kind, Split, kind_of};
use tsda_runtime::SpecError;

/// A field whose value cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{field} = {value} cannot be used: it must be {want}")]
pub struct FieldError {
    /// Dotted name of the field, array entries counted from 0 (`data.0.weight`).
    pub field: String,
    /// Its value.
    pub value: String,
    /// What it may be.
    pub want: String,
}

fn fail<T>(field: &str, value: impl ToString, want: &str) -> Result<T, FieldError> {
    Err(FieldError { field: field.into(), value: value.to_string(), want: want.into() })
}

fn within(field: &str, value: f64, low: f64, high: f64) -> Result<(), FieldError> {
    if value.is_finite() && (low..=high).contains(&value) {
        return Ok(());
    }
    fail(field, value, &format!("a finite number from {low} to {high}"))
}

fn share(field: &str, value: f64) -> Result<(), FieldError> {
    within(field, value, 0.0, 1.0)
}

fn positive(field: &str, value: f64) -> Result<(), FieldError> {
    if value.is_finite() && value > 0.0 {
        return Ok(());
    }
    fail(field, value, "a finite number above 0")
}

fn count(field: &str, value: u64, low: u64, high: u64) -> Result<(), FieldError> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    fail(field, value, &format!("a whole number from {low} to {high}"))
}

fn from_spec(table: &str, e: SpecError) -> FieldError {
    // An unknown preset has no number to show.
    let value = if e.field == "preset" { "(unknown name)".into() } else { e.value.to_string() };
    FieldError { field: format!("{table}.{}", e.field), value, want: e.want.into() }
}

impl Experiment {
    /// Checks every field.
    ///
    /// # Errors
    /// Names the first field that is out of range, its value and the range.
    pub fn validate(&self) -> Result<(), FieldError> {
        let spec = self.model.spec().map_err(|e| from_spec("model", e))?;
        self.tracker.validate().map_err(|e| from_spec("tracker", e))?;
        if self.data.is_empty() {
            return fail("data", "[]", "at least one [[data]] table");
        }
        for (i, source) in self.data.iter().enumerate() {
            check_source(i, source)?;
            let twin = |s: &DataSource| !s.name.is_empty() && s.name == source.name;
            if self.data[..i].iter().any(twin) {
                let field = format!("data.{i}.name");
                return fail(&field, format!("{:?}", source.name), "a name no other source has");
            }
        }
        check_sampler(&self.sampler)?;
        if self.sampler.templates > usize::from(spec.templates) {
            return fail(
                "sampler.templates",
                self.sampler.templates,
                &format!("at most model.templates = {}", spec.templates),
            );
        }
        check_processing(&self.processing)?;
        within("loss.cls", self.loss.cls, 0.0, 1e6)?;
        within("loss.reg", self.loss.reg, 0.0, 1e6)?;
        check_optim(&self.optim)?;
        if self.init.backbone.is_empty() {
            return fail("init.backbone", "\"\"", "a path or \"scratch\"");
        }
        check_run(&self.run)?;
        count("run.steps (or run.epochs)", self.total_steps(), 1, 100_000_000)?;
        check_align(self)
    }
}

fn check_source(i: usize, source: &DataSource) -> Result<(), FieldError> {
    if kind_of(&source.kind).is_err() {
        let all = KINDS.iter().map(Kind::to_string).collect::<Vec<_>>().join(", ");
        let value = format!("{:?}", source.kind);
        return fail(&format!("data.{i}.kind"), value, &format!("one of {all}"));
    }
    if source.name.contains(['=', '/', '\\']) {
        let value = format!("{:?}", source.name);
        return fail(&format!("data.{i}.name"), value, "a name without '=', '/' and '\\'");
    }
    if source.only.iter().any(String::is_empty) {
        return fail(&format!("data.{i}.only"), "[\"\"]", "a list of non-empty texts");
    }
    positive(&format!("data.{i}.weight"), source.weight)?;
    for (field, name, optional) in
        [("split", &source.split, false), ("validation_split", &source.validation_split, true)]
    {
        if !(optional && name.is_empty()) && name.parse::<Split>().is_err() {
            return fail(
                &format!("data.{i}.{field}"),
                format!("{name:?}"),
                "\"train\", \"val\", \"test\" or \"all\"",
            );
        }
    }
    if source.path.as_os_str().is_empty() {
        return fail(&format!("data.{i}.path"), "\"\"", "the path of a folder");
    }
    Ok(())
}

fn check_sampler(s: &SamplerConfig) -> Result<(), FieldError> {
    count("sampler.templates", s.templates as u64, 1, 8)?;
    share("sampler.cross_modal_p", s.cross_modal_p)?;
    share("sampler.random_region_p", s.random_region_p)?;
    within("sampler.region_min", s.region_min.into(), 4.0, 4096.0)?;
    within("sampler.region_max", s.region_max.into(), s.region_min.into(), 4096.0)?;
    within("sampler.region_texture", s.region_texture.into(), 0.0, 10.0)?;
    within("sampler.min_target", s.min_target.into(), 1.0, 4096.0)?;
    count("sampler.gap", s.gap as u64, 1, 1_000_000)?;
    share("sampler.distractor_p", s.distractor_p)?;
    share("sampler.occluder_p", s.occluder_p)?;
    share("sampler.absent_p", s.absent_p)?;
    share("sampler.mixed_templates_p", s.mixed_templates_p)?;
    count("sampler.samples_per_epoch", s.samples_per_epoch as u64, 1, 1_000_000_000)
}

fn check_jitter(name: &str, j: &JitterConfig) -> Result<(), FieldError> {
    within(&format!("processing.{name}.scale"), j.scale.into(), 0.0, 2.0)?;
    within(&format!("processing.{name}.centre"), j.centre.into(), 0.0, 20.0)?;
    within(&format!("processing.{name}.aspect"), j.aspect.into(), 0.0, 1.0)
}

fn check_photometric(name: &str, p: &PhotometricConfig) -> Result<(), FieldError> {
    within(&format!("processing.{name}.gamma"), p.gamma.into(), 0.0, 2.0)?;
    within(&format!("processing.{name}.contrast"), p.contrast.into(), 0.0, 2.0)?;
    share(&format!("processing.{name}.invert_p"), p.invert_p)?;
    share(&format!("processing.{name}.blur_p"), p.blur_p)?;
    within(&format!("processing.{name}.blur_sigma"), p.blur_sigma.into(), 0.0, 10.0)?;
    share(&format!("processing.{name}.noise_p"), p.noise_p)?;
    within(&format!("processing.{name}.noise_sigma"), p.noise_sigma.into(), 0.0, 128.0)?;
    share(&format!("processing.{name}.window_p"), p.window_p)?;
    within(&format!("processing.{name}.window"), p.window.into(), 0.0, 0.4)?;
    share(&format!("processing.{name}.motion_blur_p"), p.motion_blur_p)?;
    within(&format!("processing.{name}.motion_blur"), p.motion_blur.into(), 0.0, 64.0)
}

fn check_processing(p: &ProcessingConfig) -> Result<(), FieldError> {
    check_jitter("template", &p.template)?;
    check_jitter("search", &p.search)?;
    within("processing.max_scale_change", p.max_scale_change.into(), 1.0, 10.0)?;
    share("processing.joint_flip_p", p.joint_flip_p)?;
    share("processing.crop_flip_p", p.crop_flip_p)?;
    share("processing.grayscale_p", p.grayscale_p)?;
    share("processing.channel_mix_p", p.channel_mix_p)?;
    share("processing.sensor_shift_p", p.sensor_shift_p)?;
    within("processing.occluder_side", p.occluder_side.into(), 0.1, 0.9)?;
    within("processing.brightness", p.brightness.into(), 0.0, 0.9)?;
    check_photometric("rgb", &p.rgb)?;
    check_photometric("thermal", &p.thermal)?;
    count("processing.cache_mib", p.cache_mib as u64, 1, 1 << 20)
}

fn check_optim(o: &OptimConfig) -> Result<(), FieldError> {
    within("optim.lr_head", o.lr_head, 0.0, 1.0)?;
    within("optim.lr_backbone", o.lr_backbone, 0.0, 1.0)?;
    within("optim.weight_decay", o.weight_decay, 0.0, 1.0)?;
    positive("optim.eps", o.eps)?;
    within("optim.eps", o.eps, 0.0, 1e-2)?;
    within("optim.beta1", o.beta1, 0.0, 0.9999)?;
    within("optim.beta2", o.beta2, 0.0, 0.999_999)?;
    within("optim.clip_norm", o.clip_norm, 0.0, 1e6)?;
    within("optim.ema_decay", o.ema_decay, 0.0, 0.999_999)?;
    match &o.schedule {
        ScheduleConfig::Constant => {}
        ScheduleConfig::Step { at, gamma } => {
            within("optim.schedule.gamma", *gamma, 0.0, 1.0)?;
            let rising = at.windows(2).all(|w| w[0] < w[1]);
            if !rising || at.iter().any(|v| !(v.is_finite() && *v > 0.0 && *v < 1.0)) {
                return fail(
                    "optim.schedule.at",
                    format!("{at:?}"),
                    "rising numbers between 0 and 1",
                );
            }
        }
        ScheduleConfig::Cosine { floor } => share("optim.schedule.floor", *floor)?,
    }
    within("optim.dropout", o.dropout, 0.0, 0.95)?;
    within("optim.attention_dropout", o.attention_dropout, 0.0, 0.95)?;
    Ok(())
}

fn check_hidden(field: &str, hidden: &[usize]) -> Result<(), FieldError> {
    count(field, hidden.len() as u64, 0, 8)?;
    hidden.iter().try_for_each(|width| count(field, *width as u64, 1, 1 << 16))
}

fn check_align(e: &Experiment) -> Result<(), FieldError> {
    let a = &e.align;
    let preset = || format!("\"{}\"", a.preset.name());
    if let Some(b) = a.adversarial() {
        within("align.adversarial.weight", b.weight, 0.0, 1e3)?;
        within("align.adversarial.reversal", b.reversal, 0.0, 1e3)?;
        check_hidden("align.adversarial.hidden", &b.hidden)?;
    }
    if let Some(b) = a.contrastive() {
        within("align.contrastive.weight", b.weight, 0.0, 1e3)?;
        within("align.contrastive.temperature", b.temperature, 1e-3, 1e3)?;
        check_hidden("align.contrastive.hidden", &b.hidden)?;
        count("align.contrastive.dim", b.dim as u64, 1, 1 << 16)?;
        if e.run.batch < 2 {
            let want = "at least 2: the contrastive loss compares the samples of a batch";
            return fail("run.batch", e.run.batch, want);
        }
    }
    if let Some(lr) = a.lr {
        within("align.lr", lr, 0.0, 1.0)?;
    }
    match a.preset {
        AlignPreset::None => {}
        AlignPreset::Baseline | AlignPreset::Cm if a.is_on() => {
            return fail("align.preset", preset(), "a row with alignment, or without its tables");
        }
        AlignPreset::Baseline => {}
        _ if e.sampler.cross_modal_p == 0.0 => {
            let want = "above 0 for every align.preset but \"none\" and \"baseline\"";
            return fail("sampler.cross_modal_p", 0, want);
        }
        _ => {}
    }
    let s = &e.sampler;
    if a.is_on() && s.mixed_templates_p > 0.0 {
        let want = "0 with alignment, which compares templates of one sensor with the search crop";
        return fail("sampler.mixed_templates_p", s.mixed_templates_p, want);
    }
    if a.contrastive().is_some() && s.absent_p > 0.0 {
        let want =
            "0 with contrastive alignment, for which every search crop has to show its target";
        return fail("sampler.absent_p", s.absent_p, want);
    }
    let (start, total) = (e.align_start(), e.total_steps());
    if a.is_on() && start >= total {
        let field = if a.start_step.is_some() { "align.start_step" } else { "align.start_epoch" };
        let value = a.start_step.unwrap_or(a.start_epoch);
        let want =
            format!("before the end of the run: alignment would start at step {start} of {total}");
        let want = want + " (runs counted in steps: set align.start_step or give --align-start)";
        return fail(field, value, &want);
    }
    Ok(())
}

fn check_run(r: &RunConfig) -> Result<(), FieldError> {
    count("run.batch", r.batch as u64, 1, 4096)?;
    count("run.accumulate", r.accumulate as u64, 1, 4096)?;
    count("run.workers", r.workers as u64, 1, 256)?;
    count("run.checkpoint_every", r.checkpoint_every, 1, u64::MAX)?;
    count("run.keep", r.keep as u64, 1, 10_000)?;
    count("run.log_every", r.log_every, 1, u64::MAX)?;
    if r.validate_every > 0 {
        count("run.validation_samples", r.validation_samples as u64, 1, 1_000_000)?;
    }
    if r.out.as_os_str().is_empty() {
        return fail("run.out", "\"\"", "the path of a folder");
    }
    // TOML has no unsigned 64-bit numbers; the resolved copy could not hold a larger one.
    count("run.seed", r.seed, 0, i64::MAX as u64)
}
