//! Products with constant matrices: convolutions as implicit GEMM and linear layers. Rows are
//! pixels or tokens wherever they lie; weights are packed into panels, in the order they are read.

use super::simd::{Simd, hard_swish};
use super::table::{Kernels, MAX_ROWS, MAX_VECTORS};
use super::{Halo, Mem, Part, Pitch, Place};

/// Panels of packed weights smaller than this stay in the second-level cache, so tiles of rows can
/// be the outer loop.
const RESIDENT: usize = 96 * 1024;

/// Computes one tile.
pub type TileFn = unsafe fn(&Tile);

/// `out = clamp(in * weights + bias + residual)`, with a hard-swish before the limits if wanted.
#[derive(Clone, Debug)]
pub struct Gemm {
    /// Rows: lines and pixels per line.
    pub size: [usize; 2],
    /// First element of the first row's window.
    pub input: Place,
    /// From row to row of the input.
    pub input_pitch: Pitch,
    /// Offsets of the runs of `run` channels that a window consists of.
    pub taps: Box<[usize]>,
    /// Elements per tap.
    pub run: usize,
    /// Packed weights: [`Packing`] of `taps * run` rows.
    pub weights: Place,
    /// Bias, padded with zeros to the packed width.
    pub bias: Option<usize>,
    /// Columns of the result.
    pub columns: usize,
    /// First element of the result, in the arena.
    pub output: usize,
    /// From row to row of the result.
    pub output_pitch: Pitch,
    /// Added before the limits; same size as the result.
    pub residual: Option<(Place, Pitch)>,
    /// Whether the result is the hard-swish of the sum.
    pub swish: bool,
    /// Range of the result.
    pub clamp: (f32, f32),
    /// Zeros around the result.
    pub halo: Option<Halo>,
    /// Rows whose inputs fit into the second-level cache together with a panel.
    pub block: usize,
    /// With it input and weights are 8-bit numbers, four in the place of a float
    /// ([`super::Eight`]), and these are the factors of the columns, padded like the bias, which
    /// must be there.
    pub scales: Option<usize>,
}

/// How weights are laid out: panels of `width` columns, the last one of as many whole vectors as it
/// needs; in a panel all rows one after the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Packing {
    /// Columns of a panel.
    pub width: usize,
    /// Floats of a vector.
    pub lanes: usize,
}

impl Packing {
    /// Columns with padding.
    pub const fn columns(&self, columns: usize) -> usize {
        columns.next_multiple_of(self.lanes)
    }

    /// Floats of a packed matrix.
    pub const fn len(&self, rows: usize, columns: usize) -> usize {
        rows * self.columns(columns)
    }

    /// Appends a matrix, given by `row(k, out)`, which fills row `k`.
    pub fn pack(
        &self,
        rows: usize,
        columns: usize,
        mut row: impl FnMut(usize, &mut [f32]),
        out: &mut Vec<f32>,
    ) {
        let start = out.len();
        out.resize(start + self.len(rows, columns), 0.0);
        let out = &mut out[start..];
        let mut line = vec![0.0; columns];
        for k in 0..rows {
            row(k, &mut line);
            for (panel, part) in line.chunks(self.width).enumerate() {
                let width = part.len().next_multiple_of(self.lanes);
                let at = panel * self.width * rows + k * width;
                out[at..at + part.len()].copy_from_slice(part);
            }
        }
    }
}

/// Operands of one tile; rows that are not used repeat nothing and are never read.
pub struct Tile {
    /// Rows of the input.
    pub a: [*const f32; MAX_ROWS],
    /// Rows of the result.
    pub c: [*mut f32; MAX_ROWS],
    /// Rows of the residual, if there is one.
    pub r: [*const f32; MAX_ROWS],
    /// Offsets of the taps.
    pub taps: *const usize,
    /// Number of taps.
    pub tap_count: usize,
    /// Elements per tap.
    pub run: usize,
    /// Panel of packed weights.
    pub b: *const f32,
    /// Bias of the panel's columns, or null.
    pub bias: *const f32,
    /// Column of the panel's first one.
    pub column: usize,
    /// Columns to store.
    pub columns: usize,
    /// Factors of the columns; products of 8-bit numbers only.
    pub scales: *const f32,
    /// Whether `r` is read.
    pub residual: bool,
    /// Factors of the rows, or null.
    pub factors: *const f32,
    /// Whether the hard-swish of the sums is stored.
    pub swish: bool,
    /// Range of the result.
    pub clamp: (f32, f32),
}

impl Tile {
    pub const EMPTY: Self = Self {
        a: [core::ptr::null(); MAX_ROWS],
        c: [core::ptr::null_mut(); MAX_ROWS],
        r: [core::ptr::null(); MAX_ROWS],
        taps: core::ptr::null(),
        tap_count: 0,
        run: 0,
        b: core::ptr::null(),
        bias: core::ptr::null(),
        column: 0,
        columns: 0,
        scales: core::ptr::null(),
        residual: false,
        factors: core::ptr::null(),
        swish: false,
        clamp: UNLIMITED,
    };
}

/// Limits that change nothing.
const UNLIMITED: (f32, f32) = (f32::NEG_INFINITY, f32::INFINITY);

/// Terms that are summed before the sum goes to a total of such sums: rounding errors grow with the
/// number of terms, and the deepest convolutions have 9,216.
const CHUNK: usize = 256;

/// `R` rows times `NV` vectors of columns, kept in registers over a chunk of the sum.
///
/// # Safety
/// The instruction set is there; all pointers of the tile are valid for its sizes; `columns` is
/// above `(NV - 1)` vectors and at most `NV`.
#[inline(always)]
pub unsafe fn tile<S: Simd, const R: usize, const NV: usize>(t: &Tile) {
    // SAFETY: as promised by the caller.
    unsafe {
        let mut acc = [[S::splat(0.0); NV]; R];
        let mut total = core::mem::MaybeUninit::<[[[f32; MAX_LANES]; NV]; R]>::uninit();
        let total: *mut f32 = total.as_mut_ptr().cast();
        let place = |r: usize, j: usize| total.add((r * NV + j) * MAX_LANES);
        let (mut folded, mut summed) = (false, 0);
        // Lines of the residual lie a row apart, where no processor foresees them.
        if t.residual {
            for r in 0..R {
                for j in 0..NV {
                    S::prefetch(t.r[r].wrapping_add(t.column + j * S::LANES));
                }
            }
        }
        let mut b = t.b;
        for tap in 0..t.tap_count {
            let offset = *t.taps.add(tap);
            let mut a = [core::ptr::null::<f32>(); R];
            for r in 0..R {
                a[r] = t.a[r].add(offset);
            }
            let mut from = 0;
            while from < t.run {
                if summed >= CHUNK {
                    for r in 0..R {
                        for j in 0..NV {
                            if folded {
                                acc[r][j] = S::add(acc[r][j], S::load(place(r, j)));
                            }
                            S::store(place(r, j), acc[r][j]);
                            acc[r][j] = S::splat(0.0);
                        }
                    }
                    (folded, summed) = (true, 0);
                }
                let to = t.run.min(from + CHUNK);
                for k in from..to {
                    let mut weights = [S::splat(0.0); NV];
                    for j in 0..NV {
                        weights[j] = S::load(b.add(j * S::LANES));
                    }
                    b = b.add(NV * S::LANES);
                    for r in 0..R {
                        let x = S::splat(*a[r].add(k));
                        for j in 0..NV {
                            acc[r][j] = S::fma(x, weights[j], acc[r][j]);
                        }
                    }
                }
                summed += to - from;
                from = to;
            }
        }
        if folded {
            for r in 0..R {
                for j in 0..NV {
                    acc[r][j] = S::add(acc[r][j], S::load(place(r, j)));
                }
            }
        }
        // Every loop below is so small that it is unrolled and the sums stay in registers.
        if !t.factors.is_null() {
            for r in 0..R {
                let factor = S::splat(*t.factors.add(r));
                for j in 0..NV {
                    acc[r][j] = S::mul(acc[r][j], factor);
                }
            }
        }
        if !t.bias.is_null() {
            for j in 0..NV {
                let bias = S::load(t.bias.add(t.column + j * S::LANES));
                for r in 0..R {
                    acc[r][j] = S::add(acc[r][j], bias);
                }
            }
        }
        if t.columns == NV * S::LANES {
            if t.residual {
                for r in 0..R {
                    for j in 0..NV {
                        let residual = S::load(t.r[r].add(t.column + j * S::LANES));
                        acc[r][j] = S::add(acc[r][j], residual);
                    }
                }
            }
            if t.swish {
                for r in 0..R {
                    for j in 0..NV {
                        acc[r][j] = hard_swish::<S>(acc[r][j]);
                    }
                }
            }
            if t.clamp != UNLIMITED {
                let (low, high) = (S::splat(t.clamp.0), S::splat(t.clamp.1));
                for r in 0..R {
                    for j in 0..NV {
                        acc[r][j] = S::at_most(high, S::at_least(low, acc[r][j]));
                    }
                }
            }
            for r in 0..R {
                for j in 0..NV {
                    S::store(t.c[r].add(t.column + j * S::LANES), acc[r][j]);
                }
            }
            return;
        }
        let mut sums = [[[0.0f32; MAX_LANES]; NV]; R];
        for r in 0..R {
            for j in 0..NV {
                S::store(sums[r][j].as_mut_ptr(), acc[r][j]);
            }
        }
        ragged::<S, R, NV>(t, &sums);
    }
}

/// Stores sums of which the last vector is not whole.
#[inline(always)]
unsafe fn ragged<S: Simd, const R: usize, const NV: usize>(
    t: &Tile,
    sums: &[[[f32; MAX_LANES]; NV]; R],
) {
    // SAFETY: as for `tile`.
    unsafe {
        let (low, high) = (S::splat(t.clamp.0), S::splat(t.clamp.1));
        for (r, sums) in sums.iter().enumerate() {
            for (j, sums) in sums.iter().enumerate() {
                let at = t.column + j * S::LANES;
                let n = (t.columns - j * S::LANES).min(S::LANES);
                let mut y = S::load(sums.as_ptr());
                if t.residual {
                    y = S::add(y, S::load_n(t.r[r].add(at), n));
                }
                if t.swish {
                    y = hard_swish::<S>(y);
                }
                S::store_n(t.c[r].add(at), S::at_most(high, S::at_least(low, y)), n);
            }
        }
    }
}

/// Most floats of a vector of any instruction set.
const MAX_LANES: usize = 16;

/// Tiles of one type of numbers.
#[derive(Clone, Copy)]
struct Tiles<'k> {
    rows: usize,
    packing: Packing,
    of: &'k [[TileFn; MAX_ROWS]; MAX_VECTORS],
}

/// Rows and panels that one thread computes.
struct Share {
    tiles: core::ops::Range<usize>,
    panels: core::ops::Range<usize>,
}

impl Gemm {
    /// Rows of the product.
    pub const fn rows(&self) -> usize {
        self.size[0] * self.size[1]
    }

    /// Length of the sum.
    pub const fn depth(&self) -> usize {
        self.taps.len() * self.run
    }

    /// How its weights are packed.
    pub const fn packing(&self, k: &Kernels) -> Packing {
        if self.scales.is_some() { k.eight.packing } else { k.packing }
    }

    const fn tiles<'k>(&self, k: &'k Kernels) -> Tiles<'k> {
        let (rows, of) =
            if self.scales.is_some() { (k.eight.rows, &k.eight.tiles) } else { (k.rows, &k.tiles) };
        Tiles { rows, packing: self.packing(k), of }
    }

    /// Splits rows or columns, whichever comes out more evenly; of two even splits the one that
    /// reads less.
    fn share(&self, k: Tiles<'_>, part: Part) -> Share {
        let tiles = self.rows().div_ceil(k.rows);
        let panels = self.columns.div_ceil(k.packing.width);
        let busy = |n: usize| n as f32 / (n.div_ceil(part.of) * part.of) as f32;
        let (by_rows, by_columns) = (busy(tiles), busy(panels));
        let weights_larger = self.columns * self.depth() > self.rows() * self.run;
        if by_rows > by_columns + 0.02 || (by_rows >= by_columns - 0.02 && !weights_larger) {
            Share { tiles: part.of(tiles), panels: 0..panels }
        } else {
            Share { tiles: 0..tiles, panels: part.of(panels) }
        }
    }

    /// Computes this thread's part.
    ///
    /// # Safety
    /// The step was checked against this memory, and nobody writes what it reads or touches what it
    /// writes.
    pub(super) unsafe fn run(&self, k: &Kernels, mem: Mem, part: Part) {
        // SAFETY: the step was checked.
        unsafe {
            if let Some(halo) = self.halo.as_ref().filter(|_| part.id == 0) {
                halo.clear(mem);
            }
            let k = self.tiles(k);
            let share = self.share(k, part);
            let mut tile = Tile {
                taps: self.taps.as_ptr(),
                tap_count: self.taps.len(),
                run: self.run,
                bias: self.bias.map_or(core::ptr::null(), |at| mem.weights.add(at)),
                scales: self.scales.map_or(core::ptr::null(), |at| mem.weights.add(at)),
                residual: self.residual.is_some(),
                swish: self.swish,
                clamp: self.clamp,
                ..Tile::EMPTY
            };
            let weights = share.panels.len() * k.packing.width * self.depth();
            if weights <= RESIDENT {
                for i in share.tiles {
                    let rows = self.point(&mut tile, k, mem, i);
                    for panel in share.panels.clone() {
                        self.panel(&mut tile, k, mem, panel, rows);
                    }
                }
                return;
            }
            let block = (self.block / k.rows).max(1);
            let mut start = share.tiles.start;
            while start < share.tiles.end {
                let end = (start + block).min(share.tiles.end);
                for panel in share.panels.clone() {
                    for i in start..end {
                        let rows = self.point(&mut tile, k, mem, i);
                        self.panel(&mut tile, k, mem, panel, rows);
                    }
                }
                start = end;
            }
        }
    }

    /// Points the tile at rows `i * k.rows ..`; returns how many there are.
    #[inline]
    unsafe fn point(&self, tile: &mut Tile, k: Tiles<'_>, mem: Mem, i: usize) -> usize {
        let first = i * k.rows;
        let rows = k.rows.min(self.rows() - first);
        let (mut y, mut x) = (first / self.size[1], first % self.size[1]);
        let along = |p: Pitch, y: usize, x: usize| y * p.y + x * p.x;
        // SAFETY: rows below `self.rows()`, which the check covers.
        unsafe {
            let input = mem.at(self.input);
            for r in 0..rows {
                tile.a[r] = input.add(along(self.input_pitch, y, x));
                tile.c[r] = mem.arena.add(self.output + along(self.output_pitch, y, x));
                if let Some((place, pitch)) = self.residual {
                    tile.r[r] = mem.at(place).add(along(pitch, y, x));
                }
                x += 1;
                if x == self.size[1] {
                    (y, x) = (y + 1, 0);
                }
            }
        }
        rows
    }

    #[inline]
    unsafe fn panel(&self, tile: &mut Tile, k: Tiles<'_>, mem: Mem, panel: usize, rows: usize) {
        tile.column = panel * k.packing.width;
        tile.columns = k.packing.width.min(self.columns - tile.column);
        let vectors = tile.columns.div_ceil(k.packing.lanes);
        // SAFETY: the panel is inside the packed weights, and the tile is as the kernel wants it.
        unsafe {
            tile.b = mem.at(self.weights).add(tile.column * self.depth());
            (k.of[vectors - 1][rows - 1])(tile);
        }
    }
}
