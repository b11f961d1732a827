//! The algebraic method: the equation of motion as an equation between integrals of measured signals.
//!
//! An equation Σⱼ θⱼ zⱼ⁽ⁿʲ⁾(t) = f(t) holds in every window 0 ≤ τ ≤ T. Transformed by Laplace, differentiated r times by
//! s (initial conditions, polynomials in s, go) and divided by s^q (derivatives go), it reads in time
//!
//! ```text
//! Σⱼ θⱼ ∫₀ᵀ w zⱼ⁽ⁿʲ⁾ dτ = ∫₀ᵀ w f dτ ,   w(τ) = τ^r (T − τ)^(q−1)/(q−1)! ,
//! ```
//!
//! and integrating by parts moves the derivatives onto the known kernel w: no signal is ever differentiated
//! (thesis §2.1.2, Eq 2.5–2.10; §3.1, Eq 3.8–3.10). Every window gives one row, linear in the θⱼ.
//!
//! What decides is how often w vanishes at its ends. At the start r ≥ n removes the initial conditions; Eq 3.10 has
//! r = 2 for a jerk and keeps 2·x₀/s (erratum E13). At the end q − 1 ≥ n keeps out raw last samples; Eq 2.10 has
//! q = n = 2, and its row holds x(T) T² with all of its noise. So: r = n, q = n + 1, short windows that slide.
//!
//! | item | what it gives |
//! |---|---|
//! | [`Kernel`] | w for any r, q and window; the exact quadrature weights of any derivative |
//! | [`rows()`], [`rows_of_pieces`] | the regression's columns on sliding windows |
//! | [`Stream`] | the same rows while samples arrive |
//! | [`iterated`] | the thesis's signals P₁(t), P₂(t), … as printed, with E13 corrected |
//! | [`Weights`] | noise gain, correlation of overlapping rows, effective number of rows |
//!
//! The method goes back to Fliess & Sira-Ramírez, ESAIM: COCV 9 (2003) 151, doi:10.1051/cocv:2003008; read as
//! modulating functions it is Shinbrot's, Trans. ASME 79 (1957) 579.
#![doc = ""]
#![doc = include_str!("../README.md")]

mod error;
pub mod iterated;
mod kernel;
mod noise;
mod quadrature;
mod stream;
mod windows;

pub use crate::error::AlgebraicError;
pub use crate::iterated::{Iterated, Restart};
pub use crate::kernel::{Initial, Kernel, MAX_DEGREE, Weights};
pub use crate::quadrature::Hold;
pub use crate::stream::{Stream, Term};
pub use crate::windows::{Column, Rows, rows, rows_of_pieces};
