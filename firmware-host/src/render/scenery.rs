//! What does not move: sky, houses, trees, street, posts.

use super::canvas::{Canvas, Texel, blend, mix, smooth};
use super::light::{Camera, LAMPS, Light};
use super::noise::{self, octaves, unit};
use super::walker::shadow;

/// Depth of the house fronts, metres.
const FACADES: f32 = 46.0;
/// Depth of the hedge before them.
const HEDGE: f32 = 33.0;
/// Near kerb and far kerb of the road.
const ROAD: (f32, f32) = (11.2, 18.0);

/// Sky, houses, hedge and ground: everything behind the things that stand on the ground.
pub(super) fn backdrop(canvas: &mut Canvas, camera: &Camera, light: &Light, seed: u32) {
    let area = (0.0, 0.0, canvas.width as f32, canvas.height as f32);
    let s = camera.scale(FACADES);
    let feet = camera.centre.1 + camera.height * s;
    canvas.fill(area, |sx, sy| {
        if sy < feet {
            let (x, y) = ((sx - camera.centre.0) / s, camera.height - (sy - camera.centre.1) / s);
            let (texel, roof) = facade(light, x, y, 1.0 / s, seed);
            let sky = sky(light, sx - camera.centre.0, sy, seed);
            (1.0, blend(sky, texel, roof))
        } else {
            let z = camera.focal * camera.height / (sy - camera.centre.1).max(0.5);
            let x = (sx - camera.centre.0) * z / camera.focal;
            (1.0, ground(light, camera, x, z, seed))
        }
    });
    let s = camera.scale(HEDGE);
    let feet = camera.centre.1 + camera.height * s;
    canvas.fill((0.0, feet - 2.4 * s, area.2, feet + 1.0), |sx, sy| {
        let (x, y) = ((sx - camera.centre.0) / s, camera.height - (sy - camera.centre.1) / s);
        let top = 0.9 + 1.1 * octaves(x * 0.45, 3.0, (0.05, 0.05), 4, seed ^ 0x51);
        let leaf = octaves(x * 1.6, y * 1.6, (1.6 / s, 1.6 / s), 4, seed ^ 0x52);
        let coverage = (top - y) * s + (leaf - 0.5) * 6.0;
        let lit = 0.35 + 1.1 * leaf + 0.25 * (y / top);
        let albedo = [0.055 * lit, 0.085 * lit, 0.035 * lit];
        (coverage, light.shade(albedo, 0.27 + 0.13 * leaf, (x, HEDGE)))
    });
}

fn sky(light: &Light, x: f32, sy: f32, seed: u32) -> Texel {
    let cloud = octaves(x * 0.011, sy * 0.034, (0.01, 0.03), 5, seed ^ 0x11);
    let cloud = smooth(0.42, 0.68, cloud);
    let low = smooth(-10.0, 75.0, sy);
    let dusk = blend([0.26, 0.33, 0.50], [0.80, 0.55, 0.38], low);
    let dusk = blend(dusk, [0.62, 0.50, 0.48], cloud * 0.7);
    let night = blend([0.012, 0.016, 0.03], [0.035, 0.032, 0.038], low);
    let [r, g, b] = blend(dusk, night, light.night);
    [r, g, b, 0.03 + 0.08 * low + 0.10 * cloud]
}

/// A row of houses of different width, height and colour. The second value is 0 above the roofs.
fn facade(light: &Light, x: f32, y: f32, pixel: f32, seed: u32) -> (Texel, f32) {
    const PLOT: f32 = 11.0;
    let plot = libm::floorf(x / PLOT);
    let house = plot as i32;
    let pick = |k: i32| unit(house, k, seed ^ 0xB0);
    let along = x - plot * PLOT;
    let storeys = 2 + (pick(1) * 2.6) as i32;
    let eaves = storeys as f32 * 2.9 + 0.7;
    let ridge = if pick(2) < 0.6 { 2.2 - (along - PLOT * 0.5).abs() * 0.42 } else { 0.0 };
    let roof = ((eaves + ridge.max(0.0) - y) / pixel).clamp(0.0, 1.0);
    let grain = octaves(x * 0.9, y * 1.3, (pixel, pixel), 4, seed ^ 0xB1) - 0.5;
    let warm = pick(3);
    let wall = blend([0.36, 0.30, 0.25], [0.50, 0.47, 0.43], warm);
    let wall = blend(wall, [0.34, 0.17, 0.12], smooth(0.62, 0.64, pick(4)));
    let mut albedo = wall.map(|c| c * (0.85 + 0.5 * grain));
    let mut heat = 0.30 + 0.10 * pick(5) + 0.10 * grain;
    let mut glow = [0.0; 3];
    if y > eaves {
        albedo = [0.13, 0.09, 0.08].map(|c| c * (0.9 + 0.8 * grain));
        heat = 0.17 + 0.08 * grain;
    } else {
        // Windows: one per 2.2 m of wall and storey, some of them lit.
        let (column, row) = (libm::floorf(along / 2.2), libm::floorf(y / 2.9));
        let (u, v) = (along - column * 2.2 - 1.1, y - row * 2.9 - 1.6);
        let edge = (u.abs() - 0.52).max(v.abs() - 0.70);
        let inside = (0.5 - edge / pixel).clamp(0.0, 1.0);
        let frame = (0.5 - (edge - 0.14) / pixel).clamp(0.0, 1.0);
        if column < 5.0 && row < storeys as f32 {
            let lamp = unit(house * 31 + column as i32, row as i32, seed ^ 0xB3);
            albedo = blend(albedo, [0.55, 0.53, 0.50], frame * 0.6);
            albedo = blend(albedo, [0.05, 0.06, 0.075], inside);
            heat = mix(heat, if lamp < 0.30 { 0.47 } else { 0.22 }, inside);
            heat += 0.05 * (frame - inside);
            if lamp < 0.30 {
                let on = inside * mix(0.10, 0.42, light.night) * (0.6 + 1.3 * lamp);
                glow = [on, on * 0.72, on * 0.38];
            }
        }
    }
    // Gaps between plots are darker: the side wall in shadow.
    let gap = smooth(0.5, 0.25, along);
    albedo = blend(albedo, [0.05, 0.05, 0.05], gap * 0.8);
    heat -= gap * 0.06;
    let mut texel = light.shade(albedo, heat, (x, FACADES));
    for (t, g) in texel.iter_mut().zip(glow) {
        *t += g;
    }
    (texel, roof)
}

fn ground(light: &Light, camera: &Camera, x: f32, z: f32, seed: u32) -> Texel {
    let foot = (z / camera.focal, z * z / (camera.focal * camera.height));
    let noise = |fx: f32, fz: f32, n, salt| {
        octaves(x * fx, z * fz, (foot.0 * fx, foot.1 * fz), n, seed ^ salt)
    };
    let soft = foot.1.max(0.05);
    let band = |lo: f32, hi: f32| smooth(lo - soft, lo + soft, z) * smooth(hi + soft, hi - soft, z);
    let broad = noise(0.35, 0.5, 4, 0x21);
    let fine = noise(5.0, 7.0, 3, 0x22) - 0.5;
    // Lawn first, then what was laid over it.
    let blade = noise(9.0, 6.0, 3, 0x23);
    let mut albedo = blend([0.09, 0.12, 0.045], [0.17, 0.16, 0.07], broad);
    albedo = albedo.map(|c| c * (0.55 + 0.9 * blade));
    let mut heat = 0.20 + 0.12 * broad + 0.10 * (blade - 0.5);
    let mut lay = |a: f32, colour: [f32; 3], t: f32| {
        albedo = blend(albedo, colour, a);
        heat = mix(heat, t, a);
    };
    // Pavements of slabs, kerbs, asphalt with patches, cracks and a worn centre line.
    for (near, far) in [(6.2, ROAD.0 - 0.25), (ROAD.1 + 0.25, 20.6)] {
        let (sx, sz) = (x / 0.9, z / 0.9);
        let slab = unit(libm::floorf(sx) as i32, libm::floorf(sz) as i32, seed ^ 0x24);
        let joint = |v: f32, f: f32| {
            let d = (v - libm::floorf(v) - 0.5).abs();
            smooth(0.5 - 0.03 - f / 0.9, 0.5, d) * (0.05 / f).min(1.0)
        };
        let joint = joint(sx, foot.0).max(joint(sz, foot.1));
        let tone = 0.30 + 0.05 * slab + 0.10 * (broad - 0.5) + 0.12 * fine - 0.12 * joint;
        let t = 0.37 + 0.03 * slab + 0.07 * (broad - 0.5) - 0.03 * joint;
        lay(band(near, far), [tone, tone * 0.95, tone * 0.88], t);
    }
    let tone = 0.115 + 0.07 * (broad - 0.5) + 0.09 * fine;
    let worn = noise(0.15, 2.2, 3, 0x25);
    lay(band(ROAD.0, ROAD.1), [tone, tone, tone * 1.04], 0.46 + 0.10 * (worn - 0.5) + 0.04 * fine);
    for kerb in [ROAD.0 - 0.13, ROAD.1 + 0.13] {
        lay(band(kerb - 0.12, kerb + 0.12), [0.36, 0.35, 0.33], 0.34);
    }
    let dash = x / 5.0 - libm::floorf(x / 5.0);
    let line = band(14.52, 14.68) * smooth(0.0, 0.02, dash) * smooth(0.56, 0.54, dash);
    lay(line * (0.55 + 0.6 * broad), [0.55, 0.54, 0.50], 0.43);
    for edge in [ROAD.0 + 0.35, ROAD.1 - 0.35] {
        lay(band(edge - 0.06, edge + 0.06) * 0.7, [0.46, 0.45, 0.42], 0.44);
    }
    light.shade(albedo, heat, (x, z))
}

/// A tree at `(x, z)`: trunk and a crown of overlapping balls with leaves.
pub(super) fn tree(
    canvas: &mut Canvas,
    camera: &Camera,
    light: &Light,
    (x, z): (f32, f32),
    tall: f32,
    seed: u32,
) {
    let s = camera.scale(z);
    shadow(canvas, camera, (x, z), (1.6, 0.6), 0.5 * (1.0 - 0.6 * light.night));
    let balls: [(f32, f32, f32); 11] = core::array::from_fn(|i| {
        let i = i as i32;
        let angle = unit(i, 1, seed) * core::f32::consts::TAU;
        let far = unit(i, 2, seed);
        (
            libm::cosf(angle) * far * tall * 0.26,
            tall * 0.68 + libm::sinf(angle) * far * tall * 0.22,
            tall * (0.10 + 0.08 * unit(i, 3, seed)),
        )
    });
    let (left, top) = camera.project(x - tall * 0.5, tall * 1.15, z);
    let (right, bottom) = camera.project(x + tall * 0.5, 0.0, z);
    canvas.fill((left, top, right, bottom), |sx, sy| {
        let (px, py) = ((sx - camera.centre.0) / s - x, camera.height - (sy - camera.centre.1) / s);
        let leaf = octaves(px * 1.7, py * 1.7, (1.7 / s, 1.7 / s), 4, seed ^ 0x31);
        let d = balls.iter().map(|b| libm::hypotf(px - b.0, py - b.1) - b.2).fold(9.0, f32::min);
        let crown = (leaf - 0.42) * 0.9 * tall * 0.12 - d;
        if crown > 0.0 {
            let up = smooth(0.45, 0.95, py / tall);
            let lit = 0.25 + 1.2 * leaf * (0.5 + 0.7 * up);
            let heat = 0.23 + 0.12 * leaf - 0.03 * up;
            return (crown * s, light.shade([0.07 * lit, 0.10 * lit, 0.04 * lit], heat, (x, z)));
        }
        let radius = 0.16 - 0.015 * py + 0.05 * (0.4 - py).max(0.0);
        let bark = octaves(px * 8.0, py * 1.2, (8.0 / s, 1.2 / s), 3, seed ^ 0x32);
        let trunk = if py < tall * 0.75 { (radius - px.abs()) * s + 0.5 } else { 0.0 };
        let lit = 0.4 + bark - 0.8 * px;
        (trunk, light.shade([0.12 * lit, 0.09 * lit, 0.07 * lit], 0.31 + 0.04 * bark, (x, z)))
    });
}

/// A post of `tall` metres; the box on its top is `head` (half sides, metres).
pub(super) fn post(
    canvas: &mut Canvas,
    camera: &Camera,
    light: &Light,
    (x, z): (f32, f32),
    (tall, radius): (f32, f32),
    head: (f32, f32),
) {
    let s = camera.scale(z);
    let wide = radius.max(head.0) + 1.0 / s;
    let (left, top) = camera.project(x - wide, tall + head.1 + 0.1, z);
    let (right, bottom) = camera.project(x + wide, 0.0, z);
    canvas.fill((left, top, right, bottom), |sx, sy| {
        let (px, py) = ((sx - camera.centre.0) / s - x, camera.height - (sy - camera.centre.1) / s);
        let pole = if py < tall { radius - px.abs() } else { -1.0 };
        let plate = (head.0 - px.abs()).min(head.1 - (py - tall).abs());
        let grain = noise::value(px * 20.0, py * 3.0, 0x41);
        let (colour, heat) = if plate > pole { (0.24, 0.27) } else { (0.15, 0.31) };
        let tone = colour * (0.8 + 0.4 * grain - 1.2 * px);
        (pole.max(plate) * s + 0.5, light.shade([tone, tone, tone * 1.05], heat, (x, z)))
    });
}

/// The screen: distance, left and right side and upper edge in metres. Nearer than any walker, and
/// higher than they are in the picture.
const SCREEN: (f32, f32, f32, f32) = (8.6, -1.63, 1.03, 2.45);

/// Screen columns between which nothing behind the screen is seen.
pub(super) fn screen_sides(camera: &Camera) -> (f32, f32) {
    let (z, left, right, _) = SCREEN;
    (camera.project(left, 0.0, z).0, camera.project(right, 0.0, z).0)
}

/// A boarded fence across the way, as warm as the air.
pub(super) fn screen(canvas: &mut Canvas, camera: &Camera, light: &Light, seed: u32) {
    let (z, left, right, tall) = SCREEN;
    let s = camera.scale(z);
    let (x0, top) = camera.project(left, tall, z);
    let (x1, bottom) = camera.project(right, 0.0, z);
    canvas.fill((x0 - 1.0, top - 1.0, x1 + 1.0, bottom + 1.0), |sx, sy| {
        let (px, py) = ((sx - camera.centre.0) / s, camera.height - (sy - camera.centre.1) / s);
        let inside = (px - left).min(right - px).min(tall - py).min(py);
        let board = (px * 6.0) - libm::floorf(px * 6.0);
        let gap = if board < 0.06 { 0.55 } else { 1.0 };
        let grain = noise::octaves(px * 14.0, py * 2.5, (0.3, 0.3), 3, seed ^ 0x9700);
        let tone = gap * (0.26 + 0.16 * (grain - 0.5));
        let heat = 0.33 + 0.05 * (grain - 0.5);
        let colour = [tone, tone * 0.93, tone * 0.82];
        (inside * s + 0.5, light.shade(colour, heat, (px, z)))
    });
}

/// The street lamps with their light.
pub(super) fn lamps(canvas: &mut Canvas, camera: &Camera, light: &Light) {
    for place in LAMPS {
        post(canvas, camera, light, place, (5.4, 0.07), (0.34, 0.09));
        if light.lamps > 0.0 {
            let s = camera.scale(place.1);
            let top = camera.project(place.0, 5.32, place.1);
            let on = light.lamps;
            canvas.bloom(top, 0.20 * s, [1.3 * on, 1.0 * on, 0.62 * on]);
        }
    }
}
