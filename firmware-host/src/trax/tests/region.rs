//! Regions as text, and the boxes around them.

use super::*;
use proptest::prelude::*;
use tsda_runtime::BBox;

#[test]
fn boxes_around_regions() {
    for (text, want) in [
        ("397.0000,183.0000,100.0000,113.0000", BBox::new(397.0, 183.0, 100.0, 113.0)),
        (" 1 , 2,3,4", BBox::new(1.0, 2.0, 3.0, 4.0)),
        ("rect:1,2,3,4", BBox::new(1.0, 2.0, 3.0, 4.0)),
        ("-5,1e1,2.5,.5", BBox::new(-5.0, 10.0, 2.5, 0.5)),
        ("1,2,5,2,5,8", BBox::new(1.0, 2.0, 4.0, 6.0)),
        ("poly:10,0,20,10,10,20,0,10", BBox::new(0.0, 0.0, 20.0, 20.0)),
        // Starting with the background, with the target, over the ends of rows, with a tail.
        ("mask:10,20,4,3,5,2,5", BBox::new(11.0, 21.0, 2.0, 1.0)),
        ("mask:10,20,4,3,0,1", BBox::new(10.0, 20.0, 1.0, 1.0)),
        ("mask:0,0,4,3,3,2", BBox::new(0.0, 0.0, 4.0, 2.0)),
        ("mask:0,0,4,3,0,12", BBox::new(0.0, 0.0, 4.0, 3.0)),
        ("mask:-3,0,4,3,1,1,3,1,3,1,2", BBox::new(-2.0, 0.0, 1.0, 3.0)),
        ("mask:0,0,4,3,11,1", BBox::new(3.0, 2.0, 1.0, 1.0)),
    ] {
        let region = Region::parse(text).unwrap_or_else(|e| panic!("{text}: {e}"));
        assert_eq!(region.bounds(), Ok(want), "{text}");
    }
}

#[test]
fn regions_no_target_can_be_taken_from() {
    for (text, words) in [
        ("", "\"\" (number 1) is not a special code, and four numbers were expected"),
        ("0", "special region 0 says where no target is"),
        ("special:1", "special region 1"),
        ("1,2", "region of 2 numbers"),
        ("1,2,3,4,5", "region of 5 numbers"),
        ("1,2,3,4,5,6,7", "region of 7 numbers"),
        ("rect:1,2,3", "region of 3 numbers"),
        ("poly:1,2,3,4", "region of 4 numbers"),
        ("1,2,three,4", "\"three\" (number 3) is not a number"),
        ("nan,2,3,4", "number 1 is not finite"),
        ("1,2,inf,4", "number 3 is not finite"),
        ("1,2,3,1e39", "number 4 is not finite"),
        ("1,2,3,4,5,-inf", "number 6 is not finite"),
        ("10,10,0,5", "region 0 x 5 has no area"),
        ("10,10,5,-5", "region 5 x -5 has no area"),
        ("1,1,5,1,9,1", "region 8 x 0 has no area"),
        ("circle:1,2,3", "region kind \"circle\" is not known"),
        ("mask:1,2,3", "mask of 3 numbers"),
        ("mask:", "\"\" (number 1) is not a whole number"),
        ("mask:0,0,-4,3,1", "\"-4\" (number 3) is not a number of pixels"),
        ("mask:0,0,4,3,5,x", "\"x\" (number 6) is not a run length"),
        ("mask:0,0,4,3,-1", "\"-1\" (number 5) is not a run length"),
        ("mask:0,0,4,3,6,7", "mask of 4 x 3 pixels has run lengths for 13 pixels"),
        ("mask:0,0,4,3,12", "mask of 4 x 3 pixels is empty"),
        ("mask:0,0,4,3", "mask of 4 x 3 pixels is empty"),
        ("mask:0,0,4,3,2,0,5", "mask of 4 x 3 pixels is empty"),
        ("mask:0,0,0,0", "mask of 0 x 0 pixels is empty"),
    ] {
        let e = Region::parse(text).and_then(|r| r.bounds().map(|_| ())).expect_err(text);
        assert!(e.to_string().contains(words), "{text}: {e}");
    }
    let long = Region::parse(&"x".repeat(10_000)).expect_err("long");
    assert!(long.to_string().len() < 200, "{long}");
}

fn region() -> impl Strategy<Value = Region> {
    let number = || prop::num::f32::NORMAL | prop::num::f32::ZERO;
    prop_oneof![
        any::<i32>().prop_map(Region::Special),
        [number(), number(), number(), number()]
            .prop_map(|[x, y, w, h]| Region::Rectangle(BBox::new(x, y, w, h))),
        prop::collection::vec([number(), number()], 3..9).prop_map(Region::Polygon),
        mask().prop_map(|(mask, _)| Region::Mask(mask)),
    ]
}

/// A mask and its pixels.
fn mask() -> impl Strategy<Value = (Mask, Vec<bool>)> {
    (-50i32..50, -50i32..50, 1u32..9, 1u32..9)
        .prop_flat_map(|(x, y, w, h)| {
            let pixels = prop::collection::vec(prop::bool::weighted(0.2), (w * h) as usize);
            (Just((x, y, w, h)), pixels)
        })
        .prop_map(|((x, y, w, h), pixels)| {
            let (mut runs, mut inside) = (vec![0u32], false);
            for &pixel in &pixels {
                if pixel != inside {
                    runs.push(0);
                    inside = pixel;
                }
                *runs.last_mut().expect("a run") += 1;
            }
            (Mask::new(x, y, w, h, runs).expect("fits"), pixels)
        })
}

proptest! {
    #[test]
    fn regions_survive_the_wire(region in region()) {
        prop_assert_eq!(Region::parse(&region.to_string()), Ok(region));
    }

    #[test]
    fn mask_bounds_are_those_of_its_pixels((mask, pixels) in mask()) {
        let w = mask.width as usize;
        let inside: Vec<(usize, usize)> =
            (0..pixels.len()).filter(|&i| pixels[i]).map(|i| (i % w, i / w)).collect();
        let Ok(b) = mask.bounds() else {
            prop_assert!(inside.is_empty());
            return Ok(());
        };
        let left = inside.iter().map(|p| p.0).min().expect("pixels");
        let right = inside.iter().map(|p| p.0).max().expect("pixels") + 1;
        let top = inside.iter().map(|p| p.1).min().expect("pixels");
        let bottom = inside.iter().map(|p| p.1).max().expect("pixels") + 1;
        prop_assert_eq!((b.x, b.y), ((mask.x + left as i32) as f32, (mask.y + top as i32) as f32));
        prop_assert_eq!((b.w, b.h), ((right - left) as f32, (bottom - top) as f32));
    }

    #[test]
    fn no_text_panics(text in "(mask:|poly:|)[0-9,.:einfa+-]{0,40}") {
        if let Ok(region) = Region::parse(&text) {
            let _ = region.bounds();
        }
    }
}
