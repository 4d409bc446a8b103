//! The filling recipe: weights from names, so that a network of 50 million numbers need not be
//! shipped to be compared.

use tsda_trainer::import::{self, StateDict, StateTensor, TensorMismatch};
use tsda_trainer::model::TrackerNet;

/// The stream of a name: FNV-1a (64 bits) seeds SplitMix64.
fn stream(name: &str) -> impl Iterator<Item = u64> + use<> {
    let hash = name
        .bytes()
        .fold(0xcbf2_9ce4_8422_2325u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3));
    (1u64..).map(move |i| {
        let mut z = hash.wrapping_add(i.wrapping_mul(0x9E37_79B9_7F4A_7C15));
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    })
}

/// Middle and reach of a tensor's values; the first rule that fits decides.
fn range(name: &str, shape: &[usize]) -> (f64, f64) {
    let embedding = ["query_embed_fg.weight", "query_embed_test.weight"];
    if name.ends_with(".running_mean") {
        return (0.0, 0.2);
    }
    if name.ends_with(".running_var") {
        return (1.0, 0.5);
    }
    if embedding.iter().any(|e| name.ends_with(e)) {
        return (0.0, 1.0);
    }
    if shape.len() == 1 {
        return match name {
            n if n.ends_with("bn3.weight") => (0.3, 0.1),
            n if n.ends_with(".weight") => (1.0, 0.2),
            _ => (0.0, 0.1),
        };
    }
    let gain = match name {
        "head.classifier.linear.weight" | "head.bb_regressor.linear.weight" => 1.0 / 64.0,
        "head.bb_regressor.bbreg_layer.weight" => 0.25,
        n if n.starts_with("feature_extractor.") || n.contains(".tower.") => 2.0,
        _ => 1.0,
    };
    let fan_in: usize = shape.iter().skip(1).product();
    (0.0, (3.0 * gain / fan_in as f64).sqrt())
}

/// Values of the tensor with this state-dict name and shape.
pub fn values(name: &str, shape: &[usize]) -> Vec<f32> {
    let (middle, reach) = range(name, shape);
    let unit = |z: u64| 2.0 * ((z >> 40) as f64 / 16_777_216.0) - 1.0;
    let count = shape.iter().product();
    stream(name).take(count).map(|z| (middle + reach * unit(z)) as f32).collect()
}

/// `net` with every parameter and running statistic from its name.
///
/// # Errors
/// Never for a network of this workspace; the differences, if its names were not unique.
pub fn fill(net: TrackerNet) -> Result<TrackerNet, TensorMismatch> {
    let mut dict = StateDict::default();
    for (name, tensor) in import::state_dict(&net).iter() {
        let values = values(name, &tensor.shape);
        dict.insert(name.into(), StateTensor { shape: tensor.shape.clone(), values });
    }
    Ok(import::apply(net, &dict, "")?.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_those_of_the_recipe() {
        // First values and the last one, as the figures' own check file has them.
        for (name, shape, first, last) in [
            (
                "feature_extractor.conv1.weight",
                &[64, 3, 7, 7][..],
                [-0.002_166_444_4, -0.024_084_443],
                -0.195_192_07,
            ),
            (
                "feature_extractor.layer3.0.bn3.weight",
                &[1024],
                [0.214_508_13, 0.217_361_94],
                0.362_972_2,
            ),
            ("feature_extractor.bn1.running_var", &[64], [1.450_776_7, 0.918_480_46], 0.659_150_66),
        ] {
            let values = values(name, shape);
            assert_eq!([values[0], values[1]], first, "{name}");
            assert_eq!(values.last(), Some(&last), "{name}");
        }
    }
}
