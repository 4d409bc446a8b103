//! Names and layouts of parameters in files: PyTorch's state dict (spec 1.9).

use super::mobilenet;

/// How a parameter is laid out in a file, compared with burn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// The same.
    Same,
    /// A linear layer: `(out, in)` in the file, `(in, out)` in burn.
    Linear,
    /// A linear layer that is a convolution of length 1 in the file: `(out, in, 1)`.
    Conv1d,
}

impl Layout {
    /// Shape in the file of a parameter with this shape in burn.
    pub fn file_shape(self, shape: &[usize]) -> Vec<usize> {
        match (self, shape) {
            (Self::Linear, &[inp, out]) => vec![out, inp],
            (Self::Conv1d, &[inp, out]) => vec![out, inp, 1],
            _ => shape.to_vec(),
        }
    }

    /// Whether rows and columns change places between burn and the file.
    pub fn is_transposed(self) -> bool {
        self != Self::Same
    }
}

/// State-dict name and layout of the burn parameter at `path`, e.g.
/// `head.filter_predictor.box_encoding.conv3.weight` becomes
/// `head.filter_predictor.box_encoding.3.weight`, stored as `(out, in, 1)`.
pub fn state_dict_name(path: &[String]) -> (String, Layout) {
    if let [extractor, variant, layers @ .., parameter] = path
        && variant == "MobileNet"
        && let Some(layer) = mobilenet::published_name(layers)
    {
        // Of its layers, only those of a gate are linear.
        let gate = parameter == "weight" && layers.iter().any(|l| l == "gate");
        let layout = if gate { Layout::Linear } else { Layout::Same };
        return (format!("{extractor}.{layer}.{parameter}"), layout);
    }
    let mut name: Vec<String> = Vec::with_capacity(path.len());
    let mut layout = Layout::Same;
    let efficientnet = path.get(1).is_some_and(|p| p == "EfficientNet");
    let last = path.len().saturating_sub(1);
    for (i, part) in path.iter().enumerate() {
        let before = i.checked_sub(1).map_or("", |j| path[j].as_str());
        match (before, part.as_str()) {
            // The backbone enum's variant.
            ("feature_extractor", "EfficientNet" | "ResNet") => {}
            ("downsample", "conv") => name.push("0".into()),
            ("downsample", "bn") => name.push("1".into()),
            ("box_encoding", layer) => {
                if layer.starts_with("conv") && path.get(last).is_some_and(|l| l == "weight") {
                    layout = Layout::Conv1d;
                }
                let index = layer.trim_start_matches(|c: char| c.is_ascii_alphabetic());
                name.push(index.into());
            }
            ("query_embed_fg" | "query_embed_test", _) => name.push(part.clone()),
            (_, "gamma") => name.push("weight".into()),
            (_, "beta") => name.push("bias".into()),
            (index, "conv" | "norm") if i >= 2 && path[i - 2] == "tower" => {
                // Conv, norm, ReLU per layer: indices 3i and 3i + 1.
                let base = index.parse::<usize>().map_or(0, |n| 3 * n);
                name.pop();
                name.push((base + usize::from(part == "norm")).to_string());
            }
            _ if efficientnet && i > 1 && i < last && !is_index(part) => {
                name.push(format!("_{part}"));
            }
            _ => name.push(part.clone()),
        }
    }
    match path.get(last).map(String::as_str) {
        Some("query_embed_fg" | "query_embed_test") => name.push("weight".into()),
        Some("weight") if layout == Layout::Same && path.len() >= 2 => {
            if path.first().is_some_and(|p| p == "head")
                && matches!(path[last - 1].as_str(), "linear" | "linear1" | "linear2" | "out_proj")
            {
                layout = Layout::Linear;
            }
            if path.len() == 3 && path[0] == "head" && path[1] == "feature_extractor" {
                name.insert(2, "0".into());
            }
        }
        _ => {}
    }
    (name.join("."), layout)
}

fn is_index(part: &str) -> bool {
    part.bytes().all(|b| b.is_ascii_digit())
}
