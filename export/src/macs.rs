//! What a network costs per frame, in multiply-accumulates, by graph and part of the network.

use crate::network::NetworkGraph;
use crate::onnx::macs::{self, NodeMacs, ShapeError};
use crate::onnx::proto::ModelProto;
use prost::Message as _;
use serde::Serialize;
use std::collections::BTreeMap;
use tsda_runtime::bundle::{Bundle, SectionKind};

/// Multiply-accumulates that could not be counted.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MacsError {
    /// A section of the bundle is no ONNX file.
    #[error("{graph}: not an ONNX file: {source}")]
    Decode {
        /// The section.
        graph: SectionKind,
        /// What the decoder found.
        source: prost::DecodeError,
    },
    /// A shape cannot be told.
    #[error(transparent)]
    Shape(#[from] ShapeError),
}

/// Parts of the network by the paths of their layers; the first that fits.
const PARTS: [(&str, &str); 7] = [
    ("feature_extractor.", "backbone"),
    ("head.feature_extractor", "head conv"),
    ("head.filter_predictor.box_encoding", "box encoding"),
    ("head.filter_predictor.transformer.encoder", "encoder"),
    ("head.filter_predictor.transformer.decoder", "decoder"),
    ("head.classifier", "classifier"),
    ("head.bb_regressor", "box regressor"),
];

fn part(name: &str) -> &'static str {
    let layer = macs::layer(name);
    PARTS.iter().find(|(path, _)| layer.starts_with(path)).map_or("other", |(_, part)| part)
}

/// One graph.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct GraphMacs {
    /// `features`, `template`, `predict1` ..
    pub graph: String,
    /// Multiply-accumulates of one run.
    pub macs: u64,
    /// The same by part, in order of first use.
    pub parts: Vec<PartMacs>,
}

/// One part of a graph.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct PartMacs {
    /// `backbone`, `encoder` ..
    pub part: &'static str,
    /// Multiply-accumulates of one run.
    pub macs: u64,
}

impl GraphMacs {
    fn new(kind: SectionKind, nodes: &[NodeMacs]) -> Self {
        let mut parts: Vec<PartMacs> = Vec::new();
        for node in nodes {
            let part = part(&node.name);
            match parts.iter_mut().find(|p| p.part == part) {
                Some(known) => known.macs += node.macs,
                None => parts.push(PartMacs { part, macs: node.macs }),
            }
        }
        let graph = kind.to_string();
        let graph = graph.strip_suffix(".onnx").unwrap_or(&graph).to_owned();
        Self { graph, macs: parts.iter().map(|p| p.macs).sum(), parts }
    }

    /// Multiply-accumulates of a part; 0 where the graph has none of it.
    pub fn part(&self, name: &str) -> u64 {
        self.parts.iter().find(|p| p.part == name).map_or(0, |p| p.macs)
    }
}

/// All graphs of a network.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct MacsReport {
    /// Graph by graph.
    pub graphs: Vec<GraphMacs>,
    /// Per search frame (`features` and `predict`), by the number of filled slots. A memory write
    /// adds `template`.
    pub per_frame: BTreeMap<u8, u64>,
}

impl MacsReport {
    fn add(&mut self, kind: SectionKind, nodes: &[NodeMacs]) {
        let graph = GraphMacs::new(kind, nodes);
        if let SectionKind::PredictOnnx(count) = kind {
            self.per_frame.insert(count, graph.macs);
        }
        self.graphs.push(graph);
    }

    fn finish(mut self) -> Self {
        let features = self.graph("features").map_or(0, |g| g.macs);
        self.per_frame.values_mut().for_each(|macs| *macs += features);
        self
    }

    /// The graph of this name.
    pub fn graph(&self, name: &str) -> Option<&GraphMacs> {
        self.graphs.iter().find(|g| g.graph == name)
    }
}

/// Counts recorded graphs.
pub fn of_graphs(graphs: &[NetworkGraph]) -> MacsReport {
    let mut report = MacsReport::default();
    graphs.iter().for_each(|g| report.add(g.kind, &macs::count(&g.graph)));
    report.finish()
}

/// Counts the graphs of a bundle.
///
/// # Errors
/// When a graph is no ONNX file or has an operation whose shape cannot be told.
pub fn of_bundle(bundle: &Bundle<'_>) -> Result<MacsReport, MacsError> {
    let mut report = MacsReport::default();
    for kind in bundle.manifest().sections.iter().map(|s| s.kind) {
        let graph = match kind {
            SectionKind::FeaturesOnnx | SectionKind::TemplateOnnx | SectionKind::PredictOnnx(_) => {
                bundle.section(kind).unwrap_or_default()
            }
            _ => continue,
        };
        let model = ModelProto::decode(graph)
            .map_err(|source| MacsError::Decode { graph: kind, source })?;
        report.add(kind, &macs::count_model(&model)?);
    }
    Ok(report.finish())
}

impl std::fmt::Display for MacsReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let millions = |macs: u64| macs as f64 * 1e-6;
        writeln!(f, "{:<10} {:<14} {:>12}", "graph", "part", "million MAC")?;
        for GraphMacs { graph, macs, parts } in &self.graphs {
            for PartMacs { part, macs } in parts {
                writeln!(f, "{graph:<10} {part:<14} {:>12.2}", millions(*macs))?;
            }
            writeln!(f, "{graph:<10} {:<14} {:>12.2}", "all", millions(*macs))?;
        }
        for (count, macs) in &self.per_frame {
            let what = format!("{count} template{}", if *count == 1 { "" } else { "s" });
            writeln!(f, "{:<10} {what:<14} {:>12.2}", "frame", millions(*macs))?;
        }
        Ok(())
    }
}
