//! One table of functions per instruction set, and the choice among them.

use super::attention::{self, Attention, ThinAttention};
use super::conv::{self, Depthwise, Pool};
use super::eight::{self, Dot, Eight, PackKvBytes, Quantise, ScalarDot};
use super::gemm::{self, Packing, Tile, TileFn};
use super::loops::{self, Copy, Fold, Map, Zip};
use super::matmul::{self, MatMul};
use super::norms::{self, LayerNorm, MapNorm, Softmax};
use super::simd::{Scalar, Simd};
use super::winograd::{self, FromPoints, KernelsToPoints, ToPoints};
use super::{Mem, Part};

/// Most rows of a tile.
pub const MAX_ROWS: usize = 12;
/// Most vectors of columns of a tile.
pub const MAX_VECTORS: usize = 2;

/// Instruction sets that kernels are compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Isa {
    /// Plain Rust.
    Scalar,
    /// x86-64 with AVX2 and FMA.
    Avx2,
    /// x86-64 with AVX-512F.
    Avx512,
    /// aarch64.
    Neon,
}

impl Isa {
    /// The best one of this processor.
    pub fn best() -> Self {
        [Self::Avx512, Self::Avx2, Self::Neon]
            .into_iter()
            .find(|isa| isa.kernels().is_some())
            .unwrap_or(Self::Scalar)
    }

    /// Those this processor has.
    pub fn available() -> Vec<Self> {
        let all = [Self::Scalar, Self::Avx2, Self::Avx512, Self::Neon];
        all.into_iter().filter(|isa| isa.kernels().is_some()).collect()
    }

    /// Its functions, if this processor has it.
    pub fn kernels(self) -> Option<&'static Kernels> {
        match self {
            Self::Scalar => Some(&SCALAR),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") => {
                let vnni = is_x86_feature_detected!("avxvnni");
                Some(if vnni { &AVX2_VNNI } else { &AVX2 })
            }
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 if is_x86_feature_detected!("avx512f") => {
                let vnni = is_x86_feature_detected!("avx512vnni");
                // Without it products of bytes are those of AVX2, which every such processor has.
                Some(if vnni { &AVX512_VNNI } else { &AVX512 })
            }
            #[cfg(target_arch = "aarch64")]
            Self::Neon => {
                let dot = std::arch::is_aarch64_feature_detected!("dotprod");
                Some(if dot { &NEON_DOT } else { &NEON })
            }
            _ => None,
        }
    }

    /// Name for reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Scalar => "scalar",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
            Self::Neon => "neon",
        }
    }
}

/// The functions of one instruction set. Calling one is unsafe: the processor must have the set,
/// and the step must have been checked against the memory.
#[derive(Debug)]
pub struct Kernels {
    /// Rows of a full tile.
    pub rows: usize,
    /// Layout of packed matrices.
    pub packing: Packing,
    pub(super) tiles: [[TileFn; MAX_ROWS]; MAX_VECTORS],
    /// Products of 8-bit numbers.
    pub eight: Eight,
    pub(super) depthwise: unsafe fn(&Depthwise, Mem, Part),
    pub(super) pool: unsafe fn(&Pool, Mem, Part),
    pub(super) to_points: unsafe fn(&ToPoints, Mem, Part),
    pub(super) kernels_to_points: unsafe fn(&KernelsToPoints, Packing, Mem, Part),
    pub(super) from_points: unsafe fn(&FromPoints, Mem, Part),
    pub(super) layer_norm: unsafe fn(&LayerNorm, Mem, Part),
    pub(super) softmax: unsafe fn(&Softmax, Mem, Part),
    pub(super) map_norm: unsafe fn(&MapNorm, Mem, Part),
    pub(super) copy: unsafe fn(&Copy, Mem, Part),
    pub(super) map: unsafe fn(&Map, Mem, Part),
    pub(super) zip: unsafe fn(&Zip, Mem, Part),
    pub(super) fold: unsafe fn(&Fold, Mem, Part),
    pub(super) matmul: unsafe fn(&MatMul, Mem, Part),
    pub(super) thin_attention: unsafe fn(&ThinAttention, Mem, Part),
    /// Softmax of `rows` rows in place, not divided by the sums, which go to `factors` inverted.
    pub(super) weigh: unsafe fn(*mut f32, usize, usize, usize, f32, *mut f32),
}

impl Kernels {
    /// Attention in tiles uses the tile functions directly.
    pub(super) unsafe fn attention(&self, step: &Attention, mem: Mem, part: Part) {
        // SAFETY: passed on.
        unsafe { attention::run(step, self, mem, part) }
    }
}

/// Makes the table of an instruction set. `$rows` is the height of its tile, `$eight` what it does
/// with bytes where the processor has nothing better.
macro_rules! table {
    ($table:ident, $module:ident, $set:ty, $rows:tt, $feature:tt, $eight:ident) => {
        mod $module {
            use super::*;
            #[allow(unused_imports)]
            use super::super::*;

            table!(@each $set, $feature,
                tile<R, NV>(t: &Tile) => gemm::tile::<$set, R, NV>(t);
                depthwise(s: &Depthwise, m: Mem, p: Part) => conv::depthwise::<$set>(s, m, p);
                pool(s: &Pool, m: Mem, p: Part) => conv::pool::<$set>(s, m, p);
                to_points(s: &ToPoints, m: Mem, p: Part) => winograd::to_points::<$set>(s, m, p);
                kernels_to_points(s: &KernelsToPoints, packing: Packing, m: Mem, p: Part)
                    => winograd::kernels_to_points::<$set>(s, packing, m, p);
                from_points(s: &FromPoints, m: Mem, p: Part)
                    => winograd::from_points::<$set>(s, m, p);
                layer_norm(s: &LayerNorm, m: Mem, p: Part) => norms::layer_norm::<$set>(s, m, p);
                softmax(s: &Softmax, m: Mem, p: Part) => norms::softmax::<$set>(s, m, p);
                map_norm(s: &MapNorm, m: Mem, p: Part) => norms::map_norm::<$set>(s, m, p);
                copy(s: &Copy, m: Mem, p: Part) => loops::copy(s, m, p);
                map(s: &Map, m: Mem, p: Part) => loops::map(s, m, p);
                zip(s: &Zip, m: Mem, p: Part) => loops::zip::<$set>(s, m, p);
                fold(s: &Fold, m: Mem, p: Part) => loops::fold(s, m, p);
                matmul(s: &MatMul, m: Mem, p: Part) => matmul::matmul::<$set>(s, m, p);
                thin(s: &ThinAttention, m: Mem, p: Part) => attention::thin::<$set>(s, m, p);
                weigh(p: *mut f32, rows: usize, pitch: usize, n: usize, scale: f32, f: *mut f32)
                    => norms::weigh::<$set>(p, rows, pitch, n, scale, f);
            );

            const fn tiles<const NV: usize>() -> [TileFn; MAX_ROWS] {
                table!(@rows $rows, NV)
            }

            pub const TABLE: Kernels = Kernels {
                rows: $rows,
                packing: Packing {
                    width: MAX_VECTORS * <$set as Simd>::LANES,
                    lanes: <$set as Simd>::LANES,
                },
                tiles: [tiles::<1>(), tiles::<2>()],
                eight: $eight,
                depthwise,
                pool,
                to_points,
                kernels_to_points,
                from_points,
                layer_norm,
                softmax,
                map_norm,
                copy,
                map,
                zip,
                fold,
                matmul,
                thin_attention: thin,
                weigh,
            };
        }
        static $table: Kernels = $module::TABLE;
    };
    (@each $set:ty, $feature:tt,
        tile<R, NV>($t:ident: &Tile) => $tile:expr;
        $($name:ident($($arg:ident: $type:ty),*) => $body:expr;)*) => {
        table!(@one $feature tile[R, NV]($t: &Tile) => $tile);
        $(
            table!(@one $feature $name[]($($arg: $type),*) => $body);
        )*
    };
    (@one () $name:ident[$($n:ident),*]($($arg:ident: $type:ty),*) => $body:expr) => {
        unsafe fn $name<$(const $n: usize),*>($($arg: $type),*) {
            // SAFETY: the caller promises a checked step.
            unsafe { $body }
        }
    };
    (@one ($feature:literal) $name:ident[$($n:ident),*]($($arg:ident: $type:ty),*) => $body:expr) => {
        #[target_feature(enable = $feature)]
        unsafe fn $name<$(const $n: usize),*>($($arg: $type),*) {
            // SAFETY: the caller promises a checked step, the attribute the instruction set.
            unsafe { $body }
        }
    };
    // The functions for bytes, in a module of their own.
    (@eight $eight:ident, $module:ident, $dot:ty, $rows:tt, $feature:tt) => {
        mod $module {
            use super::*;
            #[allow(unused_imports)]
            use super::super::*;

            table!(@one $feature tile[R, NV](t: &Tile) => eight::tile::<$dot, R, NV>(t));
            table!(@one $feature quantise[](s: &Quantise, m: Mem, p: Part)
                => eight::quantise::<$dot>(s, m, p));
            table!(@one $feature pack_kv[](s: &PackKvBytes, m: Mem, p: Part)
                => eight::pack_kv::<$dot>(s, m, p));
            table!(@one $feature attend[](s: &Attention, m: Mem, p: Part)
                => eight::attend::<$dot, $rows>(s, m, p));

            const fn tiles<const NV: usize>() -> [TileFn; MAX_ROWS] {
                table!(@rows $rows, NV)
            }

            pub const EIGHT: Eight = Eight {
                rows: $rows,
                packing: Packing {
                    width: MAX_VECTORS * <<$dot as Dot>::F as Simd>::LANES,
                    lanes: <<$dot as Dot>::F as Simd>::LANES,
                },
                layout: <$dot as Dot>::LAYOUT,
                shift: <$dot as Dot>::SHIFT,
                tiles: [tiles::<1>(), tiles::<2>()],
                quantise,
                pack_kv,
                attend,
            };
        }
        use $module::EIGHT as $eight;
    };
    // Rows above the tile's height are never asked for.
    (@rows 12, $nv:ident) => {
        [tile::<1, $nv>, tile::<2, $nv>, tile::<3, $nv>, tile::<4, $nv>, tile::<5, $nv>,
         tile::<6, $nv>, tile::<7, $nv>, tile::<8, $nv>, tile::<9, $nv>, tile::<10, $nv>,
         tile::<11, $nv>, tile::<12, $nv>]
    };
    (@rows 8, $nv:ident) => {
        [tile::<1, $nv>, tile::<2, $nv>, tile::<3, $nv>, tile::<4, $nv>, tile::<5, $nv>,
         tile::<6, $nv>, tile::<7, $nv>, tile::<8, $nv>, tile::<8, $nv>, tile::<8, $nv>,
         tile::<8, $nv>, tile::<8, $nv>]
    };
    (@rows 6, $nv:ident) => {
        [tile::<1, $nv>, tile::<2, $nv>, tile::<3, $nv>, tile::<4, $nv>, tile::<5, $nv>,
         tile::<6, $nv>, tile::<6, $nv>, tile::<6, $nv>, tile::<6, $nv>, tile::<6, $nv>,
         tile::<6, $nv>, tile::<6, $nv>]
    };
    (@rows 4, $nv:ident) => {
        [tile::<1, $nv>, tile::<2, $nv>, tile::<3, $nv>, tile::<4, $nv>, tile::<4, $nv>,
         tile::<4, $nv>, tile::<4, $nv>, tile::<4, $nv>, tile::<4, $nv>, tile::<4, $nv>,
         tile::<4, $nv>, tile::<4, $nv>]
    };
}

table!(@eight SCALAR_BYTES, scalar_bytes, ScalarDot, 4, ());
table!(SCALAR, scalar, Scalar, 4, (), SCALAR_BYTES);
#[cfg(target_arch = "x86_64")]
table!(@eight WIDE256, avx2_wide, x86::Wide256, 4, ("avx2,fma"));
#[cfg(target_arch = "x86_64")]
table!(@eight VNNI256, avx_vnni, x86::Vnni256, 6, ("avx2,fma,avxvnni"));
#[cfg(target_arch = "x86_64")]
table!(@eight VNNI512, avx512_vnni, x86::Vnni512, 12, ("avx512f,avx512vnni"));
#[cfg(target_arch = "x86_64")]
table!(AVX2, avx2, x86::Avx2, 6, ("avx2,fma"), WIDE256);
#[cfg(target_arch = "x86_64")]
table!(AVX512, avx512, x86::Avx512, 12, ("avx512f"), WIDE256);
#[cfg(target_arch = "x86_64")]
static AVX2_VNNI: Kernels = Kernels { eight: VNNI256, ..avx2::TABLE };
#[cfg(target_arch = "x86_64")]
static AVX512_VNNI: Kernels = Kernels { eight: VNNI512, ..avx512::TABLE };
#[cfg(target_arch = "aarch64")]
table!(@eight NEON_WIDE, neon_wide, neon::Wide, 8, ("neon"));
#[cfg(target_arch = "aarch64")]
table!(@eight NEON_DOTPROD, neon_dotprod, neon::DotProd, 8, ("neon,dotprod"));
#[cfg(target_arch = "aarch64")]
table!(NEON, neon_table, neon::Neon, 8, ("neon"), NEON_WIDE);
#[cfg(target_arch = "aarch64")]
static NEON_DOT: Kernels = Kernels { eight: NEON_DOTPROD, ..neon_table::TABLE };

/// Tables of this processor that [`Isa::kernels`] passes over because it has a better one.
#[cfg(test)]
pub fn passed_over() -> Vec<(String, &'static Kernels)> {
    let mut found: Vec<(String, &'static Kernels)> = Vec::new();
    #[cfg(target_arch = "x86_64")]
    if Isa::Avx2.kernels().is_some() {
        found.push(("Avx2 without VNNI".into(), &AVX2));
        if Isa::Avx512.kernels().is_some() {
            found.push(("Avx512 without VNNI".into(), &AVX512));
        }
    }
    #[cfg(target_arch = "aarch64")]
    found.push(("Neon without dotprod".into(), &NEON));
    found
}
