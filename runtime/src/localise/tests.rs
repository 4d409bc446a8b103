use super::*;
use proptest::prelude::*;

const SIDE: usize = 18;

type Peaks = &'static [(usize, usize, f32)];
/// Name, peaks, previous offset, expected flag and cell.
type Case = (&'static str, Peaks, Yx, Flag, (usize, usize));

/// A map of zeros with these peaks (row, column, score), read with a target of 2 x 2 cells.
fn read(peaks: &[(usize, usize, f32)], previous: Yx) -> Located {
    let mut scores = vec![0.0; SIDE * SIDE];
    for &(r, c, v) in peaks {
        scores[r * SIDE + c] = v;
    }
    localise(&scores, SIDE, &TrackerParams::default(), Yx::new(2.0, 2.0), previous)
}

#[test]
fn every_rule_of_the_decision() {
    let near = Yx::default();
    let corner = Yx::new(-8.5, -8.5);
    let cases: [Case; 9] = [
        ("nothing", &[(3, 4, 0.2)], near, Flag::NotFound, (3, 4)),
        ("at the threshold", &[(3, 4, 0.25)], near, Flag::Normal, (3, 4)),
        ("one peak", &[(9, 9, 0.9)], near, Flag::Normal, (9, 9)),
        ("second in the block", &[(9, 9, 0.9), (11, 7, 0.89)], near, Flag::Normal, (9, 9)),
        ("low second", &[(9, 9, 0.9), (2, 9, 0.5)], near, Flag::HardNegative, (9, 9)),
        ("far second", &[(9, 9, 0.9), (1, 1, 0.8)], near, Flag::HardNegative, (9, 9)),
        ("far first", &[(17, 17, 0.9), (2, 2, 0.8)], corner, Flag::HardNegative, (2, 2)),
        ("both near", &[(9, 9, 0.9), (4, 9, 0.8)], near, Flag::Uncertain, (9, 9)),
        ("both far", &[(9, 9, 0.9), (17, 17, 0.8)], corner, Flag::Uncertain, (9, 9)),
    ];
    for (name, peaks, previous, flag, cell) in cases {
        let found = read(peaks, previous);
        assert_eq!((found.flag, (found.cell.row, found.cell.col)), (flag, cell), "{name}");
    }
}

#[test]
fn ties_go_to_the_smaller_column_then_row() {
    let at = |peaks: &[(usize, usize, f32)]| read(peaks, Yx::default()).first.cell;
    assert_eq!(at(&[(12, 5, 0.9), (3, 8, 0.9)]), Cell { row: 12, col: 5 });
    assert_eq!(at(&[(12, 5, 0.9), (3, 5, 0.9)]), Cell { row: 3, col: 5 });
    assert_eq!(at(&[]), Cell { row: 0, col: 0 });
}

#[test]
fn the_masked_block_counts_as_zero() {
    let scores = vec![-1.0; 16];
    let params = TrackerParams { not_found: -2.0, ..Default::default() };
    let found = localise(&scores, 4, &params, Yx::new(0.1, 0.1), Yx::default());
    let second = found.second.unwrap();
    assert_eq!((second.score, second.cell), (0.0, Cell { row: 0, col: 0 }));
}

proptest! {
    #[test]
    fn any_map_gives_cells_inside(
        scores in proptest::collection::vec(prop_oneof![-2f32..2.0, Just(f32::NAN)], 25),
        h in 0f32..50.0, w in 0f32..50.0, y in -9f32..9.0, x in -9f32..9.0,
    ) {
        let params = TrackerParams::default();
        let found = localise(&scores, 5, &params, Yx::new(h, w), Yx::new(y, x));
        prop_assert!(found.cell.row < 5 && found.cell.col < 5);
        let max = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        prop_assert_eq!(found.first.score, max);
        prop_assert_eq!(found.flag == Flag::NotFound, max < 0.25);
        if let Some(second) = found.second {
            prop_assert!(second.score <= max);
        }
    }
}
