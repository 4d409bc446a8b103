//! Folders of cases: which files there are, what each is to be run with.
//!
//! Both layouts are told apart by the inputs: `seqS.*` tensors make the sequence layout (one pass
//! per file `case_*.safetensors`, crops in the inputs or by recipe), `train_label` and `train_ltrb`
//! the preset layout (any number of passes per file `<preset>*.safetensors`, crops by recipe).

use super::error::GoldenError;
use super::figure::{Figure, Pass, Place, filter_size_of, is_training, number};
use super::inputs::{self, Sequence};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use tsda_runtime::ModelSpec;
use tsda_runtime::spec::MAX_TEMPLATES;
use tsda_trainer::import::{StateDict, StateTensor};
use tsda_trainer::model::inspect::Mode;

/// What is asked of a folder.
#[derive(Clone, Debug)]
pub struct Selection {
    /// The folder.
    pub dir: PathBuf,
    /// Name of the preset.
    pub preset: String,
    /// Shape of the preset.
    pub spec: ModelSpec,
    /// Only this file.
    pub case: Option<PathBuf>,
    /// Overrides what the cases say about the test-frame embedding.
    pub test_embedding: Option<bool>,
    /// Overrides what the cases say about the filter size.
    pub filter_size: Option<u8>,
}

/// The cases of a folder.
#[derive(Clone, Debug)]
pub struct Folder {
    /// Sequences the passes refer to.
    pub sequences: Vec<Sequence>,
    /// State dict of the network; by recipe when there is none.
    pub weights: Option<(PathBuf, StateDict)>,
    /// One per file.
    pub cases: Vec<Case>,
    /// Differences between the stored inputs and those made from the recipe, with the bound.
    pub input_checks: Vec<(String, f32, f32)>,
    /// Tensors of the inputs that are not known.
    pub unknown_inputs: Vec<String>,
}

/// One file of figures.
#[derive(Clone, Debug)]
pub struct Case {
    /// File name without its extension.
    pub name: String,
    /// The file.
    pub path: PathBuf,
    /// The network it was computed with.
    pub spec: ModelSpec,
    /// The passes with the figures of each.
    pub passes: Vec<(Pass, Vec<Figure>)>,
    /// How what the figures do not say was decided, for people.
    pub notes: Vec<String>,
    /// Tensors that are not known.
    pub unknown: Vec<String>,
    /// Tensors of a training step, which the trainer's own tests compare.
    pub training: usize,
    /// The one sequence of the pass is still to be found (see [`Case::places`]).
    pub open_sequence: bool,
}

impl Case {
    /// All figures with their pass.
    pub fn places(&self) -> impl Iterator<Item = (&Pass, &Figure)> {
        self.passes.iter().flat_map(|(pass, figures)| figures.iter().map(move |f| (pass, f)))
    }
}

/// Reads the folder.
///
/// # Errors
/// Names the file or tensor that is missing or cannot be used.
pub fn open(selection: &Selection) -> Result<Folder, GoldenError> {
    let files = safetensors(&selection.dir)?;
    let inputs_path = selection.dir.join("inputs.safetensors");
    let inputs = StateDict::read(&inputs_path)?;
    let sequential = inputs.names().any(|n| inputs::sequence_of(n).is_some());
    let read = inputs::read(&inputs, &inputs_path, &selection.spec, sequential)?;

    let weights_path = selection.dir.join("weights.safetensors");
    let weights = match weights_path.exists() {
        true => Some((weights_path.clone(), StateDict::read(&weights_path)?)),
        false => None,
    };
    let chosen: Vec<PathBuf> = match &selection.case {
        Some(case) => vec![case.clone()],
        None => {
            let named = |path: &PathBuf| {
                let name = stem(path);
                name.starts_with("case_") || name.starts_with(&selection.preset)
            };
            files.iter().filter(|p| named(p)).cloned().collect()
        }
    };
    if chosen.is_empty() {
        let found: Vec<String> = files.iter().map(|p| stem(p)).collect();
        return Err(GoldenError::NoCases {
            dir: selection.dir.clone(),
            preset: selection.preset.clone(),
            found: if found.is_empty() { "nothing".into() } else { found.join(", ") },
        });
    }
    let has_embedding = weights
        .as_ref()
        .is_none_or(|(_, dict)| dict.names().any(|n| n.ends_with("query_embed_test.weight")));
    let cases = chosen
        .iter()
        .map(|path| case(path, selection, sequential, &read.sequences, has_embedding))
        .collect::<Result<Vec<_>, _>>()?;
    Ok(Folder {
        sequences: read.sequences,
        weights,
        cases,
        input_checks: read.checks,
        unknown_inputs: read.unknown,
    })
}

fn stem(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// The safetensors files of a folder, in order.
fn safetensors(dir: &Path) -> Result<Vec<PathBuf>, GoldenError> {
    let read = |source| GoldenError::Read { path: dir.into(), source };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(read)? {
        let path = entry.map_err(read)?.path();
        if path.extension().is_some_and(|e| e == "safetensors") {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

/// The `__metadata__` of a safetensors file.
fn metadata(path: &Path) -> Result<HashMap<String, String>, GoldenError> {
    let bytes =
        std::fs::read(path).map_err(|source| GoldenError::Read { path: path.into(), source })?;
    let (_, head) = safetensors::SafeTensors::read_metadata(&bytes)
        .map_err(|e| GoldenError::Header { path: path.into(), detail: e.to_string() })?;
    Ok(head.metadata().clone().unwrap_or_default())
}

/// What a file says about itself: metadata first, then its name.
struct Statements<'a> {
    path: &'a Path,
    name: String,
    metadata: HashMap<String, String>,
}

impl Statements<'_> {
    fn stated(&self, keys: &[&str]) -> Option<(&str, &str)> {
        keys.iter().find_map(|key| {
            self.metadata.get_key_value(*key).map(|(k, v)| (k.as_str(), v.as_str()))
        })
    }

    fn wrong(&self, what: &str, value: &str, expected: &str) -> GoldenError {
        GoldenError::Statement {
            path: self.path.into(),
            what: what.into(),
            value: value.into(),
            expected: expected.into(),
        }
    }

    fn flag(&self, keys: &[&str]) -> Result<Option<bool>, GoldenError> {
        let Some((key, value)) = self.stated(keys) else { return Ok(None) };
        match value.to_ascii_lowercase().as_str() {
            "true" | "yes" | "1" => Ok(Some(true)),
            "false" | "no" | "0" => Ok(Some(false)),
            _ => Err(self.wrong(key, value, "true or false")),
        }
    }

    fn count(&self, keys: &[&str]) -> Result<Option<usize>, GoldenError> {
        self.stated(keys).map(|(key, value)| number(self.path, key, value)).transpose()
    }

    /// The number directly before (`3train`) or after (`batch3`) a word of the name.
    fn near(&self, word: &str) -> Option<usize> {
        let at = self.name.find(word)?;
        let after: String =
            self.name[at + word.len()..].chars().take_while(char::is_ascii_digit).collect();
        let before: String =
            self.name[..at].chars().rev().take_while(char::is_ascii_digit).collect();
        let before: String = before.chars().rev().collect();
        let number = if before.is_empty() { after } else { before };
        number.parse().ok().filter(|n| *n > 0)
    }
}

fn case(
    path: &Path,
    selection: &Selection,
    sequential: bool,
    sequences: &[Sequence],
    has_embedding: bool,
) -> Result<Case, GoldenError> {
    let dict = StateDict::read(path)?;
    let said = Statements { path, name: stem(path), metadata: metadata(path)? };
    let mut notes = Vec::new();
    let mut spec = selection.spec;
    let by_name = || {
        let without = ["no_test_enc", "no_test_emb", "without_test"];
        without.iter().any(|w| said.name.contains(w)).then_some(false)
    };
    let keys = ["test_embedding", "test_encoding", "use_test_frame_encoding"];
    spec.test_embedding = match selection.test_embedding {
        Some(given) => given,
        None => said
            .flag(&keys)?
            .or_else(by_name)
            .unwrap_or(has_embedding && selection.spec.test_embedding),
    };

    let (mut figures, mut unknown, mut training) = (Vec::new(), Vec::new(), 0);
    for (name, reference) in dict.iter() {
        if is_training(name) {
            training += 1;
        } else if let Some(place) = Place::parse(name, &spec) {
            figures.push(Figure { name: name.into(), reference: reference.clone(), place });
        } else {
            unknown.push(name.to_string());
        }
    }
    spec.filter_size = match (selection.filter_size, said.count(&["filter_size"])?) {
        (Some(given), _) => given,
        (None, Some(stated)) => u8::try_from(stated).unwrap_or(u8::MAX),
        (None, None) => match said.near("filter").or_else(|| said.near("ksz")) {
            Some(stated) => u8::try_from(stated).unwrap_or(u8::MAX),
            None => {
                let feature = figures.iter().find(|f| f.place.key == "test.head.feat");
                let found = feature.and_then(|f| filter_size_of(&f.reference.values, &spec));
                if found.is_some_and(|k| k != spec.filter_size) {
                    notes.push("filter size from the RMS of the head feature".into());
                }
                found.unwrap_or(spec.filter_size)
            }
        },
    };
    if training > 0 {
        // Its maps belong to training mode, where the box MLP uses batch statistics.
        figures.clear();
    }
    let mut open_sequence = false;
    let passes = if figures.is_empty() {
        Vec::new()
    } else if sequential {
        let (pass, open) = stated_pass(&said, &figures, sequences, &spec)?;
        open_sequence = open;
        vec![(pass, figures)]
    } else {
        scoped(figures, sequences, path)?
    };
    for (pass, _) in &passes {
        check(pass, sequences, path)?;
    }
    spec.templates = passes.iter().map(|(p, _)| p.templates).max().unwrap_or(1) as u8;
    let name = said.name.clone();
    Ok(Case { name, path: path.into(), spec, passes, notes, unknown, training, open_sequence })
}

/// The pass of a file in the sequence layout, and whether its sequence is still open.
fn stated_pass(
    said: &Statements<'_>,
    figures: &[Figure],
    sequences: &[Sequence],
    spec: &ModelSpec,
) -> Result<(Pass, bool), GoldenError> {
    let find = |key: &str| -> Option<&StateTensor> {
        figures.iter().find(|f| f.place.key == key).map(|f| &f.reference)
    };
    let cells = spec.cells();
    let single = match said.stated(&["mode"]) {
        Some((_, "single")) => true,
        Some((_, "parallel")) => false,
        Some((key, other)) => return Err(said.wrong(key, other, "parallel or single")),
        None => said.name.contains("single"),
    };
    let batch = match find("scores") {
        Some(scores) if single => (scores.values.len() / cells).max(1),
        _ if single => said.near("batch").unwrap_or(1),
        _ => 1,
    };
    let by_tokens = find("encoder.input").and_then(|t| t.shape.first()?.checked_div(cells));
    let by_features = find("train.head.feat").and_then(|t| t.shape.first()?.checked_div(batch));
    let stored = sequences.first().map_or(1, |s| s.templates.len());
    let templates = said
        .count(&["templates"])?
        .or_else(|| said.near("train"))
        .or(by_tokens.and_then(|t| t.checked_sub(1)))
        .or(by_features)
        .unwrap_or(stored);
    let annotated = said.count(&["annotated", "num_gth_frames", "num_gt"])?;
    let annotated = annotated.or_else(|| said.near("gt")).unwrap_or(1);
    let mode = if single { Mode::Single } else { Mode::Parallel { annotated } };
    let stated = match said.stated(&["sequence", "sequences"]) {
        Some((key, list)) => {
            let each = |s: &str| {
                let index = s.trim().parse::<usize>();
                index.map_err(|_| said.wrong(key, list, "numbers of sequences, as in `0` or `0,2`"))
            };
            Some(list.split(',').map(each).collect::<Result<Vec<_>, _>>()?)
        }
        None => said.near("seq").map(|n| vec![n]).or_else(|| {
            // `seq0` is a number that `near` refuses.
            said.name.contains("seq0").then(|| vec![0])
        }),
    };
    let open = stated.is_none() && batch == 1 && sequences.len() > 1;
    let list = stated.unwrap_or_else(|| (0..batch).collect());
    Ok((Pass { mode, templates, sequences: list }, open))
}

/// The passes of a file in the preset layout. Figures without a scope go to the largest one.
fn scoped(
    figures: Vec<Figure>,
    sequences: &[Sequence],
    path: &Path,
) -> Result<Vec<(Pass, Vec<Figure>)>, GoldenError> {
    let mut passes: BTreeMap<(usize, Mode), Vec<Figure>> = BTreeMap::new();
    let mut loose = Vec::new();
    for figure in figures {
        match figure.place.scope {
            Some(s) => passes.entry((s.templates, s.mode)).or_default().push(figure),
            None => loose.push(figure),
        }
    }
    for figure in loose {
        // Values of the crops need all of them; of the others only the positional code may do
        // without a scope, and its length says how many frames it is for.
        let stored = sequences.first().map_or(1, |s| s.templates.len());
        let rows = figure.reference.shape.first().copied().unwrap_or(0) * figure.place.token_step;
        let templates = match figure.place.key.as_str() {
            "encoder.pos" => {
                let cells = sequences.first().map_or(1, |s| s.cells());
                (rows / cells.max(1)).saturating_sub(1).max(1)
            }
            _ if figure.place.is_feature() => stored,
            _ => {
                return Err(GoldenError::Statement {
                    path: path.into(),
                    what: "tensor".into(),
                    value: figure.name,
                    expected: "`parallelN.` or `singleN.` before the name".into(),
                });
            }
        };
        let key = passes.keys().rev().find(|(n, _)| *n == templates).copied();
        let key = key.unwrap_or((templates, Mode::Parallel { annotated: 1 }));
        passes.entry(key).or_default().push(figure);
    }
    // The largest first: back ends keep what they computed of it.
    Ok(passes
        .into_iter()
        .rev()
        .map(|((templates, mode), figures)| (Pass { mode, templates, sequences: vec![0] }, figures))
        .collect())
}

/// Whether a pass can be run on the sequences there are.
fn check(pass: &Pass, sequences: &[Sequence], path: &Path) -> Result<(), GoldenError> {
    let wrong = |what: &str, value: usize, expected: String| {
        Err(GoldenError::Statement {
            path: path.into(),
            what: what.into(),
            value: value.to_string(),
            expected,
        })
    };
    if pass.templates > MAX_TEMPLATES {
        return wrong("templates", pass.templates, format!("1 to {MAX_TEMPLATES}"));
    }
    if let Mode::Parallel { annotated } = pass.mode
        && annotated > pass.templates
    {
        return wrong("annotated", annotated, format!("1 to {}", pass.templates));
    }
    for &index in &pass.sequences {
        let Some(sequence) = sequences.get(index) else {
            let expected = format!("0 to {}, the inputs have no more", sequences.len() - 1);
            return wrong("sequence", index, expected);
        };
        if sequence.templates.len() < pass.templates {
            return Err(GoldenError::MissingInput {
                path: path.with_file_name("inputs.safetensors"),
                name: format!("{}template {}", sequence.prefix, sequence.templates.len()),
                why: format!("{} runs with {} templates", stem(path), pass.templates),
            });
        }
    }
    Ok(())
}
