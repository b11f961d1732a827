//! Run-time units: a dimension (exponents of the SI base units), a factor to SI and the text as the
//! user wrote it. Radians count as dimensionless, as textbooks mix `N m` and `N m/rad` freely.

/// Exponents of m, kg, s, A, K, mol, cd.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Dimension(pub [f64; 7]);

/// A unit as written, with its meaning.
#[derive(Debug, Clone, PartialEq)]
pub struct Unit {
    /// As the user wrote it, e.g. `N m/V`.
    pub text: String,
    /// SI value of one of this unit (`mm` → 1e-3, `deg` → π/180).
    pub factor: f64,
    /// Its dimension.
    pub dimension: Dimension,
}
