//! The floating-point peak of one core: what a kernel may at best reach.

use pulp::{Arch, Simd, WithSimd};

/// Sums that do not wait for one another: enough to hide the latency of a fused multiply–add in every unit.
const SUMS: usize = 16;
/// Rounds of a call.
const ROUNDS: usize = 1 << 18;

struct Chains;

impl WithSimd for Chains {
    type Output = (f64, f64);

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> (f64, f64) {
        let (factor, term) = (simd.splat_f64s(0.999_999), simd.splat_f64s(1e-6));
        // Values the compiler cannot know, or equal chains would become one.
        let mut sums: [S::f64s; SUMS] =
            std::array::from_fn(|k| simd.splat_f64s(std::hint::black_box(k as f64)));
        for _ in 0..ROUNDS {
            for sum in &mut sums {
                *sum = simd.mul_add_f64s(*sum, factor, term);
            }
        }
        let mut total = simd.splat_f64s(0.0);
        for sum in sums {
            total = simd.add_f64s(total, sum);
        }
        let lanes = size_of::<S::f64s>() / size_of::<f64>();
        (simd.reduce_sum_f64s(total), (2 * SUMS * ROUNDS * lanes) as f64)
    }
}

/// Runs independent chains of fused multiply–adds as wide as the machine has them; the operations done.
pub(crate) fn run() -> f64 {
    let (sum, operations) = Arch::new().dispatch(Chains);
    std::hint::black_box(sum);
    operations
}
