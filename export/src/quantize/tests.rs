use super::calibrate::Histogram;
use super::graph::half_bits;

#[test]
fn halves_are_the_nearest() {
    let cases = [
        (0.0, 0x0000),
        (-0.0, 0x8000),
        (1.0, 0x3c00),
        (-2.0, 0xc000),
        (65504.0, 0x7bff),
        (0.333_333_34, 0x3555),
        // Halfway between two: to the even one.
        (1.000_488_3, 0x3c00),
        (1.001_464_8, 0x3c02),
        (5.960_464_5e-8, 0x0001),
        (2.0e-8, 0x0000),
        // Rounds up into the normal numbers.
        (6.103_4e-5, 0x0400),
    ];
    for (value, want) in cases {
        assert_eq!(half_bits(value), want, "{value}");
    }
}

#[test]
fn ranges_follow_what_was_seen() {
    let mut positive = Histogram::default();
    positive.add(&(0..600).map(|i| i as f32 * 0.01).collect::<Vec<_>>());
    let r = positive.rounding().unwrap();
    assert_eq!(r.zero, 0);
    assert!((r.scale * 255.0 - 5.99).abs() < 0.1, "{r:?}");

    // A later frame with larger values widens the bins.
    positive.add(&[-6.0; 600]);
    let r = positive.rounding().unwrap();
    assert!((125..=130).contains(&r.zero) && (r.scale * 255.0 - 12.0).abs() < 0.5, "{r:?}");

    // Two stray values among many small ones are cut off as far as it pays: rounding costs
    // 1e5 (2 r / 255)^2 / 12, clipping 2 (8 - r)^2, the sum is least at r = 6.37.
    let mut stray = Histogram::default();
    let many: Vec<f32> = (0..100_000).map(|i| (i % 1000) as f32 / 500.0 - 1.0).collect();
    stray.add(&many);
    stray.add(&[8.0, -8.0]);
    let r = stray.rounding().unwrap();
    assert!((r.scale * 255.0 - 2.0 * 6.37).abs() < 0.3, "{r:?}");
}

#[test]
fn what_has_no_range_is_told() {
    let mut none = Histogram::default();
    none.add(&[0.0; 10]);
    assert!(none.rounding().unwrap_err().contains("0 in every frame"));
    none.add(&[1.0, f32::NAN]);
    assert!(none.rounding().unwrap_err().contains("not finite"));
}
