//! Helpers of the unit tests: reference figures, recipe pictures, an engine that answers from memory.

use crate::engine::{Engine, EngineError, Maps, Stage, TemplateInput};
use crate::probe;
use crate::spec::ModelSpec;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// A committed file with reference figures.
pub fn golden(name: &str) -> Vec<u8> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../tests/golden/runtime").join(name);
    std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

pub fn golden_json(name: &str) -> serde_json::Value {
    serde_json::from_slice(&golden(name)).unwrap()
}

/// Shape and values of every f32 tensor in a safetensors file.
pub fn golden_tensors(name: &str) -> BTreeMap<String, (Vec<usize>, Vec<f32>)> {
    let bytes = golden(name);
    let header = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let body = &bytes[8 + header..];
    let table: serde_json::Value = serde_json::from_slice(&bytes[8..8 + header]).unwrap();
    let mut tensors = BTreeMap::new();
    for (name, entry) in table.as_object().unwrap() {
        if entry["dtype"] != "F32" {
            continue;
        }
        let range = floats(&entry["data_offsets"]);
        let values = body[range[0] as usize..range[1] as usize].chunks_exact(4);
        let values = values.map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
        let shape = floats(&entry["shape"]).into_iter().map(|v| v as usize).collect();
        tensors.insert(name.clone(), (shape, values));
    }
    tensors
}

pub fn floats(value: &serde_json::Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
}

/// Packed RGB bytes of a recipe picture.
pub fn recipe(index: usize, width: usize, height: usize) -> Vec<u8> {
    let mut bytes = vec![0; width * height * 3];
    probe::recipe_image(index, width, height, &mut bytes);
    bytes
}

/// Answers `predict` with the maps it was given, keeps everything written to it.
#[derive(Debug)]
pub struct ScriptedEngine {
    pub spec: ModelSpec,
    pub crop: Vec<f32>,
    pub label: Vec<f32>,
    pub ltrb: Vec<f32>,
    pub answer: (Vec<f32>, Vec<f32>),
    /// Slots in the order they were written.
    pub written: Vec<usize>,
    /// Filled slots of every `predict`.
    pub asked: Vec<usize>,
    /// Stage that fails.
    pub fail: Option<Stage>,
}

impl ScriptedEngine {
    pub fn new(spec: ModelSpec) -> Self {
        let cells = spec.cells();
        Self {
            spec,
            crop: vec![0.0; spec.crop_len()],
            label: vec![0.0; cells],
            ltrb: vec![0.0; 4 * cells],
            answer: (vec![0.0; cells], vec![0.1; 4 * cells]),
            written: Vec::new(),
            asked: Vec::new(),
            fail: None,
        }
    }

    fn check(&self, stage: Stage) -> Result<(), EngineError> {
        match self.fail {
            Some(s) if s == stage => {
                Err(EngineError::new("scripted", stage, format_args!("as asked")))
            }
            _ => Ok(()),
        }
    }
}

impl Engine for ScriptedEngine {
    fn spec(&self) -> &ModelSpec {
        &self.spec
    }
    fn name(&self) -> &'static str {
        "scripted"
    }
    fn crop_mut(&mut self) -> &mut [f32] {
        &mut self.crop
    }
    fn features(&mut self) -> Result<(), EngineError> {
        self.check(Stage::Features)
    }
    fn template_input_mut(&mut self) -> TemplateInput<'_> {
        TemplateInput { label: &mut self.label, ltrb: &mut self.ltrb }
    }
    fn write_template(&mut self, slot: usize) -> Result<(), EngineError> {
        self.check(Stage::Template)?;
        self.written.push(slot);
        Ok(())
    }
    fn predict(&mut self, filled: usize) -> Result<Maps<'_>, EngineError> {
        self.check(Stage::Predict)?;
        self.asked.push(filled);
        Ok(Maps { scores: &self.answer.0, ltrb: &self.answer.1 })
    }
}
