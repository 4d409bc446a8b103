use super::*;
use crate::testing::golden_tensors;

fn worst(found: &[f32], want: &[f32]) -> f32 {
    assert_eq!(found.len(), want.len());
    found.iter().zip(want).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn labels_and_ltrb_maps_equal_the_reference() {
    let (spec, golden) = (ModelSpec::TOMP101, golden_tensors("labels.safetensors"));
    let (cells, boxes) = (spec.cells(), &golden["boxes"].1);
    let (mut label, mut map) = (vec![0.0; cells], vec![0.0; 4 * cells]);
    assert_eq!(boxes.len(), 28);
    for (i, b) in boxes.chunks_exact(4).enumerate() {
        template_maps(&spec, &BBox::new(b[0], b[1], b[2], b[3]), &mut label, &mut map);
        let want = &golden["train_label.sigma0.9.f18"].1[i * cells..][..cells];
        assert!(worst(&label, want) < 2e-6, "label of box {i}: {}", worst(&label, want));
        let want = &golden["ltrb_target"].1[4 * i * cells..][..4 * cells];
        assert!(worst(&map, want) < 1e-6, "ltrb of box {i}: {}", worst(&map, want));
    }
}

#[test]
fn tracker_labels_equal_the_reference() {
    let (spec, golden) = (ModelSpec::TOMP101, golden_tensors("labels.safetensors"));
    let cells = spec.cells();
    let mut label = vec![0.0; cells];
    for (i, c) in golden["tracker_label.center_yx"].1.chunks_exact(2).enumerate() {
        let sigma = golden["tracker_label.sigma"].1[i];
        gaussian(Yx::new(c[0], c[1]), sigma, spec.map_side(), &mut label);
        let want = &golden["tracker_label"].1[i * cells..][..cells];
        assert!(worst(&label, want) < 2e-6, "label {i}: {}", worst(&label, want));
    }
}

#[test]
fn a_centred_target_has_a_symmetric_label_on_every_map_size() {
    for crop in [16, 144, 160, 288] {
        let spec = ModelSpec { crop, ..ModelSpec::NANO };
        let side = f32::from(crop);
        let bbox = BBox::new(side * 0.4, side * 0.3, side * 0.2, side * 0.4);
        let mut label = vec![0.0; spec.cells()];
        let mut map = vec![0.0; 4 * spec.cells()];
        template_maps(&spec, &bbox, &mut label, &mut map);
        let mirrored: Vec<f32> = label.iter().rev().copied().collect();
        assert!(worst(&label, &mirrored) < 1e-5, "crop {crop}");
        // Left plus right is the width, top plus bottom the height, in every cell.
        let n = spec.cells();
        for cell in 0..n {
            assert!((map[cell] + map[2 * n + cell] - 0.2).abs() < 1e-5);
            assert!((map[n + cell] + map[3 * n + cell] - 0.4).abs() < 1e-5);
        }
    }
}

#[test]
fn buffers_of_the_wrong_size_are_harmless() {
    gaussian(Yx::default(), 1.0, 0, &mut []);
    let mut short = [7.0; 5];
    gaussian(Yx::default(), 1.0, 3, &mut short);
    assert_eq!(short[3..], [7.0, 7.0]);
    ltrb(&ModelSpec::NANO, &BBox::new(0.0, 0.0, 1.0, 1.0), &mut short);
    assert_eq!(short[4], 7.0);
}
