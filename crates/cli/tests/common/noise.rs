//! Noise of made-up recordings.

/// A small generator (linear congruential, from its seed).
pub(crate) struct Noise(pub(crate) u64);

impl Noise {
    /// A number in [0, 1).
    pub(crate) fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as f64 / f64::from(1u32 << 31)
    }

    /// A number of mean 0 and variance 1: twelve uniform ones make a normal one.
    pub(crate) fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
    }
}
